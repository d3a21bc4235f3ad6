"""`train`: from an algorithm's name, datasets, settings and seeds to a stack of runs."""

from __future__ import annotations

import itertools
import operator
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from offbench import checkpoints, transitions
from offbench.environments import checked_spec, same_environment
from offbench.errors import OffbenchError, unknown
from offbench.provenance import hardware, versions, warn_other_physics
from offbench.recipes import d4rl_constants
from offbench.registry import load_algorithm
from offbench.runs import FORMAT, Run, run_folder, settings_dict, variant
from offbench.settings import build, check, fields
from offbench.training import Member, Schedule, Stack, Trainer
from offbench.transitions import Transitions
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
    runs: str | Path = "runs",
    command: str = "",
    **settings: Any,
) -> list[Path]:
    """Train runs of one algorithm as one stack, going on from their newest checkpoints.

    Args:
        algorithm: a registered name: td3_bc, bdb, cql, or a third party's.
        dataset: one id of a local Minari dataset, or several of one environment.
        seeds: one seed or several; each run's randomness depends on its own seed alone.
        steps: updates of each run.
        eval_every, eval_episodes: every so many updates, so many episodes of the deterministic policy.
        device: auto, cpu, cuda or cuda:N.
        workers: evaluation processes beside the training (default: all cores but one).
        runs: the folder of all run directories.
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
    place = pick_device(device)
    datasets = [transitions.load(name) for name in ([dataset] if isinstance(dataset, str) else dict.fromkeys(dataset))]
    _check_environment(datasets)
    schedule = Schedule(
        steps, eval_every, eval_episodes, place, max(1, cores() - 1) if workers is None else default_workers(workers)
    )
    members = []
    for data, config, seed in itertools.product(datasets, configs, seed_list):
        warn_other_physics(data.dataset_id, data.metadata.get("offbench", {}).get("versions", {}))
        run = Run(run_folder(Path(runs), data.dataset_id, algorithm, variant(config), seed))
        members.append(Member(run, seed, config, data, references(data)))
    for member in members:
        member.run.claim(_config(algorithm, member, schedule, command))
    with _threads(place):
        for group in together(members, steps):
            title = f"{algorithm} on {group[0].data.dataset_id}"
            title += f" ({len(group)} runs)" if len(group) > 1 else ""
            Trainer(kind, group, schedule, title).train()
    return [member.run.folder for member in members]


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


def _check_environment(datasets: Sequence[Transitions]) -> None:
    """Refuse datasets of different environments, and one whose environment cannot be played."""
    if not datasets:
        raise OffbenchError("give at least one dataset")
    first = datasets[0]
    for data in datasets[1:]:
        if (
            data.observations.shape[1:] != first.observations.shape[1:]
            or data.actions.shape[1:] != first.actions.shape[1:]
        ):
            raise OffbenchError(
                f"datasets of one stack must have the same shapes: {first.dataset_id}, {data.dataset_id}"
            )
        if not same_environment(data.env_spec, first.env_spec):
            raise OffbenchError(
                f"datasets of one stack must be of one environment; {first.dataset_id} and {data.dataset_id} are not: "
                "train them apart"
            )
    if first.env_spec:
        checked_spec(first.env_spec, first.dataset_id, first.observations.shape[1], first.actions.shape[1])


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


def pick_device(device: str) -> str:
    """Return the device to train on: `auto` takes a GPU if there is one.

    Raises:
        OffbenchError: not a device, or one that this machine lacks.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    kind, _, index = device.partition(":")
    if kind not in ("cpu", "cuda") or (index and not index.isdigit()):
        raise OffbenchError(f"device must be auto, cpu, cuda or cuda:N, not {device!r}")
    if kind == "cuda" and (not torch.cuda.is_available() or int(index or 0) >= torch.cuda.device_count()):
        found = torch.cuda.device_count() if torch.cuda.is_available() else 0
        raise OffbenchError(
            f"no device {device}: PyTorch {torch.__version__} sees {found} GPUs here; use --device cpu"
        )
    return device


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
    stack = Stack(kind, [Member(run, config["seed"], settings, data, references(data))], "cpu")
    stack.load(0, tensors)
    stack.step = int(state["step"])
    return stack


def references(data: Transitions) -> tuple[float, float] | None:
    """Return a dataset's own reference scores (random, expert), None if it has none."""
    low, high = data.metadata.get("ref_min_score"), data.metadata.get("ref_max_score")
    if low is None or high is None or not float(high) > float(low):
        return None
    return float(low), float(high)


def _config(algorithm: str, member: Member, schedule: Schedule, command: str) -> dict[str, Any]:
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
        "command": command,
        "versions": versions(),
        **hardware(),
    }


@contextmanager
def _threads(device: str) -> Iterator[None]:
    """Train on one thread: two runs in two processes beat one run on two threads."""
    before = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
