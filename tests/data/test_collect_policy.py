"""`collect --policy`: agents trained with SB3 and saved as zips, policy files, functions; a hostile zip is refused."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import offbench
from offbench.agents.sb3_zip import read_sb3_zip
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from tests.conftest import forget_modules

ENV = "InvertedPendulum-v5"
LOW, HIGH = np.array([-3], np.float32), np.array([3], np.float32)
AGENTS: dict[str, tuple[Any, dict[str, Any], dict[str, Any]]] = {
    "sac": (SAC, {"net_arch": [8, 6]}, {"buffer_size": 10}),
    "td3": (TD3, {"net_arch": [8]}, {"buffer_size": 10}),
    "ddpg": (DDPG, {"net_arch": [8], "activation_fn": torch.nn.Tanh}, {"buffer_size": 10}),
    "ppo": (PPO, {"net_arch": [8, 6], "log_std_init": -1.0}, {}),
    "a2c": (A2C, {"net_arch": {"pi": [5], "vf": [7]}, "activation_fn": torch.nn.ReLU}, {}),
}


def saved(name: str, folder: Path) -> tuple[Any, Path]:
    """Return an SB3 agent and its zip."""
    cls, kwargs, more = AGENTS[name]
    model = cls("MlpPolicy", gym.make(ENV), policy_kwargs=kwargs, seed=1, device="cpu", **more)
    model.save(folder / f"{name}.zip")
    return model, folder / f"{name}.zip"


@pytest.mark.parametrize("name", AGENTS)
def test_a_zips_policy_acts_as_in_sb3(name: str, home: Path, rng: np.random.Generator) -> None:
    model, path = saved(name, home)
    observations = rng.normal(size=(50, 4)).astype(np.float32) * 3
    expected, _ = model.predict(observations, deterministic=True)
    policy = read_sb3_zip(path, LOW, HIGH, ENV)
    np.testing.assert_allclose(policy(observations), expected, atol=1e-5)
    if name in ("ppo", "a2c"):  # the std, by the log-density of the mode
        spread = (policy(observations, rng) - policy(observations)).std()
        assert spread == pytest.approx(np.exp(-1) if name == "ppo" else 1, rel=0.4)  # log_std before training
    policy.save(home / "policy.safetensors")
    np.testing.assert_array_equal(
        offbench.load_policy(home / "policy.safetensors")(observations), policy(observations)
    )


class Touch:
    """What runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch PWNED",)


@pytest.mark.parametrize("text", ["[1.2.3e]", "[-1e999]", "[1e300]", "[]", "1 2 3", None, [3]])
def test_any_text_of_the_bounds_is_read_or_ignored(text: object, home: Path) -> None:
    _, path = saved("td3", home)
    with zipfile.ZipFile(path) as archive:
        weights, data = archive.read("policy.pth"), json.loads(archive.read("data"))
    data["action_space"]["low"] = text
    with zipfile.ZipFile(home / "odd.zip", "w") as archive:
        archive.writestr("policy.pth", weights)
        archive.writestr("data", json.dumps(data))
    policy = read_sb3_zip(home / "odd.zip", LOW, HIGH, ENV)
    assert len(policy.low) == 1
    assert policy.high == HIGH


def test_layers_that_do_not_fit_together_are_refused(home: Path) -> None:
    _, path = saved("td3", home)
    with zipfile.ZipFile(path) as archive:
        weights, data = torch.load(io.BytesIO(archive.read("policy.pth"))), archive.read("data")
    weights["actor.mu.0.weight"], weights["actor.mu.0.bias"] = torch.zeros(5, 4), torch.zeros(5)
    changed = io.BytesIO()
    torch.save(weights, changed)
    with zipfile.ZipFile(home / "odd.zip", "w") as archive:
        archive.writestr("policy.pth", changed.getvalue())
        archive.writestr("data", data)
    with pytest.raises(OffbenchError, match=r"odd\.zip is not an MLP policy as SB3 saves it: a layer of shape"):
        read_sb3_zip(home / "odd.zip", LOW, HIGH, ENV)


def test_a_hostile_zip_is_refused(home: Path, tiny: tuple[str, str]) -> None:
    _, path = saved("td3", home)
    evil = io.BytesIO()
    torch.save({"actor.mu.0.weight": Touch()}, evil)
    with zipfile.ZipFile(path) as archive:
        data = archive.read("data")
    for content in (evil.getvalue(), pickle.dumps(Touch()), b"", b"PK"):
        with zipfile.ZipFile(home / "evil.zip", "w") as archive:
            archive.writestr("policy.pth", content)
            archive.writestr("data", data)
        with pytest.raises(OffbenchError, match=r"evil\.zip is (refused|not a readable zip)"):
            offbench.collect(tiny[0], policy="evil.zip", behaviour_dir=tiny[1])
    assert not (home / "PWNED").exists()
    assert minari_store.local_ids() == []


def test_an_agent_of_another_environment_is_refused(home: Path, tiny: tuple[str, str]) -> None:
    other = gym.make("Hopper-v5")
    narrow = gym.wrappers.RescaleAction(gym.make(ENV), np.float32(-0.5), np.float32(0.5))
    normalized = VecNormalize(DummyVecEnv([lambda: gym.make(ENV)]))
    normalized_agent = PPO("MlpPolicy", normalized, n_steps=8, batch_size=8, device="cpu").learn(8)
    agents = {
        r"takes observations \(11,\) and gives actions \(3,\), but InvertedPendulum-v5 has": PPO("MlpPolicy", other),
        r"acts in \[-0\.5\] to \[0\.5\], but InvertedPendulum-v5 in \[-3\.\] to \[3\.\]": SAC(
            "MlpPolicy", narrow, buffer_size=9
        ),
        "has discrete actions": PPO("MlpPolicy", "CartPole-v1"),
        "was trained with VecNormalize": normalized_agent,
    }
    for message, agent in agents.items():
        agent.save(home / "agent.zip")
        with pytest.raises(OffbenchError, match=f"agent.zip {message}"):
            offbench.collect(tiny[0], policy="agent.zip", behaviour_dir=tiny[1])
    assert minari_store.local_ids() == []


class Halved(FlattenExtractor):
    """Has no weights, and the observations' width."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return super().forward(observations) / 2


class Linear(FlattenExtractor):
    """Has weights."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__(space)
        self.layer = torch.nn.Linear(4, 4)


@pytest.mark.parametrize("extractor", [Halved, Linear])
@pytest.mark.parametrize("cls", [PPO, SAC])
def test_an_extractor_of_ones_own_is_refused(cls: Any, extractor: Any, home: Path) -> None:
    kwargs = {"features_extractor_class": extractor}
    cls("MlpPolicy", gym.make(ENV), policy_kwargs=kwargs, device="cpu").save(home / "agent.zip")
    with pytest.raises(OffbenchError, match=r"agent\.zip has a features extractor of its own"):
        read_sb3_zip(home / "agent.zip", LOW, HIGH, ENV)
    kwargs = {"features_extractor_class": FlattenExtractor}
    cls("MlpPolicy", gym.make(ENV), policy_kwargs=kwargs, device="cpu").save(home / "plain.zip")
    read_sb3_zip(home / "plain.zip", LOW, HIGH, ENV)


def test_what_is_recorded_is_what_the_policy_does(home: Path, tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    _, path = saved("td3", home)
    dataset = offbench.collect(recipe, policy=path, steps=200, behaviour_dir=behaviour_dir, workers=1)
    assert dataset == "tiny-td3-v0"
    data = offbench.load(dataset)
    policy = read_sb3_zip(path, LOW, HIGH, ENV)
    observations = np.array(data.observations[data.rows])
    np.testing.assert_allclose(np.array(data.actions) * 3, policy(observations), atol=1e-4)
    metadata = minari_store.read_metadata(dataset)
    assert metadata["algorithm_name"] == "TD3 or DDPG (Stable-Baselines3)"
    assert metadata["offbench"]["parts"][0]["policy"] == "td3.zip"
    policy.save(home / "mine.safetensors")
    other = offbench.collect(recipe, policy="mine.safetensors", steps=200, behaviour_dir=behaviour_dir, workers=1)
    assert other == "tiny-mine-v0"
    assert offbench.load(other).content_sha256 == data.content_sha256


def test_a_policy_of_another_task_is_noted(
    home: Path, tiny: tuple[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    _, path = saved("td3", home)
    same = ("InvertedPendulum-v4", "module:InvertedPendulum-v5", "")
    for env_id, noted in (*((env_id, False) for env_id in same), ("Other-v5", True)):
        read_sb3_zip(path, LOW, HIGH, env_id).save(home / "mine.safetensors")
        offbench.collect(tiny[0], policy="mine.safetensors", steps=60, overwrite=True, workers=1)
        said = capfd.readouterr().err
        assert (f"mine.safetensors was trained for {env_id}, and is recorded in {ENV}" in said) is noted
        assert ("was trained for" in said) is noted


def test_ppo_with_a_large_spread_acts_as_in_sb3(home: Path, rng: np.random.Generator) -> None:
    wide = gym.wrappers.RescaleAction(gym.make(ENV), np.float32(-1000), np.float32(1000))
    model = PPO("MlpPolicy", wide, policy_kwargs={"log_std_init": 4.0}, device="cpu")
    model.save(home / "wide.zip")
    policy = read_sb3_zip(home / "wide.zip", LOW * 1000 / 3, HIGH * 1000 / 3, ENV)
    observations = np.zeros((4000, 4), np.float32)
    expected, _ = model.predict(observations)
    spread = np.std(policy(observations, rng))
    assert spread == pytest.approx(np.std(expected), rel=0.1)
    assert spread == pytest.approx(np.exp(4.0), rel=0.1)


def test_actions_stay_inside_bounds_that_are_not_float32(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "narrow.py").write_text(
        """import gymnasium as gym
import numpy as np


class Narrow(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    action_space = gym.spaces.Box(-0.1, 0.1, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        return np.zeros(1), 0.0, False, False, {}


def highest(o):
    return [0.1]


gym.register("Narrow-v0", "narrow:Narrow", max_episode_steps=20)
"""
    )
    (home / "narrow.toml").write_text('env_id = "narrow:Narrow-v0"\n')
    monkeypatch.syspath_prepend(str(home))
    dataset = offbench.collect(home / "narrow.toml", policy="narrow:highest", name="highest", steps=60, workers=1)
    assert (minari.load_dataset(dataset)[0].actions == 0.1).all()


def test_a_function_of_ones_own(home: Path, tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, behaviour_dir = tiny
    (home / "my_policy_module.py").write_text(
        "def act(o):\n    return [0.5 * o[1]]\n\ndef wild(o):\n    return [99.0]\n"
    )
    monkeypatch.syspath_prepend(str(home))
    more: dict[str, Any] = {"steps": 60, "behaviour_dir": behaviour_dir, "workers": 1}
    dataset = offbench.collect(recipe, policy="my_policy_module:act", name="lean", **more)
    assert dataset == "tiny-lean-v0"
    data = offbench.load(dataset)
    observations = np.array(data.observations[data.rows])
    np.testing.assert_allclose(np.array(data.actions)[:, 0] * 3, 0.5 * observations[:, 1], atol=1e-4)
    for name, message in {
        "my_policy_module:wild": "outside the bounds",
        "my_policy_module:none": "has no function 'none'",
        "no_such_module_here:act": "cannot import the policy",
        "os:getpid": "failed",  # a function in C, without source
    }.items():
        with pytest.raises(OffbenchError, match=message):
            offbench.collect(recipe, policy=name, name="bad", **more)
    with pytest.raises(OffbenchError, match="'medium' is a level of offbench's own agents"):
        offbench.collect(recipe, policy="my_policy_module:act", name="medium", **more)


def test_a_controller_with_limits_of_its_own_verifies(
    home: Path, tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its actions are cut off inside the bounds of ±3, and executed so: no fault, which replaying them shows."""
    (home / "limited.py").write_text("def act(o):\n    return [max(-0.3, min(0.3, 9 * o[1]))]\n")
    monkeypatch.syspath_prepend(str(home))
    recipe, behaviour_dir = tiny
    dataset = offbench.collect(
        recipe, policy="limited:act", name="limited", steps=400, behaviour_dir=behaviour_dir, workers=1
    )
    report = offbench.verify(dataset)
    assert report.ok
    assert "these are limits of the behaviour policy" in report.warnings[0]
    assert "sizes of the parts, seeds against the metadata" in report.checked


POLICIES = """
import functools

import torch


@torch.no_grad()
def decorated(o):
    return [GAIN * o[1]]


class Acting:
    def __call__(self, o):
        return decorated(o)


called = Acting()
partial = functools.partial(lambda o, gain: [gain * o[1]], gain=GAIN)
"""


@pytest.mark.parametrize("name", ["decorated", "called", "partial"])
def test_an_edit_of_a_policys_module_is_noticed(
    name: str, home: Path, tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(home))
    hashes = []
    for gain in ("0.5", "0.25"):
        forget_modules(home)
        shutil.rmtree(home / "__pycache__", ignore_errors=True)
        (home / "edited_policies.py").write_text(POLICIES.replace("GAIN", gain))
        more: dict[str, Any] = {"behaviour_dir": tiny[1], "workers": 1, "steps": 20, "overwrite": gain == "0.25"}
        dataset = offbench.collect(tiny[0], policy=f"edited_policies:{name}", name="edited", **more)
        hashes.append(minari_store.read_metadata(dataset)["offbench"]["parts"][0]["policy_sha256"])
    assert hashes[0] != hashes[1]


NOISY = """
import numpy as np

rng = np.random.default_rng(0)


def act(o):
    return [rng.uniform(-3, 3)]
"""


def test_a_function_that_draws_is_called_in_one_process(
    home: Path, tiny: tuple[str, str], offbench_cli: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    """Its copies in other processes would draw the same numbers. Whether it has changed cannot be determined."""
    (home / "noisy_policy.py").write_text(NOISY)
    words = ("collect", tiny[0], "--behaviour-dir", tiny[1], "--policy", "noisy_policy:act", "--steps", "400")
    for workers in ("1", "3"):
        done = offbench_cli(*words, "--name", f"noisy{workers}", "--workers", workers)
        assert done.returncode == 0, done.stderr
    one, three = (offbench.load(f"tiny-noisy{workers}-v0") for workers in (1, 3))
    assert one.content_sha256 == three.content_sha256
    assert len(np.unique(np.array(three.actions))) > 390
    done = offbench_cli(*words, "--name", "noisy1")
    assert done.returncode == 2
    assert "but noisy_policy:act may act differently now" in done.stderr
    assert "--overwrite" in done.stderr
