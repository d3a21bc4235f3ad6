"""The episodes of evaluations.csv, played again by hand in Gymnasium."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import offbench
from offbench.common import seeds
from offbench.common.seeds import Purpose
from offbench.rollouts.policy import Policy

SMALL: dict[str, Any] = {"hidden": (8,), "batch_size": 16, "eval_every": 20, "eval_episodes": 3, "workers": 1}


def played(policy: Policy, seed: int, step: int, index: int) -> tuple[float, int]:
    """Return the return and the length of an episode of the policy's mode."""
    env = gym.make(policy.env_id)
    observation, _ = env.reset(seed=seeds.integer(seed, Purpose.RESET, int(Purpose.EVALUATION), step, index))
    rewards: list[float] = []
    done = False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation[None], None)[0])
        rewards.append(float(reward))
        done = terminated or truncated
    return float(np.sum(rewards)), len(rewards)


def rows_of(folder: Path, step: int) -> list[tuple[float, int]]:
    with open(folder / "evaluations.csv", newline="") as file:
        return [(float(row["return"]), int(row["length"])) for row in csv.DictReader(file) if row["step"] == str(step)]


def test_each_evaluation_is_the_policys_mode_in_episodes_of_its_own(home: Path) -> None:
    """The rewards of this environment are no whole numbers, so that a return is not its length."""
    (home / "double.toml").write_text('name = "double"\nenv_id = "InvertedDoublePendulum-v5"\n')
    dataset = offbench.collect("./double.toml", "random", steps=300, workers=1)
    for algorithm, kind in {"bc": "tanh", "cql": "squashed_gaussian"}.items():
        for step in (20, 40):
            (folder,) = offbench.train(algorithm, dataset, steps=step, seeds=7, **SMALL)
            policy = offbench.load_policy(folder)
            assert policy.kind == kind
            by_hand = [played(policy, 7, step, i) for i in range(3)]
            assert rows_of(folder, step) == [(pytest.approx(ret, rel=1e-9), length) for ret, length in by_hand]
            assert len({ret for ret, _ in by_hand}) == 3
