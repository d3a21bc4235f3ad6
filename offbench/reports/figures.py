"""Figures of results: learning curves, final scores, IQM, performance profiles, beta and |Q| over training.

A figure is drawn once and saved in three forms: PNG and SVG files with a legend, and an SVG for the page without one
(the page has its own), in the page's text color, which is readable in light and dark mode.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from offbench.analysis.methods import Method
from offbench.analysis.results import REFERENCES, Entry, Results, Task, read_results
from offbench.analysis.statistics import Estimate, curve, iqm, profile
from offbench.common.arrays import Array
from offbench.common.plotting import default_style, figure, picture_file, save
from offbench.common.scores import MAX_VALUE, SCORED_EVALUATIONS
from offbench.common.text import compact, printable
from offbench.reports.tables import Aggregates

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure
    from matplotlib.lines import Line2D
    from matplotlib.typing import LineStyleType

TEXT_COLOR = "#21252b"  # text and axes; the page replaces it by its own text color
GRID = "#8b93a0"
# readable on white, on near-black and with color blindness (after Okabe and Ito)
COLORS = ("#2f7fc1", "#d0700f", "#1c9a72", "#c2588f", "#8a6fd1", "#b58a00", "#d1495b", "#6b7785")
DASHES: tuple[LineStyleType, ...] = ("-", (0, (5, 1.6)), (0, (1.4, 1.2)), (0, (6, 1.5, 1.4, 1.5)))
SIZE = (4.4, 2.9)
PROFILE_POINTS = 121


@dataclass(frozen=True)
class LineStyle:
    """The line of one method in all figures."""

    label: str
    color: str
    dashes: LineStyleType


@dataclass(frozen=True)
class Figure:
    """A figure as its files and as part of the page.

    Attributes:
        name: the stem of its files.
        caption: what it shows.
        alt: the same for those who cannot see it, with its main numbers.
        legend: the styles that its legend lists.
    """

    name: str
    caption: str
    alt: str
    png: bytes
    svg: bytes
    inline: str
    legend: tuple[LineStyle, ...]


def line_styles(methods: Sequence[Method]) -> dict[Method, LineStyle]:
    """Return color and dashes of each method; more methods than colors repeat the colors with other dashes."""
    return {
        method: LineStyle(method.label, COLORS[i % len(COLORS)], DASHES[(i + i // len(COLORS)) % len(DASHES)])
        for i, method in enumerate(methods)
    }


def curve_figure(entries: Sequence[Entry], styles: Mapping[Method, LineStyle], name: str) -> Figure:
    """Draw one task's learning curves: mean over seeds with its 95% interval (the paper's Figure 4)."""
    task = entries[0].task
    curves = {entry.method.label: entry.drawn_curve() for entry in entries}
    ends = [f"{label} {values.mean(0)[-1]:.1f}" for label, (steps, values) in curves.items() if steps]
    alt = f"Learning curves on {task.name}. At the last common evaluation: {', '.join(ends)}."
    caption = "Mean over seeds, 95% bootstrap interval shaded."
    caption += _smoothing(entries)
    shown = [styles[entry.method] for entry in entries]
    return _draw(name, caption, alt, lambda axes: _paint_curves(axes, entries, styles), shown)


def _smoothing(entries: Sequence[Entry]) -> str:
    """Return the sentence of a caption that names the curves whose points are means, "" if there are none."""
    smoothed = list(dict.fromkeys(entry.method.label for entry in entries if entry.smoothed))
    if not smoothed:
        return ""
    which = "Each point" if all(entry.smoothed for entry in entries) else f"Each point of {', '.join(smoothed)}"
    return f" {which} is the mean of the last {SCORED_EVALUATIONS} evaluations up to it."


def _paint_curves(axes: Axes, entries: Sequence[Entry], styles: Mapping[Method, LineStyle]) -> None:
    """Draw one task's learning curves."""
    for entry in entries:
        steps, values = entry.drawn_curve()
        if steps:
            _band(axes, steps, curve(values), styles[entry.method])
    axes.set(xlabel="updates", ylabel=_unit(entries[0].task), title=shortened(entries[0].task.name, 44))


def plot_curves(runs: str | Path, path: str | Path, steps: int | None = None) -> Path:
    """Draw the learning curves of all runs below a folder as one figure, a panel for each dataset.

    Args:
        steps: only so many updates of each run.

    Raises:
        OffbenchError: there are no evaluated runs, or the figure cannot be written.
    """
    path = picture_file(path)
    results = read_results(runs, steps=steps)
    styles = line_styles(results.methods)
    with default_style(_rc_params(path.stem)):
        fig, panels = figure(len(results.tasks))
        for axes, task in zip(panels, results.tasks, strict=True):
            entries = results.on(task)
            _paint_curves(axes, entries, styles)
            axes.legend(*_legend([styles[entry.method] for entry in entries]), frameon=False, fontsize="small")
        return save(fig, path)


def final_figure(entries: Sequence[Entry], styles: Mapping[Method, LineStyle], name: str) -> Figure:
    """Draw one task's final scores: a dot per seed, a bar for their mean."""
    task = entries[0].task

    def paint(axes: Axes) -> None:
        for row, entry in enumerate(entries):
            color = styles[entry.method].color
            axes.plot(entry.scores, [row] * len(entry.scores), "o", color=color, alpha=0.75, markersize=5, mew=0)
            axes.plot([np.mean(entry.scores)] * 2, [row - 0.32, row + 0.32], color=color, linewidth=2)
        _named_rows(axes, [styles[entry.method].label for entry in entries])
        axes.set(xlabel=_unit(task), title=shortened(task.name, 44))

    means = ", ".join(f"{entry.method.label} {np.mean(entry.scores):.1f}" for entry in entries)
    return _draw(
        name, "One dot per seed; the bar is their mean.", f"Final scores on {task.name}. Means: {means}.", paint
    )


def iqm_figure(aggregates: Aggregates, styles: Mapping[Method, LineStyle]) -> Figure:
    """Draw every method's IQM with its interval."""

    def paint(axes: Axes) -> None:
        for row, (method, (estimate, _)) in enumerate(aggregates.items()):
            color = styles[method].color
            if estimate.low is not None and estimate.high is not None:
                axes.plot([estimate.low, estimate.high], [row, row], color=color, linewidth=7, alpha=0.35)
            axes.plot([estimate.value] * 2, [row - 0.3, row + 0.3], color=color, linewidth=2.5)
        _named_rows(axes, [styles[method].label for method in aggregates])
        axes.set(xlabel="IQM of normalized scores")

    text = ", ".join(f"{method.label} {estimate}" for method, (estimate, _) in aggregates.items())
    caption = "Interquartile mean over all tasks and its 95% stratified bootstrap interval."
    return _draw("iqm", caption, f"Interquartile means with 95% intervals: {text}.", paint)


def profile_figure(aggregates: Aggregates, styles: Mapping[Method, LineStyle]) -> Figure:
    """Draw the performance profiles: the fraction of runs above each score."""
    every = [value for _, scores in aggregates.values() for values in scores.values() for value in values]
    taus = np.linspace(min(0.0, min(every)), max(100.0, max(every)), PROFILE_POINTS)

    def paint(axes: Axes) -> None:
        for method, (_, scores) in aggregates.items():
            _band(axes, taus.tolist(), profile(scores, taus.tolist()), styles[method])
        axes.set(xlabel="normalized score τ", ylabel="fraction of runs above τ", ylim=(-0.02, 1.02))

    halves = {m.label: profile(s, [50.0])[0].value for m, (_, s) in aggregates.items()}
    text = ", ".join(f"{label} {100 * half:.0f}%" for label, half in halves.items())
    caption = "Fraction of all runs that score above τ, 95% stratified bootstrap interval shaded. Higher is better."
    return _draw(
        "profiles", caption, f"Performance profiles. Runs above 50: {text}.", paint, [styles[m] for m in aggregates]
    )


def iqm_curve_figure(results: Results, styles: Mapping[Method, LineStyle]) -> Figure | None:
    """Draw the IQM over all tasks against the updates, of the methods that have all tasks, where their runs meet.

    Returns:
        The figure, or None if no method has evaluations at a step of all tasks.
    """
    tasks = {task.name for task in results.tasks if task.reference}
    whole: dict[Method, tuple[list[int], dict[str, tuple[list[int], Array]]]] = {}
    for method in results.methods:
        curves = {e.task.name: e.drawn_curve() for e in results.of(method) if e.task.reference}
        steps = sorted(set.intersection(*(set(curve[0]) for curve in curves.values()))) if curves else []
        if steps and curves.keys() == tasks:
            whole[method] = _thinned(steps, 40), curves
    if not whole:
        return None

    def paint(axes: Axes) -> None:
        for method, (shown, curves) in whole.items():
            points = [iqm({t: v[:, s.index(step)].tolist() for t, (s, v) in curves.items()}, 2000) for step in shown]
            _band(axes, shown, points, styles[method])
        axes.set(xlabel="updates", ylabel="IQM of normalized scores", title="all tasks")

    caption = "Interquartile mean over all tasks, 95% interval shaded; methods that have all tasks."
    caption += _smoothing([entry for method in whole for entry in results.of(method)])
    alt = f"Learning curves of the interquartile mean over all tasks: {', '.join(m.label for m in whole)}."
    return _draw("curves-iqm", caption, alt, paint, [styles[method] for method in whole])


def loss_figure(
    entries: Sequence[Entry], styles: Mapping[Method, LineStyle], name: str, column: str, label: str
) -> Figure | None:
    """Draw a column of losses.csv over training: mean over seeds, their range shaded; None if no run has it."""
    task = entries[0].task
    series = {entry.method: one for entry in entries if (one := _column(entry, column))}
    if not series:
        return None

    def paint(axes: Axes) -> None:
        for method, (steps, values) in series.items():
            mean, low, high = values.mean(0), values.min(0), values.max(0)
            points = [Estimate(*map(float, row)) for row in zip(mean, low, high, strict=True)]
            _band(axes, steps, points, styles[method])
        if column == "beta":
            axes.set_ylim(-0.03, 1.03)
        axes.set(xlabel="updates", ylabel=label, title=shortened(task.name, 44))

    ends = [f"{method.label} {values.mean(0)[-1]:.3g} at {steps[-1]:,}" for method, (steps, values) in series.items()]
    alt = f"{label} over training on {task.name}. At the end: {', '.join(ends)}."
    return _draw(name, "Mean over seeds, range shaded.", alt, paint, [styles[method] for method in series])


def _column(entry: Entry, column: str) -> tuple[list[int], Array] | None:
    """Return (steps, values [runs, steps]) of the rows that all runs have; long series are thinned."""
    series = [{int(row["step"]): row[column] for row in t.losses if column in row} for t in entry.runs]
    steps = sorted(set.intersection(*(set(run) for run in series)))
    steps = _thinned(steps, 200)
    if not steps:
        return None
    values = np.array([[run[step] for step in steps] for run in series])
    # a diverging run may exceed what an axis can show
    return steps, np.where(np.abs(values) < MAX_VALUE, values, np.nan)


def _thinned(steps: Sequence[int], most: int) -> list[int]:
    """Return every n-th step up to the last one, less than twice `most` of them."""
    return list(steps[:: -max(1, len(steps) // most)][::-1])


def _band(axes: Axes, x: Sequence[float], points: Sequence[Estimate], style: LineStyle) -> None:
    values = [point.value for point in points]
    marker = "o" if len(x) == 1 else ""
    axes.plot(x, values, color=style.color, linestyle=style.dashes, linewidth=1.6, marker=marker, markersize=4)
    if all(point.low is not None for point in points):
        low, high = np.array([(point.low, point.high) for point in points], float).T
        axes.fill_between(x, low, high, color=style.color, alpha=0.16, linewidth=0)


def _named_rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), [_two_lines(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def _two_lines(name: str) -> str:
    """Return a long name on two lines, split after the first of its settings or, if it has one, before it."""
    if len(name) <= 24:
        return printable(name)
    head, comma, tail = name.partition("," if "," in name else " ")
    return f"{shortened(head + comma.rstrip(), 24)}\n{shortened(tail.lstrip(), 24)}".rstrip()


def shortened(text: str, most: int) -> str:
    """Return text without its middle where it is too long for a figure: variants differ at their ends."""
    text = printable(text)
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most - most // 2 - 1) :]}"


def _tick(value: float) -> str:
    """Return the label of a tick on the horizontal axis: `300k` for whole numbers, `22.5` for others."""
    return compact(round(value)) if abs(value) >= 10 and math.isclose(value, round(value)) else f"{value:g}"


def _unit(task: Task) -> str:
    return "return" if task.reference is None else f"normalized score ({REFERENCES[task.reference]})"


def _draw(
    name: str, caption: str, alt: str, paint: Callable[[Axes], None], legend: Sequence[LineStyle] = ()
) -> Figure:
    """Draw a figure and save it in its three forms."""
    from matplotlib.ticker import MaxNLocator

    with default_style(_rc_params(name)):
        fig, (axes,) = figure()
        fig.set_size_inches(*SIZE)
        fig.patch.set_alpha(0)
        axes.patch.set_alpha(0)
        paint(axes)
        axes.ticklabel_format(axis="x", style="plain", useOffset=False)
        axes.xaxis.set_major_formatter(lambda value, _: _tick(value))
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        inline = _saved(fig, "svg").decode()
        fig.patch.set_alpha(1)
        if legend:
            columns = 2 if max(len(style.label) for style in legend) <= 24 else 1
            fig.set_size_inches(SIZE[0], SIZE[1] + 0.2 * math.ceil(len(legend) / columns))
            fig.legend(
                *_legend(legend, 48), loc="outside lower center", ncols=columns, frameon=False, fontsize="small"
            )
        png, svg = _saved(fig, "png"), _saved(fig, "svg")
    return Figure(name, caption, alt, png, svg, _for_page(inline, name), tuple(legend))


def _rc_params(name: str) -> dict[str, Any]:
    """Return matplotlib's settings: a $ in a name is no formula, and the ids in an SVG are always the same."""
    return {
        "text.parse_math": False,
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "text.color": TEXT_COLOR,
        "axes.labelcolor": TEXT_COLOR,
        "xtick.color": TEXT_COLOR,
        "ytick.color": TEXT_COLOR,
        "axes.edgecolor": GRID,
        "axes.grid": True,
        "grid.color": GRID,
        "grid.alpha": 0.25,
        "grid.linewidth": 0.6,
        "font.size": 9,
        "axes.titlesize": 10,
    }


def _legend(styles: Sequence[LineStyle], most: int = 32) -> tuple[list[Line2D], list[str]]:
    """Return the lines and names of a legend: names shortened to `most` characters, numbered where they are alike."""
    from matplotlib.lines import Line2D

    cut = [shortened(style.label, most) for style in styles]
    names = [  # matplotlib hides labels that begin with _
        f" {text}" if cut.count(text) == 1 else f" {number}. {shortened(style.label, most - 4)}"
        for number, (style, text) in enumerate(zip(styles, cut, strict=True), 1)
    ]
    return [Line2D([], [], color=style.color, linestyle=style.dashes) for style in styles], names


def _saved(fig: MplFigure, kind: str) -> bytes:
    data = io.BytesIO()
    # no date and no version: the same runs give the same bytes
    nothing = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None, "Format": None, "Type": None}}
    fig.savefig(data, format=kind, dpi=160, metadata=nothing[kind])
    return data.getvalue()


def _for_page(svg: str, name: str) -> str:
    """Return an SVG to stand in the page: ids of its own, the page's text color and font, no fixed size."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<style .*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r' (width|height)="[^"]*pt"', "", svg, count=2)
    svg = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px system-ui, sans-serif", svg)
    return svg.replace(TEXT_COLOR, "currentColor").replace("<svg ", '<svg role="img" aria-hidden="true" ', 1)
