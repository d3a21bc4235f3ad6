"""Scores: normalization by references, and statistics over a few seeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

Evaluations = Mapping[int, Sequence[tuple[float, int]]]  # {step: [(return, length) of each episode]}
MAX_VALUE = 1e15  # limit of steps, returns and references: scores and their squares stay finite
MIN_REFERENCE_GAP = 1e-12  # between the references of a score


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of `values` and its 95% interval (Student's t).

    One value has no interval: both ends are the value itself.
    """
    from scipy import stats

    data = np.asarray(values, np.float64)
    mean = float(data.mean())
    if len(data) < 2:
        return mean, mean, mean
    half = float(stats.t.ppf(0.975, len(data) - 1) * data.std(ddof=1) / np.sqrt(len(data)))
    return mean, mean - half, mean + half


def are_references(low: float, high: float) -> bool:
    """Return whether returns can be normalized by these two: finite, and the expert's above the random policy's."""
    return max(abs(low), abs(high)) < MAX_VALUE and high - low >= MIN_REFERENCE_GAP


def normalize(value: float, low: float, high: float) -> float:
    """Return 100 (value - low) / (high - low): 0 for the random policy, 100 for the expert (D4RL)."""
    return 100.0 * (value - low) / (high - low)


SCORED_EVALUATIONS = 10  # evaluations that a run's score is the mean of


def window(evaluations: Evaluations) -> tuple[int, ...]:
    """Return the steps of the evaluations that a run's score is the mean of: its last 10."""
    return tuple(sorted(evaluations)[-SCORED_EVALUATIONS:])


def check_steps(steps: Sequence[int], every: int) -> None:
    """Check that the evaluations of a run are those due every `every` updates; the last one may come earlier.

    Raises:
        ValueError: one is missing, or is of a step at which none is due.
    """
    for due, step in zip(itertools.count(every, every), steps, strict=False):
        if step > due:
            raise ValueError(f"the evaluation of step {due} is missing")
        if step < due and step != steps[-1]:
            raise ValueError(f"there is an evaluation of step {step}, and one is due every {every} steps")


def run_return(evaluations: Evaluations) -> float:
    """Return a run's mean return over its last 10 evaluations (never its best checkpoint)."""
    means = [np.mean([value for value, _ in evaluations[step]]) for step in window(evaluations)]
    return float(np.mean(means))


def mean_std(values: Sequence[float]) -> tuple[float, float | None]:
    """Return mean and sample standard deviation (n - 1) over seeds; None for the deviation of one seed."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None


def plus_minus(mean_and_std: tuple[float, float | None]) -> str:
    """Return `mean ± std`; one seed has no spread, which is not a spread of 0: `mean ± ?`."""
    mean, std = mean_and_std
    return f"{mean:z.1f} ± " + ("?" if std is None else f"{std:.1f}")
