"""Pictures: matplotlib without a screen, written whole or not at all."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from offbench.errors import OffbenchError
from offbench.files import output_file, write_bytes
from offbench.results import read_results
from offbench.statistics import curve

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
    """Draw the score of every variant below a folder against updates: mean and 95% interval, a panel a dataset.

    Raises:
        OffbenchError: there are no evaluated runs, or the picture cannot be written.
    """
    path = picture_file(path)
    results = read_results(runs)
    with figure(len(results.tasks)) as (fig, panels):
        for (task, method), entry in results.entries.items():
            axes = panels[results.tasks.index(task)]
            steps, values = entry.common_curve()
            points = curve(values)
            (line,) = axes.plot(steps, [p.value for p in points], marker="o", markersize=3, label=method.label)
            if points and points[0].low is not None:
                low, high = [p.low for p in points], [p.high for p in points]
                axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            unit = "normalized score" if task.reference else "return"
            axes.set(title=task.name, xlabel="updates", ylabel=unit)
        for axes in panels:
            axes.legend(frameon=False, fontsize="small")
        return save(fig, path)
