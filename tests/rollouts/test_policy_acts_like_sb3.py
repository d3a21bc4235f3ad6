"""The NumPy policy file acts like the PyTorch original."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from stable_baselines3 import SAC
from torch import nn

from offbench.agents.sac import export_actor
from offbench.common.errors import OffbenchError
from offbench.rollouts.policy import Policy, from_bytes, read_policy_file, uniform_policy


@pytest.fixture(scope="module")
def sac() -> SAC:
    return SAC("MlpPolicy", gym.make("Hopper-v5"), policy_kwargs={"net_arch": [32, 24]}, seed=3, buffer_size=10)


def test_deterministic_actions_equal_sb3_predict(sac: SAC, rng: np.random.Generator) -> None:
    observations = rng.normal(size=(200, 11)) * 3
    ours = export_actor(sac, "Hopper-v5", {}).act(observations, None)
    theirs, _ = sac.predict(observations, deterministic=True)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_sampled_actions_equal_sb3_given_its_noise(sac: SAC, rng: np.random.Generator) -> None:
    observations = rng.normal(size=(100, 11))
    actor = sac.policy.actor
    with torch.no_grad():
        mean, log_std, _ = actor.get_action_dist_params(torch.as_tensor(observations, dtype=torch.float32))
        noise = torch.randn(mean.shape)
        theirs = torch.tanh(mean + log_std.exp() * noise)
    ours = export_actor(sac, "Hopper-v5", {}).act(observations, noise.numpy())
    np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-5)


def test_the_log_std_is_clipped_as_sb3_clips_it() -> None:
    """At 5 and -30, beyond both bounds; the noise is such that tanh tells e^2 from e^5 and e^-20 from e^-30."""
    sac = SAC("MlpPolicy", gym.make("Hopper-v5"), policy_kwargs={"net_arch": [8]}, buffer_size=10)
    actor = sac.policy.actor
    with torch.no_grad():
        actor.log_std.weight.zero_()
        actor.log_std.bias.copy_(torch.tensor([5.0, -30.0, 0.0]))
        mean, log_std, _ = actor.get_action_dist_params(torch.zeros(1, 11))
        noise = torch.tensor([[0.05, 2e8, 0.5]])
        theirs = torch.tanh(mean + log_std.exp() * noise).numpy()
    ours = export_actor(sac, "Hopper-v5", {}).act(np.zeros((1, 11)), noise.numpy())
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_best_by_q_normalizes_what_actor_and_critic_see(rng: np.random.Generator) -> None:
    torch.manual_seed(0)
    actor, critic = (nn.Sequential(nn.Linear(n, 16), nn.ReLU(), nn.Linear(16, out)) for n, out in ((4, 4), (6, 1)))
    nets = [
        tuple((m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in (n[0], n[2])) for n in (actor, critic)
    ]
    one, std = np.ones(2, np.float32), np.full(4, 0.2, np.float32)
    policy = Policy("best_by_q", nets[0], std * 15, std, -one, one, "X-v0", critic=nets[1], samples=6)
    observations, noise = rng.normal(3, 0.2, (50, 4)), rng.normal(size=(50, 6, 2))
    with torch.no_grad():
        x = torch.as_tensor((observations - 3) / 0.2, dtype=torch.float32)
        mean, log_std = actor(x)[:, None].chunk(2, -1)
        actions = torch.tanh(mean + log_std.exp() * torch.as_tensor(noise, dtype=torch.float32))
        best = critic(torch.cat([x[:, None].expand(50, 6, 4), actions], -1)).argmax(1)[:, 0]
    theirs = actions[torch.arange(50), best].numpy()
    np.testing.assert_allclose(policy.act(observations, noise), theirs, atol=1e-5)


def test_actions_do_not_depend_on_how_many_are_asked_for(sac: SAC, rng: np.random.Generator) -> None:
    policy = export_actor(sac, "Hopper-v5", {})
    observations, noise = rng.normal(size=(64, 11)), rng.normal(size=(64, 3))
    together = policy.act(observations, noise)
    alone = np.concatenate([policy.act(observations[i : i + 1], noise[i : i + 1]) for i in range(64)])
    np.testing.assert_array_equal(together, alone)


def test_bounds_are_reached_and_kept() -> None:
    low, high = np.array([-0.4, 0.0], np.float32), np.array([0.4, 10.0], np.float32)
    weight, bias = np.zeros((1, 2), np.float32), np.array([50.0, -50.0], np.float32)
    policy = Policy("tanh", ((weight, bias),), np.zeros(1, np.float32), np.ones(1, np.float32), low, high, "X-v0")
    np.testing.assert_array_equal(policy.act(np.zeros((1, 1)), None), [[high[0], low[1]]])


def test_observations_are_normalized() -> None:
    mean, std = np.array([2.0, -1.0], np.float32), np.array([4.0, 0.5], np.float32)
    weight, bias = np.eye(2, dtype=np.float32), np.zeros(2, np.float32)
    bounds = np.full(2, -1, np.float32), np.full(2, 1, np.float32)
    policy = Policy("tanh", ((weight, bias),), mean, std, *bounds, "X-v0")
    np.testing.assert_allclose(policy.act(np.array([[4.0, -1.25]]), None), [[np.tanh(0.5), np.tanh(-0.5)]], atol=1e-7)


def test_uniform_covers_the_bounds(rng: np.random.Generator) -> None:
    low, high = np.array([-2.0], np.float32), np.array([6.0], np.float32)
    policy = uniform_policy(low, high, 4, "X-v0")
    actions = policy.act(np.zeros((20_000, 4)), policy.draw(rng, 20_000))
    assert actions.min() >= -2
    assert actions.max() <= 6
    assert abs(actions.mean() - 2) < 0.1
    assert abs(actions.std() - 8 / np.sqrt(12)) < 0.05


def test_a_file_comes_back_the_same(sac: SAC, home: Path, rng: np.random.Generator) -> None:
    policy = export_actor(sac, "Hopper-v5", {"algorithm": "SAC", "step": 7})
    policy.save(home / "p.safetensors")
    again = read_policy_file(home / "p.safetensors")
    observations = rng.normal(size=(5, 11))
    np.testing.assert_array_equal(again.act(observations, None), policy.act(observations, None))
    assert again.origin == policy.origin
    assert again.to_bytes() == policy.to_bytes()


def _damage(kind: str, path: Path) -> None:
    data = path.read_bytes()
    tensors = dict(load_file(path))
    if kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "pickle":
        path.write_bytes(b"\x80\x04\x95" + bytes(100))
    elif kind == "nan":
        tensors["layers.0.bias"][0] = np.nan
    elif kind == "missing":
        del tensors["layers.1.weight"]
    elif kind == "shape":
        tensors["layers.0.weight"] = tensors["layers.0.weight"][:-1]
    elif kind == "float64":
        tensors["low"] = tensors["low"].astype(np.float64)
    if kind in ("nan", "missing", "shape", "float64"):
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))["__metadata__"]
        save_file({k: np.ascontiguousarray(v) for k, v in tensors.items()}, path, metadata=header)
    if kind == "no header":
        save_file(tensors, path)


@pytest.mark.parametrize("kind", ["truncated", "empty", "pickle", "nan", "missing", "shape", "float64", "no header"])
def test_damaged_files_are_refused(sac: SAC, home: Path, kind: str) -> None:
    path = home / "p.safetensors"
    export_actor(sac, "Hopper-v5", {}).save(path)
    from_bytes(path.read_bytes())
    _damage(kind, path)
    with pytest.raises(OffbenchError, match="not a readable policy file"):
        read_policy_file(path)
