"""Learning curves as pictures show them, the scores of one policy, and what recipes are scored by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from offbench.analysis.results import LONG_CURVE, read_results
from offbench.envs.recipes import load_recipe
from offbench.evaluation.evaluate import Evaluation
from offbench.reports.figures import iqm_curve_figure, line_styles
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


def test_the_curve_over_all_tasks_has_the_last_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 evaluations some are left out, but not the last; the caption names the means."""
    shown: list[list[int]] = []
    monkeypatch.setattr("offbench.reports.figures._band", lambda _, steps, *__: shown.append(list(steps)))
    returns = dict.fromkeys(range(5_000, 500_001, 5_000), 50.0)
    made_run(Path("runs"), "hopper-medium-v0", "td3_bc", "default", 0, 0, steps=500_000, returns=returns)
    results = read_results("runs")
    figure = iqm_curve_figure(results, line_styles(results.methods))
    assert figure is not None
    assert {steps[-1] for steps in shown} == {500_000}
    assert 20 < len(shown[0]) <= 50
    assert "Each point is the mean of the last 10 evaluations" in figure.caption


def test_one_episode_has_no_interval() -> None:
    one = Evaluation("policy", "Hopper-v5", [742.1], [200], {})
    assert one.lines()[1] == "return 742.1, length 200"
    two = Evaluation("policy", "Hopper-v5", [700.0, 800.0], [200, 220], {})
    assert "std 70.7, length 210" in two.lines()[1]  # sqrt(2 * 50^2 / (2 - 1))


def test_a_recipe_that_changes_d4rls_task_has_no_score_by_its_constants(home: Path) -> None:
    text = 'env_id = "Hopper-v5"\nd4rl_min = -20.3\nd4rl_max = 3234.3\n'
    (home / "plain.toml").write_text(text)
    (home / "changed.toml").write_text(text + "[env_kwargs]\nforward_reward_weight = 9.0\n")
    (home / "other.toml").write_text(text.replace("Hopper-v5", "Reacher-v5"))
    assert load_recipe("./plain.toml").d4rl_reference() == load_recipe("hopper").d4rl_reference()
    assert load_recipe("./changed.toml").d4rl_reference() is None
    assert load_recipe("./other.toml").d4rl_reference() == (-20.3, 3234.3)
