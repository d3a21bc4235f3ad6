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


Curve = dict[float, float]  # {step: score}


def scores(entries: list[Entry], curves: list[Curve]) -> list[str]:
    """Return a table of the scores: a row for each evaluation, a column for each method."""
    steps = sorted(set().union(*curves))
    rows = [[f"{step:,.0f}", *(f"{c[step]:.1f}" if step in c else "-" for c in curves)] for step in steps]
    return aligned(["step", *(entry.method.label for entry in entries)], rows, names=0)


def _curve(entry: Entry) -> Curve:
    steps, values = entry.drawn_curve()
    return dict(zip(steps, values.mean(0).tolist(), strict=True))


def second_half(entries: list[Entry], curves: list[Curve]) -> list[str]:
    """Return a line on each method's scores in the second half of its updates, compared with the first method's."""
    lines, first = [], curves[0]
    for entry, curve in zip(entries, curves, strict=True):
        late = [step for step in curve if step >= max(curve) / 2]
        values = [curve[step] for step in late]
        line = f"{entry.method.label}: {min(values):.1f} to {max(values):.1f} from {late[0]:,.0f} updates on, "
        line += f"mean {np.mean(values):.1f}"
        if curve is not first and set(curve) <= set(first):
            above = [step for step in late if curve[step] > first[step]]
            line += f"; above {entries[0].method.label} at {len(above)} of {len(late)} evaluations"
            last = max((step for step in curve if curve[step] <= first[step]), default=0)
            if always := [step for step in curve if step > last]:
                line += f", at all from {always[0]:,.0f} updates on"
        lines.append(line)
    return lines


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
        curves = [_curve(entry) for entry in entries]
        lines = [*scores(entries, curves), "", *second_half(entries, curves), *map(evaluations, entries)]
        lines += [line for entry in entries for line in logged(entry)]
        print("\n".join([task.name, *lines, ""]))


if __name__ == "__main__":
    main()
