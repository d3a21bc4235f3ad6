"""Figures draw the numbers that NumPy and SciPy compute from the same scores."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import same_color
from scipy import stats

from offbench.analysis.results import Results, read_results
from offbench.common.arrays import Array
from offbench.reports import figures
from offbench.reports.figures import LineStyle
from offbench.reports.tables import iqms
from tests.made_runs import made_run

TASKS = ("hopper-random-v0", "hopper-medium-v0")
METHODS = ("td3_bc", "bdb")
STEPS = np.arange(1000, 13_000, 1000)  # a run's score is the mean of the last ten of its twelve evaluations
rng = np.random.default_rng(8)
CENTERS = np.array([[20.0, 35.0], [60.0, 48.0]])[:, :, None, None]
SCORES = CENTERS + rng.normal(0, 12, (2, 2, 5, 1)) + rng.normal(0, 6, (2, 2, 5, 12))  # [task, method, seed, step]
FINAL = SCORES[..., 2:].mean(-1)
LOSSES = rng.normal(50, 10, (2, 2, 5, 12)).round(3)  # losses.csv has six digits
BETAS = rng.uniform(0, 1, (2, 5, 12)).round(3)  # only bdb has them


@pytest.fixture
def results(home: Path) -> Results:
    for task, method, seed in np.ndindex(SCORES.shape[:3]):
        returns = dict(zip(STEPS.tolist(), (10 + 2 * SCORES[task, method, seed]).tolist(), strict=True))
        made = {"steps": 12_000, "returns": returns, "references": ([10.0, 210.0], None)}
        run = made_run(home / "runs", TASKS[task], METHODS[method], "default", seed, 0, **made)
        rows = {"step": STEPS, "q_abs": LOSSES[task, method, seed]}
        rows |= {"beta": BETAS[task, seed]} if METHODS[method] == "bdb" else {}
        run.write_losses([dict(zip(rows, map(float, row), strict=True)) for row in zip(*rows.values(), strict=True)])
    found = read_results(home / "runs")
    assert [task.dataset for task in found.tasks] == list(TASKS)
    assert [method.algorithm for method in found.methods] == list(METHODS)
    return found


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Axes]:
    """The axes of figures when they are saved, which takes no time here."""
    axes: list[Axes] = []

    def saved(fig: Any, kind: str) -> bytes:
        axes.extend(fig.axes if kind == "png" else ())
        return b"<svg >"

    monkeypatch.setattr(figures, "_saved", saved)
    monkeypatch.setattr(figures, "save", lambda fig, path: axes.extend(fig.axes))
    return axes


def lines(axes: Axes, style: LineStyle) -> list[Array]:
    """Return the lines [2, points] of a method."""
    return [np.array(line.get_data(), float) for line in axes.lines if line.get_color() == style.color]


def band(axes: Axes, style: LineStyle) -> tuple[Array, Array]:
    """Return the lower and the upper edge of a method's shaded band."""
    (shape,) = (shape for shape in axes.collections if same_color(shape.get_facecolor()[0, :3], style.color))
    x, y = shape.get_paths()[0].vertices.T
    low, high = np.array([(y[x == at].min(), y[x == at].max()) for at in np.unique(x)]).T
    return low, high


def interval(tasks: Array, statistic: Callable[..., Any]) -> tuple[Array, Array]:
    """Return SciPy's 95% interval of a statistic of scores [task, seed, ...], seeds resampled in each task."""

    def of_all(*samples: Array, axis: int) -> Any:
        return statistic(np.concatenate(samples, axis), axis=axis)

    settings: dict[str, Any] = {"axis": 0, "method": "percentile", "random_state": 0}
    low, high = stats.bootstrap(list(tasks), of_all, **settings).confidence_interval
    return low, high


def iqm(values: Array, axis: int) -> Array:
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def test_learning_curves_are_the_mean_over_seeds_and_its_interval(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    for task, name in enumerate(results.tasks):
        figure = figures.curve_figure(results.on(name), styles, "x")
        for place, method in enumerate(results.methods):
            seeds, style = SCORES[task, place], styles[method]
            np.testing.assert_allclose(lines(drawn[-1], style), [[STEPS, seeds.mean(0)]])
            np.testing.assert_allclose(band(drawn[-1], style), interval(seeds[None], np.mean), atol=1.2)
            assert f"{method.label} {seeds.mean(0)[-1]:.1f}" in figure.alt


def test_the_one_picture_of_all_curves_has_the_same_numbers(results: Results, drawn: list[Axes]) -> None:
    figures.plot_curves("runs", "curves.png")
    styles = figures.line_styles(results.methods)
    for axes, scores in zip(drawn, SCORES, strict=True):
        for place, style in enumerate(styles.values()):
            np.testing.assert_allclose(lines(axes, style), [[STEPS, scores[place].mean(0)]])


def test_final_scores_are_dots_and_their_mean(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    for task, name in enumerate(results.tasks):
        figure = figures.final_figure(results.on(name), styles, "x")
        for row, method in enumerate(results.methods):
            scores = FINAL[task, row]
            dots, bar = lines(drawn[-1], styles[method])
            np.testing.assert_allclose(dots, [scores, [row] * 5])
            np.testing.assert_allclose(bar[0], [scores.mean()] * 2)
            assert bar[1].mean() == pytest.approx(row)
            assert f"{method.label} {scores.mean():.1f}" in figure.alt


def test_interquartile_means_and_their_intervals(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    figure = figures.iqm_figure(iqms(results), styles)
    for row, method in enumerate(results.methods):
        value, ends = stats.trim_mean(FINAL[:, row].ravel(), 0.25), interval(FINAL[:, row], iqm)
        span, bar = lines(drawn[0], styles[method])
        np.testing.assert_allclose(span[0], ends, atol=0.5)
        np.testing.assert_allclose(span[1], [row] * 2)
        np.testing.assert_allclose(bar[0], [value] * 2)
        assert bar[1].mean() == pytest.approx(row)
        assert f"{method.label} {value:.1f} [{span[0, 0]:.1f}, {span[0, 1]:.1f}]" in figure.alt


def test_profiles_are_the_shares_of_runs_above_each_score(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    figure = figures.profile_figure(iqms(results), styles)
    for place, method in enumerate(results.methods):
        scores = FINAL[:, place]
        ((taus, shares),) = lines(drawn[0], styles[method])
        np.testing.assert_allclose(taus, np.linspace(FINAL.min(), 100, len(taus)))
        above = scores[..., None] > taus
        np.testing.assert_allclose(shares[1:], above.mean((0, 1))[1:])  # the first is equal to a score
        edges = np.array(band(drawn[0], styles[method]))[:, 1::12]
        np.testing.assert_allclose(edges, interval(above[..., 1::12], np.mean), atol=0.1001)  # a run more or less
        assert f"{method.label} {100 * (scores > 50).mean():.0f}%" in figure.alt


def test_the_curve_over_tasks_is_the_interquartile_mean_at_each_step(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    figures.iqm_curve_figure(results, styles)
    for place, method in enumerate(results.methods):
        scores = SCORES[:, place]
        means = stats.trim_mean(scores.reshape(10, 12), 0.25)
        np.testing.assert_allclose(lines(drawn[0], styles[method]), [[STEPS, means]])
        np.testing.assert_allclose(band(drawn[0], styles[method]), interval(scores, iqm), atol=1.2)


def test_losses_are_the_mean_over_seeds_and_their_range(results: Results, drawn: list[Axes]) -> None:
    styles = figures.line_styles(results.methods)
    for task, name in enumerate(results.tasks):
        figure = figures.loss_figure(results.on(name), styles, "x", "q_abs", "|Q|")
        betas = figures.loss_figure(results.on(name), styles, "x", "beta", "beta")
        assert figure is not None
        assert betas is not None
        for place, (method, style) in enumerate(styles.items()):
            values = LOSSES[task, place]
            np.testing.assert_allclose(lines(drawn[-2], style), [[STEPS, values.mean(0)]])
            np.testing.assert_allclose(band(drawn[-2], style), [values.min(0), values.max(0)])
            assert f"{method.label} {values.mean(0)[-1]:.3g} at 12,000" in figure.alt
        without, one = styles.values()
        assert lines(drawn[-1], without) == []
        np.testing.assert_allclose(lines(drawn[-1], one), [[STEPS, BETAS[task].mean(0)]])
        np.testing.assert_allclose(band(drawn[-1], one), [BETAS[task].min(0), BETAS[task].max(0)])
