"""Figures that docs/results.md quotes beside the report: `python -m tests.observations docs/results/medium/runs`.

For each dataset: the score of each method at each evaluation (mean over seeds of the mean of the last ten evaluations
up to it), and what its evaluations and losses show.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from offbench.analysis.results import Entry, read_results
from offbench.common.text import aligned

SETTLED = 50_000  # updates after which the ranges of logged quantities are given
LOGGED = ("beta", "uncertainty")


def scores(entries: list[Entry]) -> list[str]:
    """Return a table of the scores: a row for each evaluation, a column for each method."""
    curves = [dict(zip(*(part.T.tolist() for part in _curve(entry)), strict=True)) for entry in entries]
    steps = sorted(set().union(*curves))
    rows = [[f"{step:,.0f}", *(f"{c[step]:.1f}" if step in c else "-" for c in curves)] for step in steps]
    return aligned(["step", *(entry.method.label for entry in entries)], rows, names=0)


def _curve(entry: Entry) -> tuple[np.ndarray, np.ndarray]:
    steps, values = entry.drawn_curve()
    return np.array(steps), values.mean(0)


def evaluations(entry: Entry) -> str:
    """Return a line on the episodes of the last ten evaluations, and on the differences between evaluations."""
    lengths = [length for run in entry.runs for step in run.window for _, length in run.evaluations[step]]
    longest = max(length for run in entry.runs for rows in run.evaluations.values() for _, length in rows)
    changes = [np.abs(np.diff(list(run.curve(entry.task.reference).values()))).mean() for run in entry.runs]
    share = 100 * np.mean(np.array(lengths) == longest)
    return (
        f"{entry.method.label}: {share:.0f}% of the last episodes take {longest:,} steps, half of them at most "
        f"{np.median(lengths):.0f}; successive evaluations differ by {np.mean(changes):.1f}"
    )


def logged(entry: Entry) -> list[str]:
    """Return a line for the range of each logged quantity after SETTLED updates, over all runs."""
    lines = []
    for name in LOGGED:
        values = [row[name] for run in entry.runs for row in run.losses if name in row and row["step"] > SETTLED]
        if values and min(values) < max(values):
            lines.append(
                f"{entry.method.label}: {name} {min(values):.2f} to {max(values):.2f} after {SETTLED:,} updates"
            )
    return lines


def main() -> None:
    """Print the figures of all runs below a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    results = read_results(parser.parse_args().runs)
    for task in results.tasks:
        entries = results.on(task)
        lines = [*scores(entries), "", *map(evaluations, entries), *(line for e in entries for line in logged(e))]
        print("\n".join([task.name, *lines, ""]))


if __name__ == "__main__":
    main()
