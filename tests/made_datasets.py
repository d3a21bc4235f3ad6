"""Datasets made by hand, with Minari's own function."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import minari
    from minari.data_collector import EpisodeBuffer

BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = gym.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))


def foreign(name: str, episodes: list[dict[str, Any]], observations: Any = BOX, actions: Any = ACTIONS) -> str:
    """Write a dataset with Minari's own function, as somebody else would."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            name,
            [EpisodeBuffer(**episode) for episode in episodes],
            observation_space=observations,
            action_space=actions,
            data_format="hdf5",
        )
    return name


def episode(steps: int, start: float, terminated: bool, **changes: Any) -> dict[str, Any]:
    """Return an episode whose numbers count up from `start`, as arguments of Minari's EpisodeBuffer."""
    ends = np.zeros(steps, bool)
    ends[-1] = True
    observations = start + np.arange(2 * (steps + 1), dtype=np.float64).reshape(-1, 2)
    values = {
        "observations": observations,
        "actions": np.tile(np.array([[2.0, 0.0]], np.float32), (steps, 1)),
        "rewards": start + np.arange(steps, dtype=np.float64),
        "terminations": ends if terminated else np.zeros(steps, bool),
        "truncations": np.zeros(steps, bool) if terminated else ends,
        "infos": {},
    }
    return values | changes
