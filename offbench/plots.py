"""Pictures: matplotlib without a screen, written whole or not at all."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from offbench.errors import OffbenchError
from offbench.files import write_bytes
from offbench.runs import find_runs
from offbench.scores import normalize

FORMATS = ("png", "svg", "pdf")


@contextlib.contextmanager
def figure(width: float = 6.4, height: float = 4.0) -> Iterator[tuple[Any, Any]]:
    """Yield (figure, axes), closed afterwards."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(fig)
    axes = fig.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    yield fig, axes


def save(fig: Any, path: str | Path) -> Path:
    """Write a figure in the format of its name's ending. Raises OffbenchError for an unknown ending."""
    path = Path(path)
    style = path.suffix.lstrip(".").lower()
    if style not in FORMATS:
        raise OffbenchError(f"a picture's name must end in {', '.join('.' + f for f in FORMATS)}, not {path.name!r}")
    data = io.BytesIO()
    fig.savefig(data, format=style, dpi=150)
    write_bytes(path, data.getvalue())
    return path


def plot_curves(runs: str | Path, path: str | Path) -> Path:
    """Draw the normalised score of every variant below a folder against updates: mean and range over seeds.

    Runs without a reference are drawn by their return.
    """
    groups: dict[str, list[dict[int, float]]] = {}
    for run in find_runs(Path(runs)):
        config, evaluations = run.config(), run.evaluations()
        pair = (config.get("references") or {}).get("dataset")
        name = f"{config['algorithm']} {config['variant']}".removesuffix(" default")
        means = {step: float(np.mean([value for value, _ in rows])) for step, rows in evaluations.items()}
        groups.setdefault(name, []).append({s: normalize(m, *pair) if pair else m for s, m in means.items()})
    with figure() as (fig, axes):
        for name, curves in sorted(groups.items()):
            steps = sorted(set.intersection(*(set(curve) for curve in curves)))
            values = np.array([[curve[step] for step in steps] for curve in curves])
            (line,) = axes.plot(steps, values.mean(0), marker="o", markersize=3, label=name)
            axes.fill_between(steps, values.min(0), values.max(0), color=line.get_color(), alpha=0.15, linewidth=0)
        axes.set(xlabel="updates", ylabel="normalized score")
        axes.legend(frameon=False)
        return save(fig, path)
