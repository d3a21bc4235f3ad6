"""`train`: one algorithm on datasets. `Training`: any runs, also those of a grid.

specs -> group -> jobs -> unfinished jobs -> run_jobs, or a cluster
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from offbench.algorithm.interface import Algorithm
from offbench.common.errors import OffbenchError
from offbench.common.seeds import check_seed
from offbench.common.settings import check_count, without_numpy
from offbench.data.minari_store import check_type
from offbench.envs.recipes import load_recipe
from offbench.training.claim import check_folders, claim_unfinished
from offbench.training.datasets import Datasets, check_datasets, load_datasets
from offbench.training.devices import Machine, pick_machine
from offbench.training.grouping import group
from offbench.training.jobs import raise_first, run_jobs
from offbench.training.loggers import NO_LOGGERS, LoggerOptions
from offbench.training.registry import load_algorithm, only_in_this_process
from offbench.training.spec import Job, RunSpec, TrainingSchedule, specs_of
from offbench.training.stack import Stack


def train(
    algorithm: str | Path | type[Algorithm],
    dataset: str | Sequence[str],
    *,
    env: str | Path | None = None,
    download: bool = False,
    seeds: int | Sequence[int] = 0,
    steps: int = 1_000_000,
    eval_every: int = 5_000,
    eval_episodes: int = 10,
    device: str = "auto",
    workers: int | None = None,
    stack: int | str = "auto",
    precision: str = "float32",
    runs: str | Path = "runs",
    tensorboard: bool = False,
    wandb: str | None = None,
    fresh: bool = False,
    command: str = "",
    **settings: object,
) -> list[Path]:
    """Train one algorithm on one or more datasets, or resume the runs from their newest checkpoints.

    Args:
        algorithm: a registered name (td3_bc, bdb, cql, or that of an installed package), a file
            `./my_algo.py:ReBRAC`, or a class.
        dataset: one id of a local Minari dataset, or several.
        env: the recipe's name or file of the environment to evaluate in, instead of the one that the dataset names.
        download: first download missing datasets from Minari's server.
        seeds: one seed or several; a run's random numbers depend only on its own seed.
        steps: updates of each run.
        eval_every, eval_episodes: updates between evaluations, and episodes of the deterministic policy in each.
        device: auto, cpu, cuda or cuda:N.
        workers: processes for training and evaluation (default: one per core).
        stack: the maximum number of runs trained as one program; "auto" is what fits the memory of a GPU, or 8 on a
            CPU.
        precision: precision of matrix multiplications: float32, tf32 (GPUs) or bfloat16 (GPUs, and processors that
            multiply it natively). Weights, Adam, targets, losses and normalization are always float32.
        runs: the folder of all run folders.
        tensorboard: write TensorBoard event files into each run's folder `tensorboard`.
        wandb: a Weights & Biases project to log the runs to.
        fresh: delete the contents of the runs' folders first, for example if the algorithm's code has changed.
        command: what the user typed, for the run's config.json.
        settings: the algorithm's own (`offbench train bdb --help`); each also takes a list of values, e.g.
            `beta=[0.25, 0.5, "adaptive"]`, or `hidden=[(64, 64), (256, 256)]`.

    Returns:
        The runs' folders: datasets x settings x seeds.

    Raises:
        OffbenchError: anything that the user can fix, in one line.
    """
    schedule = TrainingSchedule(_seed_list(seeds), *map(without_numpy, (steps, eval_every, eval_episodes)))
    names = _dataset_ids(dataset)
    env_spec = load_recipe(env).env_spec() if env is not None else None
    variants = specs_of(algorithm, settings, names, schedule, Path(runs), precision, env_spec)
    _check_schedule(schedule)
    if not names:
        raise OffbenchError("give at least one dataset")
    if download:
        from offbench.data.download import download as fetch

        for name in names:
            fetch(name)
    specs = sorted(itertools.chain(*variants), key=lambda spec: names.index(spec.dataset))  # dataset by dataset
    machine = pick_machine(device, workers, stack, precision)
    loggers = LoggerOptions(tensorboard, wandb)
    loggers.check()
    training = Training(specs, machine, command=command, loggers=loggers, fresh=fresh)
    if training.finished:
        total = f"{len(specs)} run{'s' if len(specs) > 1 else ''}"
        print(f"already finished: {training.finished} of {total}", file=sys.stderr)
    raise_first(training.diverged + training.run())
    return [spec.folder for spec in specs]


class Training:
    """Runs that are to be trained on a machine, as jobs.

    Attributes:
        jobs: what was left to train at first.
        diverged: a line for each run that diverged in an earlier session; they are left as they are.
        finished: how many runs are done already.

    Args:
        command: what the user typed, for config.json.
        loggers: the optional loggers.
        fresh: whether to delete what the runs' folders hold first.

    Raises:
        OffbenchError: a dataset is missing or damaged, or a run's folder holds another run.
    """

    def __init__(
        self,
        specs: Sequence[RunSpec],
        machine: Machine,
        *,
        command: str = "",
        loggers: LoggerOptions = NO_LOGGERS,
        fresh: bool = False,
    ) -> None:
        self.machine, self._command = machine, command
        self._datasets = load_datasets(specs)
        check_datasets(self._datasets)
        self._all_jobs = [replace(job, loggers=loggers) for job in group(specs, self._datasets, machine)]
        if fresh:
            for job in self._all_jobs:  # if the code fails, nothing is deleted
                _try_update(job.first, self._datasets)
            for spec in specs:  # nor if another process trains one of the runs
                spec.run.check_unlocked()
            for spec in specs:
                spec.run.clear()
        for job in self._all_jobs:
            check_folders(job, self._datasets)
        self.jobs = self.unfinished_jobs()
        self.diverged = [
            f"{spec.folder} diverged earlier and is skipped; delete it to train the run again"
            for job in self._all_jobs
            for spec in job.specs
            if spec.run.diverged
        ]
        self.finished = len(specs) - len(self.diverged) - sum(len(job.specs) for job in self.jobs)

    def unfinished_jobs(self) -> list[Job]:
        """Claim the runs' folders, and return what is left to train in them now."""
        return [
            left for job in self._all_jobs for left in claim_unfinished(job, self._datasets, command=self._command)
        ]

    def run(
        self,
        execute: Callable[[Sequence[Job], int], list[str]] = run_jobs,
        *,
        deadline: float | None = None,
        cost: Mapping[str, float] | None = None,
    ) -> list[str]:
        """Train what is left.

        Args:
            execute: trains jobs, up to a number at a time, and returns what went wrong, a line each.
            deadline: `time.time()` to stop at, with checkpoints.
            cost: seconds per update of each algorithm, for the time left.

        Returns:
            What went wrong, a line each.
        """
        jobs = [replace(job, deadline=deadline, cost=(cost or {}).get(job.first.algorithm, 1.0)) for job in self.jobs]
        jobs.sort(key=lambda job: -job.work)  # a long job that starts last would leave other processes idle
        local = len(jobs) > 1 and any(only_in_this_process(job.first.algorithm) for job in jobs)
        return execute(jobs, 1 if local else self.machine.processes) if jobs else []


def _try_update(spec: RunSpec, datasets: Datasets) -> None:
    """Perform the first update of a run on the CPU, to check that its code works; discard the result."""
    stack = Stack(load_algorithm(spec.algorithm), [spec], {spec.dataset: datasets[spec.dataset]}, "cpu")
    stack.train(1)


def _dataset_ids(dataset: object) -> list[Any]:
    """Return the ids of one or several datasets, without duplicates. Raises OffbenchError for anything else."""
    several = dataset if isinstance(dataset, Collection) and not isinstance(dataset, str) else [dataset]
    for name in several:
        check_type(name)
    return list(dict.fromkeys(several))


def _seed_list(seeds: int | Sequence[int]) -> tuple[int, ...]:
    seeds = without_numpy(seeds)
    return tuple(map(check_seed, seeds if isinstance(seeds, Iterable) else [seeds]))


def _check_schedule(schedule: TrainingSchedule) -> None:
    if not schedule.seeds or len(set(schedule.seeds)) < len(schedule.seeds):
        raise OffbenchError(f"seeds must be different whole numbers, not {list(schedule.seeds)}")
    for name in ("steps", "eval_every", "eval_episodes"):
        check_count(name, getattr(schedule, name))
