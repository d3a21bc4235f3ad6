"""Learning curves of all runs below a folder as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from offbench.analysis.results import read_results
from offbench.analysis.statistics import curve
from offbench.common.plotting import figure, picture_file, save


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
            steps, values = entry.drawn_curve()
            points = curve(values)
            (line,) = axes.plot(
                steps,
                [p.value for p in points],
                marker="" if entry.smoothed else "o",
                markersize=3,
                label=method.label,
            )
            if points and points[0].low is not None:
                low, high = np.array([(p.low, p.high) for p in points], float).T
                axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            unit = "normalized score" if task.reference else "return"
            axes.set(title=task.name, xlabel="updates", ylabel=unit)
        for axes in panels:
            axes.legend(frameon=False, fontsize="small")
        return save(fig, path)
