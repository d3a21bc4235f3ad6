"""`train`: from an algorithm's name, datasets, settings and seeds to stacks of runs, and their jobs."""

from __future__ import annotations

import itertools
import operator
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from offbench.common import checkpoints
from offbench.common.errors import OffbenchError, unknown
from offbench.common.processes import cores, default_workers
from offbench.common.settings import build, check, fields
from offbench.data import transitions
from offbench.training.batches import Member
from offbench.training.devices import check_precision, pick_device
from offbench.training.grouping import Part, cut, diverged, pending, with_evaluators
from offbench.training.jobs import Job, Order, complain, run_jobs
from offbench.training.loggers import Destinations
from offbench.training.registry import current_settings, load_algorithm
from offbench.training.run import Run, run_folder, settings_dict, variant
from offbench.training.stack import Stack
from offbench.training.trainer import Schedule


def train(
    algorithm: str,
    dataset: str | Sequence[str],
    *,
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
    command: str = "",
    **settings: Any,
) -> list[Path]:
    """Train runs of one algorithm in stacks, going on from their newest checkpoints.

    Args:
        algorithm: a registered name: td3_bc, bdb, cql, or a third party's.
        dataset: one id of a local Minari dataset, or several.
        seeds: one seed or several; each run's randomness depends on its own seed alone.
        steps: updates of each run.
        eval_every, eval_episodes: every so many updates, so many episodes of the deterministic policy.
        device: auto, cpu, cuda or cuda:N.
        workers: processes (default: one a core). Several runs on a CPU train in as many processes; one run, or a
            GPU, has them for its evaluations.
        stack: most runs that train as one program; "auto" follows the device's memory.
        precision: of matrix products: float32, tf32 (GPUs) or bfloat16 (GPUs, and processors that multiply it
            natively). Weights, Adam, targets, losses and normalization are float32 in each.
        runs: the folder of all run directories.
        tensorboard: write TensorBoard event files into each run's folder `tensorboard`.
        wandb: a Weights & Biases project to show the runs in.
        command: what the user typed, for the run's config.json.
        settings: the algorithm's own (`offbench train bdb --help`); each also takes a list of values, e.g.
            `beta=[0.25, 0.5, "adaptive"]`, or `hidden=[(64, 64), (256, 256)]`.

    Returns:
        The runs' directories: datasets x settings x seeds.

    Raises:
        OffbenchError: anything that the user can mend, said in one line.
    """
    kind = load_algorithm(algorithm)
    configs = configurations(kind.Config, settings, algorithm)
    seed_list = _seed_list(seeds)
    _check_numbers(seed_list, steps, eval_every, eval_episodes)
    names = [dataset] if isinstance(dataset, str) else list(dict.fromkeys(dataset))
    if not names:
        raise OffbenchError("give at least one dataset")
    place = pick_device(device)
    check_precision(precision, place)
    orders = [
        Order(
            algorithm,
            name,
            settings_dict(config),
            seed,
            str(run_folder(Path(runs), name, algorithm, variant(config, precision), seed)),
        )
        for name, config, seed in itertools.product(names, configs, seed_list)
    ]
    show = Destinations(tensorboard, wandb)
    show.check()
    processes = default_workers(workers) if place == "cpu" else 1
    schedule = Schedule(steps, eval_every, eval_episodes, place, workers=0, show=show, precision=precision)
    parts = cut(orders, place, processes, stack)
    jobs = [job for part in parts for job in pending(part, schedule, command=command)]
    _say_finished(parts, jobs)
    if place != "cpu":
        jobs = with_evaluators(jobs, default_workers(workers))
    elif len(jobs) == 1:
        jobs = with_evaluators(jobs, max(1, cores() - 1) if workers is None else workers)
    complain(diverged(parts) + (run_jobs(jobs, processes) if jobs else []))
    return [Path(order.folder) for order in orders]


def _say_finished(parts: Sequence[Part], jobs: Sequence[Job]) -> None:
    """Print how many runs need nothing more: without it, a command that does nothing says nothing."""
    runs = [member.run for part in parts for member in part.members]
    finished = len(runs) - sum(run.diverged for run in runs) - sum(len(job.orders) for job in jobs)
    if finished:
        print(f"already finished: {finished} of {len(runs)} run{'s' if len(runs) > 1 else ''}", file=sys.stderr)


def _seed_list(seeds: int | Sequence[int]) -> list[int]:
    try:
        return [operator.index(seed) for seed in ([seeds] if isinstance(seeds, int) else seeds)]
    except TypeError:
        raise OffbenchError(f"seeds must be whole numbers, not {seeds!r}") from None


def configurations(cls: type, settings: Mapping[str, Any], algorithm: str) -> list[Any]:
    """Return the different configs of the product of all lists given. Raises OffbenchError for a bad setting."""
    known, columns = fields(cls), []
    for name, value in settings.items():
        if name not in known:
            raise unknown(f"setting of {algorithm}", name, known)
        values = list(value) if _several(value, known[name].default) else [value]
        if not values:
            raise OffbenchError(f"{algorithm}: {name} got an empty list")
        if len(values) > 1 and isinstance(known[name].default, tuple):
            _check_lists(values, f"{algorithm}: {name}")
        columns.append([(name, check(cls, name, item, algorithm)) for item in values])
    return list(dict.fromkeys(cls(**dict(row)) for row in itertools.product(*columns)))


def _several(value: Any, default: Any) -> bool:
    """Return whether a list holds values of a setting, rather than being one, as (64, 64) is of `hidden`."""
    if not isinstance(value, list | tuple):
        return False
    return not isinstance(default, tuple) or any(isinstance(item, list | tuple | str) for item in value)


def _check_lists(values: Sequence[Any], what: str) -> None:
    """Refuse `64 64`, which may mean one network of two layers or two of one."""
    if any(isinstance(item, str) and not re.search("[,x]", item) for item in values):
        typed = [str(item) for item in values]
        raise OffbenchError(
            f"{what} takes lists such as 32,32 64,64, not {' '.join(typed)}; one list is {','.join(typed)}"
        )


def _check_numbers(seeds: Sequence[int], steps: int, eval_every: int, eval_episodes: int) -> None:
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise OffbenchError(f"seeds must be different whole numbers from 0, not {list(seeds)}")
    for name, value in {"steps": steps, "eval_every": eval_every, "eval_episodes": eval_episodes}.items():
        if not isinstance(value, int) or value < 1:
            raise OffbenchError(f"{name} must be a whole number from 1, not {value}")


def restore(run: Run) -> Stack:
    """Return a run's learning state from its newest checkpoint, on the CPU.

    Raises:
        OffbenchError: no run, no checkpoint, or its dataset is gone or changed.
    """
    config = run.config()
    kind = load_algorithm(config["algorithm"])
    recorded = current_settings(config["algorithm"], config["settings"], str(run.folder))
    settings: Any = build(kind.Config, recorded, f"{run.config_path}: settings")
    data = transitions.load(config["dataset"])
    if data.content != config["dataset_sha256"]:
        raise OffbenchError(f"{data.dataset_id} is no longer the dataset that {run.folder} was trained on")
    found = checkpoints.load_newest(run.folder)
    if found is None:
        raise OffbenchError(f"{run.folder} has no checkpoint yet; train it to its first one")
    tensors, state = found
    stack = Stack(kind, [Member(run, config["seed"], settings, data, config["algorithm"])], "cpu")
    stack.load(0, tensors)
    stack.step = int(state["step"])
    return stack
