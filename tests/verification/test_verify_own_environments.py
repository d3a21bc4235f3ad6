"""`verify` of environments of one's own: which faults are the environment's own behaviour, and which the data's."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

import offbench
from offbench.rollouts.rollouts import _env_cache
from offbench.verification.verify import verify
from tests.verification.test_verify import codes, each, replace, tamper

WALK = """
import gymnasium as gym
import numpy as np

NOISE = 0.0


class Walk(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.np_random.standard_normal(2), 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), "bad action"
        self.t += 1
        self.x = np.sin(3 * self.x + 5 * action) * (1 + NOISE)
        reward = float(np.exp(self.x[0])) * (1 + NOISE)
        ENDS
        return self.x.astype(np.float32), reward, terminated, truncated, {}


gym.register("Walk-v0", "walk:Walk", max_episode_steps=LIMIT)
"""


@pytest.fixture
def walk(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Record 400 random steps in an environment of its own; `ends` sets `terminated` and `truncated`."""
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.setenv("OFFBENCH_TRUST", "1")
    _env_cache.cache_clear()  # it may have another module's Walk-v0

    def record(ends: str = "terminated = truncated = False", limit: int = 20, steps: int = 400) -> str:
        (home / "walk.py").write_text(WALK.replace("ENDS", ends).replace("LIMIT", str(limit)))
        (home / "walk.toml").write_text('env_id = "walk:Walk-v0"\n')
        return offbench.collect(home / "walk.toml", "random", steps=steps, workers=1)

    yield record
    gym.registry.pop("Walk-v0", None)


@pytest.mark.parametrize("noise", [2e-16, 1e-3])
def test_rounding_of_float32_observations_and_of_rewards(noise: float, walk: Any) -> None:
    name = walk()
    assert codes(name) == set()
    sys.modules["walk"].NOISE = noise  # type: ignore[attr-defined]
    report = verify(name, workers=1)
    if noise > 1e-6:
        assert {finding.code for finding in report.findings} <= {"other-physics", "other-rewards"}
        assert not report.ok
        return
    assert report.ok, report.lines()
    assert any("differ, at first in the last bits only" in warning for warning in report.warnings)
    assert not any("bit for bit" in line for line in report.checked)
    assert not any("no seed" in line for line in report.skipped)


def test_an_environment_that_truncates_itself_keeps_its_level(walk: Any) -> None:
    """Episodes that it truncates count in the mean return, not only those that it terminates."""
    ends = "terminated, truncated = bool(self.np_random.random() < 0.02), self.t >= 20\n"
    ends += "        reward = -10.0 if terminated else 0.6"
    assert codes(walk(ends, limit=1000, steps=3000)) == set()


def test_an_environment_that_terminates_at_its_limit(walk: Any) -> None:
    name = walk("terminated, truncated = self.t >= 10, False", limit=10)
    report = verify(name, workers=1)
    assert report.ok, report.lines()
    assert any("where the environment terminates too" in warning for warning in report.warnings)
    assert codes(name, episodes=0) == {"timeouts-as-terminations"}  # nothing shows it


def test_an_environment_that_fails_on_replay_is_a_finding(walk: Any) -> None:
    def edit(file: h5py.File) -> None:
        for group in list(each(file))[:2]:
            actions = group["actions"][()]
            actions[3] = 1.5
            replace(group, "actions", actions)

    report = verify(tamper(walk(), edit), workers=1)
    found = {finding.code: finding for finding in report.findings}
    assert set(found) == {"action-bounds", "not-replayable"}
    assert found["not-replayable"].count == 2
    assert "bad action" in found["not-replayable"].what


def test_unbounded_actions_are_played_again(monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder) -> None:
    """Gymnasium's MuJoCo environments can be given a space without bounds by a wrapper of one's own."""
    from offbench.verification.resimulate import _StateSetter
    from offbench.verification.scan import _ClippingDetector

    env = gym.make("Hopper-v5")
    space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    monkeypatch.setattr(env, "action_space", space)
    assert _StateSetter.of(env) is not None
    detector = _ClippingDetector(space)
    detector.add(np.full((50, 3), 0.5, np.float32))
    detector.report(offbench.verification.findings.Findings())  # type: ignore[attr-defined]
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]
