"""`train`: from an algorithm's name, datasets, settings and seeds to stacks of runs, and their jobs."""

from __future__ import annotations

import dataclasses
import itertools
import operator
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from offbench import checkpoints, transitions
from offbench.batches import Member
from offbench.devices import pick_device, stack_size
from offbench.environments import checked_spec, same_environment
from offbench.errors import OffbenchError, unknown
from offbench.jobs import Job, Order, run_jobs
from offbench.loggers import Destinations
from offbench.provenance import hardware, versions, warn_other_physics
from offbench.recipes import d4rl_constants
from offbench.registry import load_algorithm
from offbench.runs import FORMAT, Run, run_folder, settings_dict, variant
from offbench.settings import build, check, fields
from offbench.stack import Stack
from offbench.training import Schedule
from offbench.workers import cores, default_workers


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
    tf32: bool = False,
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
        tf32: on a GPU, matrix products in TF32: faster, less precise; written into each run's config.json.
        runs: the folder of all run directories.
        tensorboard: write TensorBoard event files into each run's folder `tensorboard`.
        wandb: a Weights & Biases project to show the runs in.
        command: what the user typed, for the run's config.json.
        settings: the algorithm's own (`offbench train bdb --help`); a setting that may differ between the runs
            of a stack also takes a list, e.g. `beta=[0.25, 0.5, "adaptive"]`.

    Returns:
        The runs' directories: datasets x settings x seeds.

    Raises:
        OffbenchError: anything that the user can mend, said in one line.
    """
    kind = load_algorithm(algorithm)
    configs = list(dict.fromkeys(kind.Config(**values) for values in _grid(kind.Config, settings, algorithm)))
    seed_list = _seed_list(seeds)
    _check_numbers(seed_list, steps, eval_every, eval_episodes)
    names = [dataset] if isinstance(dataset, str) else list(dict.fromkeys(dataset))
    if not names:
        raise OffbenchError("give at least one dataset")
    orders = [
        Order(
            algorithm,
            name,
            settings_dict(config),
            seed,
            str(run_folder(Path(runs), name, algorithm, variant(config), seed)),
        )
        for name, config, seed in itertools.product(names, configs, seed_list)
    ]
    show = Destinations(tensorboard, wandb)
    show.check()
    place = pick_device(device)
    processes = default_workers(workers) if place == "cpu" else 1
    schedule = Schedule(steps, eval_every, eval_episodes, place, workers=0, show=show)
    jobs = jobs_of(orders, schedule, processes, stack=stack, tf32=tf32, command=command)
    if place != "cpu":
        jobs = with_evaluators(jobs, default_workers(workers))
    elif len(jobs) == 1:
        jobs = with_evaluators(jobs, max(1, cores() - 1) if workers is None else workers)
    problems = [
        f"{order.folder} has diverged before and is left as it is; delete it to try again"
        for order in orders
        if Run(Path(order.folder)).diverged
    ]
    problems += run_jobs(jobs, processes) if jobs else []
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise OffbenchError(problems[0] + more)
    return [Path(order.folder) for order in orders]


def jobs_of(
    orders: Sequence[Order],
    schedule: Schedule,
    processes: int,
    *,
    stack: int | str = "auto",
    tf32: bool = False,
    command: str = "",
) -> list[Job]:
    """Claim the runs' directories and sort what is left to train into jobs.

    Runs train together if they share the algorithm, every setting that is not `per_run`, the environment and the
    step they stand at; large stacks are cut to the device's size, and so that no process is idle.

    Raises:
        OffbenchError: a dataset is missing or damaged, or another run lives in a run's directory.
    """
    if stack != "auto" and not (isinstance(stack, int) and stack >= 1):
        raise OffbenchError(f"stack must be auto or a whole number from 1, not {stack!r}")
    loaded = {name: transitions.load(name) for name in dict.fromkeys(order.dataset for order in orders)}
    for data in loaded.values():
        if data.env_spec:
            checked_spec(data.env_spec, data.dataset_id, data.observations.shape[1], data.actions.shape[1])
        warn_other_physics(data.dataset_id, data.metadata.get("offbench", {}).get("versions", {}))
    paired = [(order, order.member(loaded[order.dataset])) for order in orders]
    for order, member in paired:
        member.run.claim(_config(order.algorithm, member, schedule, tf32, command))
    order_of = {member.run.folder: order for order, member in paired}
    # cut before looking at what is left: a stack that resumes has the same runs, so the same bits, as before
    groups = _alike(paired)
    jobs = []
    for group in groups:
        size = stack
        if isinstance(size, str):
            algorithm = load_algorithm(order_of[group[0].run.folder].algorithm)
            size = stack_size(algorithm, group[0], schedule.device)
        share = max(1, processes // len(groups))  # of the processes
        parts = min(len(group), -(-len(group) // size // share) * share)
        for part in np.array_split(np.arange(len(group)), parts):
            left = [group[i] for i in part if not group[i].run.diverged]
            for stage in together(left, schedule.steps):
                jobs.append(Job(tuple(order_of[member.run.folder] for member in stage), schedule, tf32))
    return jobs


def with_evaluators(jobs: Sequence[Job], workers: int) -> list[Job]:
    """Give each job evaluation processes of its own."""
    return [
        dataclasses.replace(job, schedule=dataclasses.replace(job.schedule, workers=default_workers(workers)))
        for job in jobs
    ]


def _alike(paired: Sequence[tuple[Order, Member]]) -> list[list[Member]]:
    """Sort runs by algorithm, environment, and the settings that cannot differ within a stack."""
    kinds: list[tuple[Any, Member, list[Member]]] = []
    for order, member in paired:
        per_run = {name for name, field in fields(type(member.config)).items() if field.metadata.get("per_run")}
        shared = {name: value for name, value in settings_dict(member.config).items() if name not in per_run}
        shapes = member.data.observations.shape[1], member.data.actions.shape[1]
        key = (order.algorithm, shared, shapes)
        for known, first, group in kinds:
            if known == key and same_environment(first.data.env_spec, member.data.env_spec):
                group.append(member)
                break
        else:
            kinds.append((key, member, [member]))
    return [group for _, _, group in kinds]


def together(members: Sequence[Member], steps: int) -> list[list[Member]]:
    """Sort runs into stacks that can go on from one common step; runs without a checkpoint begin together.

    A stack that was killed while it wrote its checkpoints has runs a checkpoint apart: they go on from the older one.

    Raises:
        OffbenchError: a run is further than `steps` already.
    """
    known = {member.run.folder: set(checkpoints.steps(member.run.folder)) for member in members}
    left, groups = [], []
    for member in members:
        found = known[member.run.folder]
        evaluated = not member.data.env_spec or steps in member.run.evaluations()
        if steps in found and evaluated:
            continue  # finished: left alone
        if found and max(found) > steps:
            raise OffbenchError(
                f"{member.run.folder} is at step {max(found)} already; give --steps {max(found)} or more, or --runs"
            )
        left.append(member)
    while left:
        counts = Counter(step for member in left for step in known[member.run.folder] if step <= steps)
        # the step that most runs share; among those the newest
        best = max(counts, key=lambda step: (counts[step], step), default=None)
        group = [m for m in left if best is None or best in known[m.run.folder]]
        groups.append(group)
        left = [member for member in left if member not in group]
    return groups


def _seed_list(seeds: int | Sequence[int]) -> list[int]:
    try:
        return [operator.index(seed) for seed in ([seeds] if isinstance(seeds, int) else seeds)]
    except TypeError:
        raise OffbenchError(f"seeds must be whole numbers, not {seeds!r}") from None


def _grid(cls: type, settings: Mapping[str, Any], algorithm: str) -> Iterator[dict[str, Any]]:
    """Yield the settings of each config: the product of all lists given."""
    known, columns = fields(cls), []
    for name, value in settings.items():
        if name not in known:
            raise unknown(f"setting of {algorithm}", name, known)
        several = isinstance(value, list | tuple) and known[name].metadata.get("per_run")
        values = list(value) if several else [value]
        if not values:
            raise OffbenchError(f"{algorithm}: {name} got an empty list")
        columns.append([(name, check(cls, name, item, algorithm)) for item in values])
    for row in itertools.product(*columns):
        yield dict(row)


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
    settings: Any = build(kind.Config, config["settings"], f"{run.config_path}: settings")
    data = transitions.load(config["dataset"])
    if data.content != config["dataset_sha256"]:
        raise OffbenchError(f"{data.dataset_id} is no longer the dataset that {run.folder} was trained on")
    found = checkpoints.load_newest(run.folder)
    if found is None:
        raise OffbenchError(f"{run.folder} has no checkpoint yet; train it to its first one")
    tensors, state = found
    stack = Stack(kind, [Member(run, config["seed"], settings, data, data.references)], "cpu")
    stack.load(0, tensors)
    stack.step = int(state["step"])
    return stack


def _config(algorithm: str, member: Member, schedule: Schedule, tf32: bool, command: str) -> dict[str, Any]:
    """Return the run's config.json: all that is needed to repeat it, and to score it without its dataset."""
    data = member.data
    constants = d4rl_constants(data.env_id)
    return {
        "format": FORMAT,
        "algorithm": algorithm,
        "variant": variant(member.config),
        "settings": settings_dict(member.config),
        "dataset": data.dataset_id,
        "dataset_sha256": data.content,
        "seed": member.seed,
        "steps": schedule.steps,
        "eval_every": schedule.eval_every,
        "eval_episodes": schedule.eval_episodes,
        "references": {
            "dataset": list(member.references) if member.references else None,
            "d4rl": list(constants) if constants else None,
        },
        "env_id": data.env_id,
        "env_spec": data.env_spec,
        "device": schedule.device,
        "tf32": tf32,
        "command": command,
        "versions": versions(),
        **hardware(),
    }
