"""What few seeds can tell: `python -m tests.few_seeds` writes docs/results/few-seeds.md, for docs/statistics.md.

Methods whose scores are normal numbers of mean 0 and deviation 1 on every task, so the truth is known: the
interquartile mean is 0, and two of them are equal.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from offbench.analysis.compare import favored
from offbench.analysis.statistics import iqm, paired
from offbench.common.tables import markdown

SIZES = ((1, 3), (1, 5), (1, 10), (3, 3), (3, 5), (15, 3), (15, 5))  # tasks, seeds
SIMULATIONS = 600
RESAMPLES = 2_000  # for the coverage
FILE = Path(__file__).parent.parent / "docs" / "results" / "few-seeds.md"
HEADER = [
    "tasks",
    "seeds",
    "the interval covers",
    "equal methods: interval leaves out 0",
    "and p ≤ 0.05 (our verdict)",
]


def simulate(tasks: int, seeds: int, simulations: int = SIMULATIONS) -> tuple[float, float, float]:
    """Return how often the IQM's interval covers 0, that of a difference leaves it out, and a verdict is given."""
    counts = np.zeros(3)
    for i in range(simulations):
        rng = np.random.default_rng((tasks, seeds, i))
        a, b = rng.normal(size=(2, tasks, seeds))
        mean = iqm({str(t): list(row) for t, row in enumerate(a)}, RESAMPLES)
        found = paired({str(t): list(row) for t, row in enumerate(a - b)})
        counts += [
            covers(mean.low, mean.high),
            not covers(found.difference.low, found.difference.high),
            bool(favored(found)),
        ]
    first, second, third = counts / simulations
    return float(first), float(second), float(third)


def covers(low: float | None, high: float | None) -> bool:
    """Return whether an interval holds 0."""
    assert low is not None
    assert high is not None
    return low <= 0 <= high


def row(tasks: int, seeds: int) -> list[str]:
    """Return a size's row of the table."""
    return [str(tasks), str(seeds), *(f"{100 * share:.0f}%" for share in simulate(tasks, seeds))]


if __name__ == "__main__":
    FILE.write_text("\n".join(markdown(HEADER, [row(*size) for size in SIZES])) + "\n")
