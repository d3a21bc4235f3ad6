"""PointMass-v0: push a point to the center of a table and keep it there, without letting it fall off."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

STEP = 0.05  # seconds
EDGE = 1.0  # half the width of the table


class PointMass(gym.Env[np.ndarray, np.ndarray]):
    """Observation: position and velocity [4]; action: force [2] in [-1, 1].

    The reward is 1 - distance from the center. The episode terminates when the point falls off the table.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's way)

    def __init__(self, friction: float = 0.5, render_mode: str | None = None) -> None:
        self.friction, self.render_mode = friction, render_mode
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.position, self.velocity = np.zeros(2), np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Place the point near the edge, at rest. All random numbers come from `self.np_random`."""
        super().reset(seed=seed)
        angle = self.np_random.uniform(0, 2 * np.pi)
        self.position, self.velocity = 0.8 * EDGE * np.array([np.cos(angle), np.sin(angle)]), np.zeros(2)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply a force for one step."""
        self.velocity = self.velocity + STEP * (4 * np.asarray(action, np.float64) - self.friction * self.velocity)
        self.position = self.position + STEP * self.velocity
        terminated = bool(np.abs(self.position).max() > EDGE)
        return self._observation(), float(1 - np.linalg.norm(self.position)), terminated, False, {}

    def render(self) -> np.ndarray:
        """Draw the table and the point."""
        picture = np.full((96, 96, 3), 230, np.uint8)
        column, row = np.clip(48 + 44 * self.position / EDGE, 4, 91).astype(int)
        picture[44:52, 44:52] = (150, 200, 150)
        picture[row - 3 : row + 4, column - 3 : column + 4] = (200, 60, 60)
        return picture

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.position, self.velocity])


gym.register("PointMass-v0", entry_point="my_env:PointMass", max_episode_steps=100)
