"""Statistics of few seeds on several tasks, after Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (NeurIPS 2021): interquartile mean, probability of improvement, performance profiles, and
stratified bootstrap intervals. docs/statistics.md has the formulas.

    scores = {"hopper-medium-v0": [51.2, 48.0, 55.1], "hopper-random-v0": [9.1, 8.7, 9.9]}    task: one score per seed

A task is a stratum: its seeds are resampled among themselves, so every resample has all tasks. The generator is
fixed: the same scores have the same interval. A task with a single seed shows no spread, so no interval is given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.seeds import Purpose, generator

Scores = Mapping[str, Sequence[float]]

RESAMPLES = 10_000
CURVE_RESAMPLES = 2_000  # for each point of a curve
EXACT_FLIPS = 14  # up to this many pairs, all sign patterns are tried


@dataclass(frozen=True)
class Estimate:
    """A number and its 95% interval; None where there are too few seeds for one."""

    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        return f"{self.value:z.1f} {self.span()}".rstrip()

    def span(self) -> str:
        """Return `[low, high]`, empty without an interval."""
        return "" if self.low is None or self.high is None else f"[{self.low:z.1f}, {self.high:z.1f}]"

    def __neg__(self) -> Estimate:
        low, high = (None if end is None else -end for end in (self.high, self.low))
        return Estimate(-self.value, low, high)

    def percent(self) -> Estimate:
        """Return a fraction as a percentage."""
        low, high = (None if end is None else 100 * end for end in (self.low, self.high))
        return Estimate(100 * self.value, low, high)


def iqm(scores: Scores, resamples: int = RESAMPLES) -> Estimate:
    """Return the interquartile mean over all runs of all tasks: the mean without the lowest and highest quarter.

    A quarter is rounded down to whole runs: three runs or fewer lose none, and their IQM is their mean.
    """
    return _estimate([scores], lambda resampled: _trimmed_mean(resampled[0]), resamples)


def improvement(a: Scores, b: Scores) -> Estimate:
    """Return the probability that a run of `a` scores above one of `b`, averaged over the tasks of both.

    On each task it is Mann and Whitney's U over the number of pairs of runs; a tie counts half.

    Raises:
        OffbenchError: they share no task.
    """
    tasks = [task for task in a if task in b]
    if not tasks:
        raise OffbenchError("the two methods share no task")
    pair = [{task: scores[task] for task in tasks} for scores in (a, b)]
    return _estimate(pair, lambda resampled: _share_above(*resampled), RESAMPLES)


def profile(scores: Scores, taus: Sequence[float]) -> list[Estimate]:
    """Return the performance profile: for each tau the fraction of runs that score above it."""
    resampled = _resample(scores, CURVE_RESAMPLES)
    fractions = [_fraction(_observed(scores), tau)[0] for tau in taus]
    spread = [_fraction(resampled, tau) if resampled else None for tau in taus]
    return [_with_interval(float(value), values) for value, values in zip(fractions, spread, strict=True)]


def curve(seeds: Array) -> list[Estimate]:
    """Return the mean over seeds of each column of `seeds` [seeds, steps], with its interval."""
    values = seeds.mean(0)
    if len(seeds) < 2:
        return [Estimate(float(value)) for value in values]
    picks = generator(0, Purpose.BOOTSTRAP).integers(len(seeds), size=(CURVE_RESAMPLES, len(seeds)))
    low, high = np.quantile(seeds[picks].mean(1), (0.025, 0.975), axis=0)
    return [Estimate(float(v), float(a), float(b)) for v, a, b in zip(values, low, high, strict=True)]


@dataclass(frozen=True)
class Paired:
    """The difference of A and B over pairs of runs (same task, same seed).

    Attributes:
        difference: difference of normalized scores, mean over seeds, then over tasks.
        standardized: mean over standard deviation of all pairs' differences; None where they do not vary.
        p: two-sided p-value of a sign-flip test.
        pairs: how many pairs there are.
    """

    difference: Estimate
    standardized: float | None
    p: float
    pairs: int


def paired(differences: Scores) -> Paired:
    """Return the statistics of A - B from the differences of each task, one for each seed that both have."""
    every = np.concatenate([np.asarray(values, np.float64) for values in differences.values()])
    spread = float(every.std(ddof=1)) if len(every) > 1 else 0.0
    return Paired(
        _estimate([differences], lambda resampled: _mean_of_means(resampled[0]), RESAMPLES),
        float(every.mean()) / spread if spread > 1e-12 * np.abs(every).max() else None,  # less is rounding
        _sign_flip(differences),
        len(every),
    )


def _sign_flip(differences: Scores) -> float:
    """Return the share of sign patterns whose |mean of means| is at least the observed one's."""
    weighted = np.concatenate([np.asarray(v) / (len(v) * len(differences)) for v in differences.values()])
    count = len(weighted)
    observed = abs(float(weighted.sum()))
    slack = 1e-12 * float(np.abs(weighted).max())  # sums in another order differ by rounding
    if count <= EXACT_FLIPS:
        bits = np.arange(2**count)[:, None] >> np.arange(count) & 1
        return float((np.abs((1 - 2 * bits) @ weighted) >= observed - slack).mean())
    signs = generator(1, Purpose.BOOTSTRAP).choice((-1.0, 1.0), size=(RESAMPLES, count))
    hits = int((np.abs(signs @ weighted) >= observed - slack).sum())
    return (hits + 1) / (RESAMPLES + 1)  # the observed pattern is one of them


def _observed(scores: Scores) -> list[Array]:
    """Return each task's observed scores as an array [1, seeds]."""
    return [np.asarray(values, np.float64)[None] for values in scores.values()]


def _resample(scores: Scores, resamples: int, stream: int = 0) -> list[Array] | None:
    """Return resamples of each task's seeds [resamples, seeds]; None if a task has a single seed."""
    rng = generator(0, Purpose.BOOTSTRAP, stream)
    if min(len(values) for values in scores.values()) < 2:
        return None
    rows = (row[0] for row in _observed(scores))
    return [row[rng.integers(len(row), size=(resamples, len(row)))] for row in rows]


def _estimate(groups: Sequence[Scores], statistic: Callable[[list[list[Array]]], Array], resamples: int) -> Estimate:
    """Return a statistic of groups of runs, each resampled independently of the others."""
    value = float(statistic([_observed(scores) for scores in groups])[0])
    resampled = [_resample(scores, resamples, stream) for stream, scores in enumerate(groups)]
    complete = [parts for parts in resampled if parts is not None]
    return _with_interval(value, statistic(complete) if len(complete) == len(groups) else None)


def _with_interval(value: float, resampled: Array | None) -> Estimate:
    if resampled is None:
        return Estimate(value)
    low, high = np.quantile(resampled, (0.025, 0.975))
    return Estimate(value, float(low), float(high))


def _trimmed_mean(tasks: list[Array]) -> Array:
    from scipy import stats  # takes a second to import

    return np.asarray(stats.trim_mean(np.concatenate(tasks, 1), 0.25, axis=1))


def _share_above(a: list[Array], b: list[Array]) -> Array:
    per_task = []
    for mine, other in zip(a, b, strict=True):
        left, right = mine[:, :, None], other[:, None, :]
        per_task.append((left > right).mean((1, 2)) + 0.5 * (left == right).mean((1, 2)))
    return np.asarray(np.mean(per_task, 0))


def _fraction(tasks: list[Array], tau: float) -> Array:
    return np.asarray((np.concatenate(tasks, 1) > tau).mean(1))


def _mean_of_means(tasks: list[Array]) -> Array:
    return np.asarray(np.mean([part.mean(1) for part in tasks], 0))
