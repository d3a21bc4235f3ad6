"""Stacking: which runs train together, and what is left to train of them.

orders -> alike     same algorithm, environment, shapes and settings that are not `per_run`
       -> cut       to the device's size, and so that no process is idle: always the same way, whatever is done
       -> pending   per part: runs that stand at one common step, finished and diverged ones left out
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.common.processes import default_workers
from offbench.common.provenance import made_with
from offbench.common.settings import fields
from offbench.data import transitions
from offbench.data.recorded_env import say_margin
from offbench.envs.environments import checked_spec, same_environment
from offbench.envs.recipes import d4rl_constants
from offbench.envs.same_physics import warn_other_physics
from offbench.training.batches import Member
from offbench.training.devices import stack_size
from offbench.training.jobs import Job, Order
from offbench.training.registry import load_algorithm
from offbench.training.run import FORMAT, Run, settings_dict, variant
from offbench.training.trainer import Schedule


@dataclasses.dataclass(frozen=True)
class Part:
    """Runs that train as one program, whether all of them are still to be trained or not.

    Attributes:
        kind: the runs' algorithm.
    """

    kind: str
    orders: tuple[Order, ...]
    members: tuple[Member, ...]


def cut(orders: Sequence[Order], device: str, processes: int, stack: int | str = "auto") -> list[Part]:
    """Sort runs into stacks.

    Args:
        device: PyTorch's name.
        processes: how many stacks can train at a time.
        stack: most runs of one, or "auto" for what the device holds.

    Raises:
        OffbenchError: a dataset is missing or damaged, or a setting is bad.
    """
    if stack != "auto" and not (isinstance(stack, int) and stack >= 1):
        raise OffbenchError(f"stack must be auto or a whole number from 1, not {stack!r}")
    loaded = {name: transitions.load(name) for name in dict.fromkeys(order.dataset for order in orders)}
    for data in loaded.values():
        if data.env_spec:
            checked_spec(data.env_spec, data.dataset_id, data.observations.shape[1], data.actions.shape[1])
            say_margin(data.dataset_id, data.metadata, data.env_spec)
            warn_other_physics(data.dataset_id, data.metadata.get("offbench", {}).get("versions", {}), data.env_spec)
        else:
            print(
                f"offbench: {data.dataset_id} names no environment, so nothing is evaluated while training",
                file=sys.stderr,
            )
    groups = _alike([(order, order.member(loaded[order.dataset])) for order in orders])
    parts = []
    for kind, group in groups:
        size = stack_size(load_algorithm(kind), group[0][1], device) if isinstance(stack, str) else stack
        share = max(1, processes // len(groups))  # of the processes
        count = min(len(group), -(-len(group) // size // share) * share)
        for places in np.array_split(np.arange(len(group)), count):
            mine = [group[place] for place in places]
            parts.append(Part(kind, tuple(order for order, _ in mine), tuple(member for _, member in mine)))
    return parts


def _alike(paired: Sequence[tuple[Order, Member]]) -> list[tuple[str, list[tuple[Order, Member]]]]:
    """Sort runs by algorithm, environment, shapes, and the settings that cannot differ within a stack."""
    groups: list[tuple[Any, Member, str, list[tuple[Order, Member]]]] = []
    for order, member in paired:
        per_run = {name for name, field in fields(type(member.config)).items() if field.metadata.get("per_run")}
        shared = {name: value for name, value in settings_dict(member.config).items() if name not in per_run}
        shapes = member.data.observations.shape[1], member.data.actions.shape[1]
        key = (order.algorithm, shared, shapes)
        for known, first, _, group in groups:
            if known == key and same_environment(first.data.env_spec, member.data.env_spec):
                group.append((order, member))
                break
        else:
            groups.append((key, member, order.algorithm, [(order, member)]))
    return [(kind, group) for _, _, kind, group in groups]


def pending(part: Part, schedule: Schedule, *, command: str = "") -> list[Job]:
    """Claim the runs' directories, and return what is left to train of them.

    Raises:
        OffbenchError: another run lives in a run's directory, one lacks files, or is further than the schedule goes.
    """
    for order, member in zip(part.orders, part.members, strict=True):
        member.run.claim(_config(order, member, schedule, command))
        _check_environment(member)
        if member.data.env_spec:
            _check_evaluations(member.run, schedule.eval_every)
    order_of = {member.run.folder: order for order, member in zip(part.orders, part.members, strict=True)}
    left = [member for member in part.members if not member.run.diverged]
    stages = together(left, schedule.steps)
    return [Job(part.kind, tuple(order_of[m.run.folder] for m in stage), schedule) for stage in stages]


def diverged(parts: Sequence[Part]) -> list[str]:
    """Return a line for each run that diverged in an earlier try; `pending` leaves them out."""
    return [
        f"{member.run.folder} has diverged before and is left as it is; delete it to try again"
        for part in parts
        for member in part.members
        if member.run.diverged
    ]


def with_evaluators(jobs: Sequence[Job], workers: int) -> list[Job]:
    """Give each job evaluation processes of its own."""
    return [
        dataclasses.replace(job, schedule=dataclasses.replace(job.schedule, workers=default_workers(workers)))
        for job in jobs
    ]


def finished(run: Run, steps: int) -> bool:
    """Return whether a run has come to its end: checkpoint and evaluation of step `steps`, and a policy."""
    if steps not in checkpoints.steps(run.folder) or not run.config_path.exists() or not run.policy_path.exists():
        return False
    return not run.config().get("env_spec") or steps in run.evaluations()


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
        if finished(member.run, steps):
            continue  # left alone
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


def _check_environment(member: Member) -> None:
    """Refuse a run that was evaluated in another environment so far, such as one with other contact margins."""
    before = member.run.config().get("env_spec")
    try:
        same = before is None or member.data.env_spec is None or same_environment(before, member.data.env_spec)
    except (ValueError, TypeError, AttributeError):  # damaged
        same = False
    if not same:
        raise OffbenchError(
            f"{member.run.folder} was evaluated in another environment than {member.data.dataset_id} names now "
            f"({before}, not {member.data.env_spec}); delete it or give another --runs"
        )


def _check_evaluations(run: Run, every: int) -> None:
    """Refuse a run that lacks an evaluation from before its newest checkpoint: going on would give another score."""
    if not (newest := max(checkpoints.steps(run.folder), default=0)):
        return
    known = run.evaluations()
    for step in range(every, newest, every):
        if step not in known:
            raise OffbenchError(
                f"{run.evaluations_path} lacks the evaluation of step {step}; put the file back, or delete the run "
                "to repeat it"
            )


def _config(order: Order, member: Member, schedule: Schedule, command: str) -> dict[str, Any]:
    """Return the run's config.json: all that is needed to repeat it, and to score it without its dataset."""
    data, config = member.data, member.config
    constants = d4rl_constants(data.env_id)
    return {
        "format": FORMAT,
        "algorithm": order.algorithm,
        "variant": variant(config, schedule.precision),
        "settings": settings_dict(config),
        "dataset": data.dataset_id,
        "dataset_sha256": data.content,
        "seed": member.seed,
        "steps": schedule.steps,
        "eval_every": schedule.eval_every,
        "eval_episodes": schedule.eval_episodes,
        "references": {
            "dataset": list(data.references) if data.references else None,
            "d4rl": list(constants) if constants else None,
        },
        "env_id": data.env_id,
        "env_spec": data.env_spec,
        "command": command.encode("utf-8", "backslashreplace").decode(),  # a path may hold bytes that are not UTF-8
        **made_with(schedule.device, schedule.precision),
    }
