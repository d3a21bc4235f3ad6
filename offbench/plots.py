"""Pictures: matplotlib without a screen, written whole or not at all."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from offbench.errors import OffbenchError
from offbench.files import output_file, write_bytes
from offbench.runs import DIGITS, Run
from offbench.scores import normalize
from offbench.tables import ambiguous, evaluated_groups

FORMATS = ("png", "svg", "pdf")


@contextlib.contextmanager
def figure(panels: int = 1) -> Iterator[tuple[Any, list[Any]]]:
    """Yield (figure, axes of each panel side by side)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(6.4 * panels, 4.0), layout="constrained")
    FigureCanvasAgg(fig)
    axes = [fig.add_subplot(1, panels, i + 1) for i in range(panels)]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
    yield fig, axes


def picture_file(path: str | Path) -> Path:
    """Return the path of a picture that a user asks for. Raises OffbenchError for an unknown ending, or no folder."""
    path = Path(path)
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise OffbenchError(f"a picture's name must end in {', '.join('.' + f for f in FORMATS)}, not {path.name!r}")
    return output_file(path)


def save(fig: Any, path: Path) -> Path:
    """Write a figure in the format of its name's ending."""
    data = io.BytesIO()
    fig.savefig(data, format=path.suffix.lstrip(".").lower(), dpi=150)
    write_bytes(path, data.getvalue())
    return path


def plot_curves(runs: str | Path, path: str | Path) -> Path:
    """Draw the score of every variant below a folder against updates: mean and range over seeds, a panel a dataset.

    Raises:
        OffbenchError: there are no evaluated runs, or the picture cannot be written.
    """
    path = picture_file(path)
    groups = evaluated_groups(runs)
    twins = ambiguous(groups)
    titles = {key: f"{key[0]} ({key[3][:DIGITS]})" if key[0] in twins else key[0] for key in groups}
    datasets = list(dict.fromkeys(titles.values()))
    with figure(len(datasets)) as (fig, panels):
        for key, group in groups.items():
            axes = panels[datasets.index(titles[key])]
            pair = group[0][1]["references"]["dataset"]
            curves = [_curve(run, pair) for run, _ in group]
            steps = sorted(set.intersection(*(set(curve) for curve in curves)))
            values = np.array([[curve[step] for step in steps] for curve in curves])
            name = f"{key[1]} {key[2]}".removesuffix(" default")
            (line,) = axes.plot(steps, values.mean(0), marker="o", markersize=3, label=name)
            axes.fill_between(steps, values.min(0), values.max(0), color=line.get_color(), alpha=0.15, linewidth=0)
            axes.set(title=titles[key], xlabel="updates", ylabel="normalized score" if pair else "return")
        for axes in panels:
            axes.legend(frameon=False, fontsize="small")
        return save(fig, path)


def _curve(run: Run, pair: tuple[float, float] | None) -> dict[int, float]:
    means = {step: float(np.mean([value for value, _ in rows])) for step, rows in run.evaluations().items()}
    return {step: normalize(mean, *pair) if pair else mean for step, mean in means.items()}
