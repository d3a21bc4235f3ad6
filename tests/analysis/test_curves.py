"""Learning curves as pictures show them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from offbench.analysis.results import LONG_CURVE, read_results
from tests.made_runs import made_run


def test_a_long_curve_shows_the_score_at_each_step() -> None:
    """Each point is the mean of the ten evaluations up to it, so the last one is the run's score."""
    rng = np.random.default_rng(0)
    returns = rng.uniform(0, 100, (2, 50))  # the references are 0 and 100: a score is a return
    for seed in range(2):
        made = {12_000 * (i + 1): value for i, value in enumerate(returns[seed].tolist())}
        made_run(Path("runs"), "hopper-medium-v0", "td3_bc", "default", seed, 0, steps=600_000, returns=made)
    (entry,) = read_results("runs").entries.values()
    steps, points = entry.drawn_curve()
    assert entry.smoothed
    assert len(steps) == 50
    assert points[:, 0] == pytest.approx(returns[:, 0])
    assert points[1, 3] == pytest.approx(returns[1, :4].mean())
    assert points[0, 30] == pytest.approx(returns[0, 21:31].mean())
    assert points[:, -1] == pytest.approx(entry.scores)


def test_a_short_curve_shows_each_evaluation() -> None:
    made_run(Path("runs"), "hopper-medium-v0", "td3_bc", "default", 0, 50.0)
    (entry,) = read_results("runs").entries.values()
    assert 0 < len(entry.common_curve()[0]) <= LONG_CURVE
    assert np.array_equal(entry.drawn_curve()[1], entry.common_curve()[1])
