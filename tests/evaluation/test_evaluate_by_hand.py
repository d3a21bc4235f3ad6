"""`evaluate` against episodes that are played by hand, and scores against numbers from the paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import offbench
from offbench.common import seeds
from offbench.common.seeds import Purpose
from offbench.envs.recipes import recipes_folder
from offbench.rollouts.policy import Policy

LADDERS = recipes_folder()
D4RL_HOPPER = (-20.272305, 3234.3)  # random and expert return in d4rl/infos.py


def first_policy(env: str) -> Path:
    return min((LADDERS / env / "behaviour" / "policies").glob("*.safetensors"))


def played(policy: Policy, seed: int, index: int, sampled: bool) -> tuple[float, int]:
    """Return the return and the length of an episode, of sampled actions or of the mode."""
    stream = (int(Purpose.REFERENCE), 2, index)
    env, rng = gym.make(policy.env_id), seeds.generator(seed, Purpose.ACTION, *stream)
    observation, _ = env.reset(seed=seeds.integer(seed, Purpose.RESET, *stream))
    rewards: list[float] = []
    done = False
    while not done:
        noise = rng.standard_normal((1, len(policy.low))) if sampled else None
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation[None], noise)[0])
        rewards.append(float(reward))
        done = terminated or truncated
    return float(np.sum(rewards)), len(rewards)


@pytest.mark.parametrize("sampled", [False, True])
def test_an_evaluation_is_its_episodes_played_by_hand(sampled: bool) -> None:
    path = first_policy("inverted-pendulum")
    policy = offbench.load_policy(path)
    result = offbench.evaluate(path, episodes=3, seed=5, stochastic=sampled, workers=1)
    by_hand = [played(policy, 5, i, sampled) for i in range(3)]
    assert list(zip(result.returns, result.lengths, strict=True)) == by_hand
    assert by_hand != [played(policy, 5, i, not sampled) for i in range(3)]


def test_scores_are_of_the_mean_return() -> None:
    result = offbench.evaluate(first_policy("hopper"), episodes=3, workers=1)
    ladder = json.loads((LADDERS / "hopper" / "behaviour" / "ladder.json").read_text())
    own = (ladder["references"]["random"]["return"], ladder["references"]["expert"]["return"])
    mean = sum(result.returns) / 3
    assert max(result.returns) - min(result.returns) > 1
    for key, (low, high) in {"dataset": own, "d4rl": D4RL_HOPPER}.items():
        assert result.scores[key] == pytest.approx(100 * (mean - low) / (high - low))


def test_a_runs_scores_are_by_its_own_references(medium: str) -> None:
    settings: dict[str, Any] = {"steps": 20, "eval_every": 20, "eval_episodes": 1, "hidden": (8,), "batch_size": 8}
    (folder,) = offbench.train("bc", medium, workers=1, **settings)
    result = offbench.evaluate(folder, episodes=4, workers=1)
    low, high = json.loads((folder / "config.json").read_text())["references"]["dataset"]
    assert len(set(result.returns)) > 1
    assert result.scores == {"dataset": pytest.approx(100 * (sum(result.returns) / 4 - low) / (high - low))}
