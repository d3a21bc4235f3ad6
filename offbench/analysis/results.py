"""Results: a folder of runs as tasks, methods and the scores of their seeds.

    Task    a dataset: its id and its content; the reference that its scores are normalized by
    Method  an algorithm and a variant
    Entry   the evaluated runs of one method on one task: a cell of the score table

Everything is read from the run directories alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase as fnmatch
from pathlib import Path

import numpy as np

from offbench.analysis.evaluated_run import EvaluatedRun, keys_with_mixed_code
from offbench.analysis.methods import Method, find_method, method_order, name_methods, rank
from offbench.common.arrays import Array
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import READ_REMEDIES
from offbench.common.scores import SCORED_EVALUATIONS, mean_std
from offbench.common.settings import check_count
from offbench.common.terminal import warn
from offbench.data.levels import LEVELS, env_and_level
from offbench.envs.environments import same_environment
from offbench.training.run import Run, find_runs
from offbench.training.run_config import RunConfig

# the order of the BDB paper's Table 1; levels are in its order already
ENV_ORDER = ("hopper", "walker2d", "halfcheetah")
REFERENCES = {"dataset": "own reference", "d4rl": "D4RL's constants", None: "no reference: raw return"}

SHORT_HASH = 8  # digits of a content hash that are shown if one dataset id has several contents
LONG_CURVE = 40  # evaluations; longer curves are drawn as means


@dataclass(frozen=True)
class Task:
    """A dataset that runs were trained on.

    Attributes:
        content_sha256: its content hash; the same id may have been recorded twice.
        reference: what scores are normalized by: "dataset", "d4rl" or None (raw returns).
        ambiguous: whether runs used another content under the same id.
    """

    dataset: str
    content_sha256: str
    reference: str | None
    ambiguous: bool = False

    @property
    def name(self) -> str:
        """The dataset's id, with its content's first digits where the id alone is ambiguous."""
        return f"{self.dataset} ({self.content_sha256[:SHORT_HASH]})" if self.ambiguous else self.dataset

    @property
    def env_and_level(self) -> tuple[str, str]:
        """(environment, level), read from the dataset id; the level is "" if the id has none."""
        return env_and_level(self.dataset)


@dataclass(frozen=True)
class Entry:
    """The runs of one method on one task, in order of their seeds."""

    task: Task
    method: Method
    runs: tuple[EvaluatedRun, ...]

    @property
    def scores(self) -> list[float]:
        """Each run's score by the task's reference."""
        return [run.score(self.task.reference) for run in self.runs]

    def mean_std(self, reference: str | None) -> tuple[float, float | None] | None:
        """Return mean and deviation over seeds by a reference; None if a run lacks it."""
        if reference is not None and not all(t.config.references.get(reference) for t in self.runs):
            return None
        return mean_std([run.score(reference) for run in self.runs])

    @property
    def reached(self) -> int:
        """The step that every run has been evaluated at or after."""
        return min(run.reached for run in self.runs)

    @property
    def steps(self) -> int:
        """The largest last step of the runs."""
        return max(run.steps for run in self.runs)

    @property
    def states(self) -> set[str]:
        """The states of the runs: `finished`, `unfinished`, `diverged`."""
        return {run.state for run in self.runs}

    @property
    def evaluations(self) -> int:
        """The fewest evaluations behind a run's score."""
        return min(len(run.window) for run in self.runs)

    @property
    def window(self) -> tuple[int, ...] | None:
        """The steps of the evaluations behind the scores; None if the runs differ."""
        windows = {run.window for run in self.runs}
        return windows.pop() if len(windows) == 1 else None

    @property
    def differing_settings(self) -> list[str]:
        """In which settings and evaluations its runs differ: `alpha (2.5 and 5.0)`.

        A variant's name has no settings at their defaults, which may have changed between two runs.
        """
        values = [t.config.settings | {"eval_episodes": t.config.eval_episodes} for t in self.runs]
        shared = [name for name in values[0] if all(name in other for other in values)]
        texts = {name: list(dict.fromkeys(str(settings[name]) for settings in values)) for name in shared}
        return [f"{name} ({' and '.join(found)})" for name, found in texts.items() if len(found) > 1]

    def common_curve(self) -> tuple[list[int], Array]:
        """Return the steps that all runs were evaluated at, and their scores [runs, steps]."""
        curves = [run.curve(self.task.reference) for run in self.runs]
        steps = sorted(set.intersection(*(set(curve) for curve in curves)))
        return steps, np.array([[curve[step] for step in steps] for curve in curves])

    @property
    def smoothed(self) -> bool:
        """Whether a figure of the learning curve shows means of several evaluations."""
        return len(self.common_curve()[0]) > LONG_CURVE

    def drawn_curve(self) -> tuple[list[int], Array]:
        """Return the common curve as figures show it.

        Of more than LONG_CURVE evaluations, each point is the score that the runs would have if they ended there: the
        mean of the last evaluations up to it.
        """
        steps, values = self.common_curve()
        if not self.smoothed:
            return steps, values
        ends = np.arange(1, len(steps) + 1)
        counts = np.minimum(ends, SCORED_EVALUATIONS)
        sums = np.pad(values, ((0, 0), (1, 0))).cumsum(1)
        return steps, (sums[:, ends] - sums[:, ends - counts]) / counts


@dataclass(frozen=True)
class Results:
    """All entries of one or more folders, tasks and methods in the order of the paper's table."""

    roots: tuple[Path, ...]
    tasks: tuple[Task, ...]
    methods: tuple[Method, ...]
    entries: Mapping[tuple[Task, Method], Entry]
    unevaluated: tuple[Run, ...]  # started, not yet evaluated

    def of(self, method: Method) -> list[Entry]:
        """Return a method's entries in order of tasks."""
        return [self.entries[task, method] for task in self.tasks if (task, method) in self.entries]

    def on(self, task: Task) -> list[Entry]:
        """Return a task's entries in order of methods."""
        return [self.entries[task, method] for method in self.methods if (task, method) in self.entries]

    def comparable(self, task: Task) -> bool:
        """Return whether all scores of a task are of evaluations at the same steps: others must not be ranked."""
        return len({run.window for entry in self.on(task) for run in entry.runs}) == 1

    def scores(self, method: Method) -> dict[str, list[float]]:
        """Return {task: normalized scores of its seeds}; tasks without a reference are left out."""
        return {entry.task.name: entry.scores for entry in self.of(method) if entry.task.reference}


Folders = str | Path | Sequence[str | Path]


def read_results(
    runs: Folders, *, steps: int | None = None, datasets: str | Sequence[str] = (), methods: str | Sequence[str] = ()
) -> Results:
    """Read every run below one or more folders.

    Args:
        steps: read the runs as they were after so many updates; shorter ones as they are.
        datasets: only these, by id or by a pattern such as `hopper-*`; all if empty.
        methods: only these, by their names in tables; all if empty.

    Raises:
        OffbenchError: none is evaluated, one is duplicated, or there is no such dataset or method. Damaged runs are
            named on stderr and left out.
    """
    steps = None if steps is None else check_count("steps", steps)
    roots = tuple(map(Path, [runs] if isinstance(runs, str | Path) else runs))
    unique = {run.folder.resolve(): run for root in roots for run in find_runs(root)}
    datasets, methods = ([one] if isinstance(one, str) else one for one in (datasets, methods))
    entries, unevaluated = entries_of(unique.values(), datasets, steps=steps)
    if not entries:
        below = ", ".join(map(str, roots))
        missing = "" if any(root.exists() for root in roots) else " (no such folder)"
        if unevaluated and steps is not None:
            raise OffbenchError(f"no run below {below} has an evaluation within {steps:,} updates; give more --steps")
        raise OffbenchError(
            f"no evaluated runs below {below}{missing}; start one with `offbench train ALGO --dataset ID`"
        )
    if methods:
        every = tuple(dict.fromkeys(entry.method for entry in entries))
        wanted = {find_method(every, name) for name in methods}
        entries = [entry for entry in entries if entry.method in wanted]
        variants = {(method.algorithm, method.variant) for method in wanted}
        configs = [(run, run.config()) for run in unevaluated]
        unevaluated = [run for run, config in configs if (config.algorithm, config.variant) in variants]
    tasks = dict.fromkeys(entry.task for entry in entries)
    ordered = sorted({entry.method for entry in entries}, key=method_order)
    return Results(roots, tuple(tasks), tuple(ordered), {(e.task, e.method): e for e in entries}, tuple(unevaluated))


def mixed_code(entries: Iterable[Entry]) -> list[tuple[Task, str]]:
    """Return the tasks and algorithms whose runs, of all variants, were trained by different code."""
    return keys_with_mixed_code(((entry.task, entry.method.algorithm), run) for entry in entries for run in entry.runs)


def differing_settings_notes(entries: Iterable[Entry]) -> list[str]:
    """Return a note for each entry that averages runs of different settings or evaluations."""
    found = ((entry, ", ".join(entry.differing_settings)) for entry in entries)
    return [f"the runs of {e.method.label} on {e.task.name} differ in {text}" for e, text in found if text]


def entries_of(
    runs: Iterable[Run], datasets: Sequence[str] = (), *, steps: int | None = None, compared: bool = True
) -> tuple[list[Entry], list[Run]]:
    """Return runs as entries in the order of the paper's table, and the runs that have no evaluation yet.

    Damaged runs are named on stderr and left out.

    Args:
        datasets: only these, by id or by a pattern; all if empty.
        steps: as in read_results.
        compared: whether the runs are compared, so that those on the same data must have been evaluated alike.

    Raises:
        OffbenchError: one is duplicated, two are not comparable, all evaluated ones are damaged, or there is no such
            dataset.
    """
    groups: dict[tuple[str, str, str, str], list[EvaluatedRun]] = {}
    unevaluated = []
    damaged: list[OffbenchError] = []
    for run in runs:
        try:
            evaluated = EvaluatedRun(run, run.config(), run.evaluations(), run.losses())
            evaluated = evaluated.up_to(steps) if steps is not None else evaluated
        except OffbenchError as error:
            damaged.append(error)
            continue
        except OSError as error:
            message = f"cannot read {run.folder}: {error.strerror}; {READ_REMEDIES.get(error.errno, 'try again')}"
            damaged.append(OffbenchError(message))
            continue
        if evaluated.evaluations:
            config = evaluated.config
            key = (config.dataset, config.dataset_sha256, config.algorithm, config.variant)
            groups.setdefault(key, []).append(evaluated)
        else:
            unevaluated.append(run)
    if damaged and not groups:
        raise damaged[0]
    for reason in damaged:
        warn(f"left out: {reason}")
    if groups and datasets:
        ids = {dataset for dataset, *_ in groups}
        for pattern in datasets:
            if not any(fnmatch(dataset, pattern) for dataset in ids):
                raise unknown("dataset", pattern, ids)
        groups = {key: group for key, group in groups.items() if any(fnmatch(key[0], p) for p in datasets)}
        unevaluated = [run for run in unevaluated if any(fnmatch(run.config().dataset, p) for p in datasets)]
    tasks = _tasks(groups, compared)
    configs: dict[tuple[str, str], list[RunConfig]] = {}
    for (_, _, algorithm, variant), group in groups.items():
        configs.setdefault((algorithm, variant), []).extend(run.config for run in group)
    methods = name_methods(configs)
    entries = []
    for (dataset, content, algorithm, variant), group in groups.items():
        group.sort(key=lambda run: run.seed)
        _check_seeds(group)
        entries.append(Entry(tasks[dataset, content], methods[algorithm, variant], tuple(group)))
    entries.sort(key=lambda entry: (_task_order(entry.task), method_order(entry.method)))
    return entries, unevaluated


def _tasks(
    groups: Mapping[tuple[str, str, str, str], Sequence[EvaluatedRun]], compared: bool
) -> dict[tuple[str, str], Task]:
    """Return the task of each (dataset, content), with a reference that all its runs have."""
    runs: dict[tuple[str, str], list[EvaluatedRun]] = {}
    for key, group in groups.items():
        runs.setdefault(key[:2], []).extend(group)
    ids = [dataset for dataset, _ in runs]
    tasks = {}
    for (dataset, content), group in runs.items():
        kinds = {(t.config.env_spec, *t.config.references.items(), *t.config.env_code.items()): t for t in group}
        for one, other in itertools.combinations(kinds.values(), 2) if compared else ():
            _check_evaluated_alike(one, other)
        references = [name for name in ("dataset", "d4rl") if all(t.config.references.get(name) for t in group)]
        tasks[dataset, content] = Task(dataset, content, references[0] if references else None, ids.count(dataset) > 1)
    return tasks


def _check_evaluated_alike(one: EvaluatedRun, other: EvaluatedRun) -> None:
    """Refuse two runs on the same data whose returns or scores are not comparable."""
    a, b = one.config, other.config
    if a.env_spec and b.env_spec and not same_environment(a.env_spec, b.env_spec):
        differ = "were evaluated in different environments"
    elif any(pair and b.references.get(name) not in (None, pair) for name, pair in a.references.items()):
        differ = "have different reference scores"
    elif describe_changes(a.env_code, b.env_code):
        differ = "were evaluated in environments of different code"
    else:
        return
    raise OffbenchError(
        f"{one.files.folder} and {other.files.folder} are runs on the same data but {differ} (see env_spec, env_code "
        "and references in their config.json), so their scores are not comparable; give a folder without one of them"
    )


def _check_seeds(runs: Sequence[EvaluatedRun]) -> None:
    for one, other in itertools.pairwise(runs):
        if one.seed == other.seed:
            raise OffbenchError(
                f"{one.files.folder} and {other.files.folder} are the same run; remove one of them, or "
                "give a folder without it"
            )


def _task_order(task: Task) -> tuple[tuple[int, str], tuple[int, str], str, str]:
    env, level = task.env_and_level
    return rank(level, tuple(LEVELS)), rank(env, ENV_ORDER), task.dataset, task.content_sha256
