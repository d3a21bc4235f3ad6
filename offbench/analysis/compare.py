"""`compare`: two methods, paired over datasets and seeds, with a verdict in words."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from offbench.analysis.evaluated_run import EvaluatedRun, keys_with_mixed_code, window_text
from offbench.analysis.methods import find_method, unnamed_settings
from offbench.analysis.results import (
    REFERENCES,
    Entry,
    Task,
    differing_settings_notes,
    read_results,
)
from offbench.analysis.statistics import Estimate, Paired, improvement, paired
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.text import aligned, counted, from_to, plural

LEVEL = 0.05  # a difference is evidence below this p, if its interval leaves out 0 too


@dataclass(frozen=True)
class Pair:
    """The scores of A's and B's run of one dataset and seed."""

    dataset: str
    seed: int
    a: float
    b: float


@dataclass(frozen=True, repr=False)
class Comparison:
    """A against B over the datasets and seeds that both have.

    Attributes:
        a, b: the names of the methods.
        pairs: the scores that everything else is computed from.
        reference: what the scores are normalized by, in words.
        statistics: statistics of the difference A - B.
        chance: probability that a run of A scores above one of B, over the paired runs.
        unpaired: how many runs of either have no partner and are left out.
        windows: the evaluations behind the scores of A's and of B's paired runs, in words.
        comparable: whether both runs of each pair are scored over evaluations at the same steps.
        unfinished: how many of the paired runs have not reached their last step, or have diverged.
        changed: the algorithms whose paired runs were trained by different code.
        notes: settings that the methods' names leave out, and settings in which the runs of one method differ.
    """

    a: str
    b: str
    pairs: list[Pair]
    reference: str
    statistics: Paired
    chance: Estimate
    unpaired: int
    windows: tuple[str, str]
    comparable: bool
    unfinished: int
    changed: tuple[str, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the verdict."""
        return f"Comparison({self.a} against {self.b}: {self.verdict})"

    @property
    def verdict(self) -> str:
        """Which method is better, or that there is no evidence of a difference."""
        estimate, sizes = self.statistics.difference, Counter(pair.dataset for pair in self.pairs)
        over = f"{from_to(sizes.values())} {plural(max(sizes.values()), 'seed')}"
        over += f" on {len(sizes)} datasets" if len(sizes) > 1 else ""
        if not self.comparable:
            return "no verdict: the scores are of evaluations at different steps"
        sign = favored(self.statistics)
        if not sign:
            return f"no evidence of a difference with {over}"
        return f"{self.a if sign > 0 else self.b} is better: +{estimate if sign > 0 else -estimate} with {over}"

    @property
    def title(self) -> str:
        """The two methods, and what the scores are normalized by."""
        return f"{self.a} against {self.b} ({self.reference})"

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return the header and the rows of a table of the pairs."""
        header = ["dataset", "seed", self.a, self.b, "difference"]
        return header, [
            [p.dataset, str(p.seed), f"{p.a:z.1f}", f"{p.b:z.1f}", f"{p.a - p.b:+z.1f}"] for p in self.pairs
        ]

    def lines(self) -> list[str]:
        """Return the comparison as text."""
        return [self.title, "", *aligned(*self.table()), "", *self.conclusion()]

    def conclusion(self) -> list[str]:
        """Return statistics, notes and verdict as text."""
        statistics = self.statistics
        effect = "-" if statistics.standardized is None else f"{statistics.standardized:+.2f}"
        pairs = counted(statistics.pairs, "paired difference")
        percent = self.chance.percent()
        lines = [
            f"mean difference             {statistics.difference.value:+.1f} {statistics.difference.span()}".rstrip(),
            f"standardized                {effect} (over the deviation of {pairs})",
            f"probability of improvement  {percent.value:.0f}% {percent.span()}".rstrip(),
            f"sign-flip test              p = {statistics.p:.3g}",
        ]
        if not self.comparable:
            lines.append(
                f"note: evaluated at different steps: {self.a} {self.windows[0]}; {self.b} {self.windows[1]}; train "
                "both to the same --steps with the same --eval-every"
            )
        if self.unfinished:
            lines.append(f"note: {self.unfinished} of the paired runs did not reach their last step")
        lines += [f"note: {text}" for text in self.notes]
        for algorithm in self.changed:
            lines.append(f"note: the runs of {algorithm} were trained by different code")
        if self.unpaired:
            verbs = ("has", "is") if self.unpaired == 1 else ("have", "are")
            lines.append(
                f"note: {counted(self.unpaired, 'run')} {verbs[0]} no partner of the same dataset and seed "
                f"and {verbs[1]} left out"
            )
        return [*lines, "", self.verdict]

    def row(self) -> JsonObject:
        """Return the comparison as a JSON object."""
        statistics, chance = self.statistics, self.chance
        return {
            "a": self.a,
            "b": self.b,
            "reference": self.reference,
            "difference": statistics.difference.value,
            "low": statistics.difference.low,
            "high": statistics.difference.high,
            "standardized": statistics.standardized,
            "p": statistics.p,
            "probability_of_improvement": chance.value,
            "probability_low": chance.low,
            "probability_high": chance.high,
            "pairs": [dataclasses.asdict(pair) for pair in self.pairs],
            "unpaired": self.unpaired,
            "unfinished": self.unfinished,
            "comparable": self.comparable,
            "changed": list(self.changed),
            "notes": list(self.notes),
            "verdict": self.verdict,
        }


def compare(a: str, b: str, *, runs: str | Path = "runs", steps: int | None = None) -> Comparison:
    """Compare two methods over the datasets and seeds that both have.

    Args:
        a, b: the names of two methods as in tables, e.g. `td3_bc` and `bdb (beta=0.5)`; or ALGO/VARIANT, as
            in folders. An algorithm alone is its default variant, or its only one.
        runs: the folder of the run directories.
        steps: compare the runs as they were after so many updates; shorter ones as they are.

    Raises:
        OffbenchError: an unknown method, twice the same one, or no dataset and seed in common.
    """
    results = read_results(runs, steps=steps)
    groups = tuple(results.of(find_method(results.methods, name)) for name in (a, b))
    if groups[0] == groups[1]:
        raise OffbenchError(f"{a} and {b} are the same method; give two different ones")
    run_pairs = pair_runs(*groups)
    if not run_pairs:
        raise OffbenchError(f"{a} and {b} share no dataset with a seed in common: there is nothing to pair")
    tasks = {task for task, *_ in run_pairs}
    if len(tasks) > 1 and any(task.reference is None for task in tasks):
        raise OffbenchError(
            "a dataset without reference scores has raw returns, which do not average with other datasets' scores; "
            "give a --runs folder of one dataset"
        )
    pairs = _scored(run_pairs)
    unnamed = unnamed_settings(group[0].method for group in groups)
    sides = [[one for _, one, _ in run_pairs], [other for *_, other in run_pairs]]
    return Comparison(
        groups[0][0].method.label,
        groups[1][0].method.label,
        pairs,
        " and ".join(sorted({REFERENCES[task.reference] for task in tasks})),
        paired(differences(run_pairs)),
        improvement(_by_dataset(pairs, lambda pair: pair.a), _by_dataset(pairs, lambda pair: pair.b)),
        sum(len(entry.runs) for group in groups for entry in group) - 2 * len(run_pairs),
        (window_text(sides[0]), window_text(sides[1])),
        comparable(run_pairs),
        sum(t.state != "finished" for side in sides for t in side),
        tuple(keys_with_mixed_code((t.config.algorithm, t) for side in sides for t in side)),
        (
            *(f"settings of {text}" for text in unnamed),
            *differing_settings_notes(entry for group in groups for entry in group),
        ),
    )


RunPairs = Sequence[tuple[Task, EvaluatedRun, EvaluatedRun]]


def pair_runs(a: Iterable[Entry], b: Iterable[Entry]) -> RunPairs:
    """Return the runs of A and of B that have the same dataset and seed, in order of A's."""
    others = {(entry.task, run.seed): run for entry in b for run in entry.runs}
    mine = ((entry.task, run) for entry in a for run in entry.runs)
    return [(task, one, others[task, one.seed]) for task, one in mine if (task, one.seed) in others]


def comparable(run_pairs: RunPairs) -> bool:
    """Return whether both runs of each pair are scored over evaluations at the same steps."""
    return all(one.window == other.window for _, one, other in run_pairs)


def differences(run_pairs: RunPairs) -> dict[str, list[float]]:
    """Return {task: score of A's run minus score of B's, for each pair}."""
    return _by_dataset(_scored(run_pairs), lambda pair: pair.a - pair.b)


def favored(statistics: Paired) -> int:
    """Return 1 if A is better, -1 if B is, 0 if there is no evidence: interval and sign-flip test must agree."""
    low, high = statistics.difference.low, statistics.difference.high
    if low is None or high is None or low <= 0 <= high or statistics.p > LEVEL:
        return 0
    return 1 if low > 0 else -1


def _scored(run_pairs: RunPairs) -> list[Pair]:
    return [Pair(t.name, one.seed, one.score(t.reference), other.score(t.reference)) for t, one, other in run_pairs]


def _by_dataset(pairs: Iterable[Pair], value: Callable[[Pair], float]) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {}
    for pair in pairs:
        values.setdefault(pair.dataset, []).append(value(pair))
    return values
