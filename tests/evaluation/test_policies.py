"""`offbench.load_policy`: a trained policy in somebody's own Gymnasium loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import offbench
from offbench.benchmarks.grid import load_grid
from offbench.cli.main import main
from offbench.envs.environments import env_spec
from offbench.rollouts.policy import Policy, uniform_policy
from offbench.rollouts.rollouts import Rollouts, gather
from offbench.training.run import Run

SMALL: dict[str, Any] = {
    "steps": 20,
    "eval_every": 20,
    "eval_episodes": 1,
    "hidden": (8,),
    "batch_size": 8,
    "workers": 1,
}


def test_a_policy_plays_in_a_gymnasium_loop(medium: str, home: Path) -> None:
    (folder,) = offbench.train("td3_bc", medium, **SMALL)
    policy = offbench.load_policy(folder)
    assert repr(policy) == "Policy(tanh, 4 -> 8 -> 1, InvertedPendulum-v5)"
    env = gym.make(policy.env_id)
    observation, _ = env.reset(seed=0)
    total = 0.0
    for _ in range(20):
        action = policy(observation)
        assert env.action_space.contains(action)
        # the network by hand, in float64
        (w0, b0), (w1, b1) = policy.layers
        x = (observation - policy.observation_mean.astype(float)) / policy.observation_std
        out = np.maximum(x @ w0.astype(float) + b0, 0) @ w1.astype(float) + b1
        np.testing.assert_allclose(action, 3 * np.tanh(out), rtol=1e-5)
        observation, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
        if terminated or truncated:
            observation, _ = env.reset()
    assert total > 0
    same = offbench.load_policy(folder / "policy.safetensors")
    np.testing.assert_array_equal(same(np.stack([observation] * 3)), np.stack([policy(observation)] * 3))
    with pytest.raises(offbench.OffbenchError, match=r"takes observations \(4,\), not \(3,\)"):
        policy(np.zeros(3))
    with pytest.raises(offbench.OffbenchError, match="no run in"):
        offbench.load_policy(home)


def test_a_policy_file_in_a_runs_folder_is_evaluated_in_the_runs_environment(home: Path) -> None:
    """Its own metadata name the environment's id alone, and not the arguments."""
    (home / "noisy.toml").write_text('env_id = "InvertedPendulum-v5"\n[env_kwargs]\nreset_noise_scale = 0.2\n')
    dataset = offbench.collect(home / "noisy.toml", "random", steps=300, workers=1)
    (folder,) = offbench.train("bc", dataset, **SMALL)
    of_run = offbench.evaluate(folder, episodes=3, workers=1)
    of_file = offbench.evaluate(folder / "policy.safetensors", episodes=3, workers=1)
    assert (of_file.returns, of_file.scores) == (of_run.returns, of_run.scores)
    (home / "copied").mkdir()
    (folder / "policy.safetensors").rename(home / "copied" / "policy.safetensors")
    assert offbench.evaluate(home / "copied" / "policy.safetensors", episodes=3, workers=1).returns != of_run.returns


def test_policies_that_choose_at_random_need_no_noise_either() -> None:
    low, high = np.array([-1.0, 0.0], np.float32), np.array([1.0, 5.0], np.float32)
    policy = uniform_policy(low, high, 3, "x")
    actions = policy(np.zeros((1000, 3)))
    assert ((actions >= low) & (actions <= high)).all()
    assert np.abs(actions.mean(0) - [0, 2.5]).max() < 0.3
    with Rollouts(env_spec("InvertedPendulum-v5")) as rollouts:  # an evaluation plays the same
        pendulum = uniform_policy(np.full(1, -3, np.float32), np.full(1, 3, np.float32), 4, "x")
        results = [rollouts.start_evaluation(pendulum, 0, (), 5, best) for best in (True, False)]
        assert gather(results[0]) == gather(results[1])
    zeros = np.zeros(3, np.float32)
    layers = ((np.zeros((3, 4), np.float32), np.array([0, 0, -1, -1], np.float32)),)
    gaussian = Policy("squashed_gaussian", layers, zeros, zeros + 1, -high - 1, high + 1, "x")
    np.testing.assert_array_equal(gaussian(zeros), gaussian(zeros))
    sampled = gaussian(zeros, np.random.default_rng(0))
    assert (sampled != gaussian(zeros)).any()
    np.testing.assert_array_equal(sampled, gaussian(zeros, np.random.default_rng(0)))


def test_a_grid_may_name_its_methods(medium: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = f"""
datasets = ["{medium}"]
steps = 20
eval_every = 20
eval_episodes = 1
[[algorithms]]
name = "td3_bc"
label = "TD3+BC, small"
hidden = [8]
batch_size = 8
[[algorithms]]
name = "bc"
hidden = [8]
"""
    (home / "mine.toml").write_text(lines)
    main(["benchmark", "./mine.toml", "--workers", "1"])
    out, err = capsys.readouterr()
    assert "TD3+BC, small" in out
    assert "bc " in out
    assert err.splitlines()[-1] == "next: offbench report"
    (run,) = (Run(path.parent) for path in (home / "runs").rglob("config.json") if "td3_bc" in str(path))
    assert run.config().label == "TD3+BC, small"
    assert offbench.compare("TD3+BC, small", "bc").a == "TD3+BC, small"
    (home / "mine.toml").write_text(lines.replace("hidden = [8]", "hidden = [[8], [9]]", 1))
    with pytest.raises(SystemExit):
        main(["benchmark", "./mine.toml"])
    assert "the label 'TD3+BC, small' names one variant, and the settings are 2" in capsys.readouterr().err
    (home / "mine.toml").write_text(lines.replace("TD3+BC, small", "a" * 61))
    with pytest.raises(offbench.OffbenchError, match="label must be a line of at most 60 characters"):
        load_grid("./mine.toml")


def test_what_python_shows_of_an_object_is_short(medium: str) -> None:
    data = offbench.load(medium)
    assert repr(data).startswith("Transitions(tiny-medium-v0, 600 transitions, ")
    assert repr(offbench.show(medium)).startswith("Summary(tiny-medium-v0, ")
    lines = offbench.show(medium).lines()
    place = lines.index("provenance")
    assert any(line.startswith("  fraction ") for line in lines[place:])
    assert f"content_sha256  {data.content_sha256}" in lines
    assert not any("{" in line for line in lines)
