"""Which runs train together, and what is left to train of them.

group      runs to jobs: same algorithm, environment, shapes, times and settings that are not `per_run`, in groups that
           fit the device and leave no process idle. It does not depend on what is trained already
pending    what is left of a job: runs at one common step; finished and diverged ones are left out
"""

from __future__ import annotations

import dataclasses
import gc
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from offbench.common import checkpoints
from offbench.common.code_hash import changes
from offbench.common.errors import OffbenchError
from offbench.common.provenance import training_platform
from offbench.common.settings import fields
from offbench.common.terminal import inform, warn
from offbench.data import transitions
from offbench.data.minari_store import provenance
from offbench.data.recorded_env import report_margin_rule
from offbench.data.transitions import Transitions
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import checked_spec, same_environment
from offbench.envs.recipes import d4rl_reference
from offbench.envs.version_warning import warn_other_physics
from offbench.training.captured_update import WARM_UP
from offbench.training.devices import Machine
from offbench.training.registry import load_algorithm
from offbench.training.run import TRAIN_ANEW
from offbench.training.run_config import RunConfig
from offbench.training.source_code import code_of
from offbench.training.spec import Job, RunSpec, settings_json
from offbench.training.stack import Stack

CPU_STACK = 8  # runs of one process: more runs gain nothing there, and each waits for all of them
MEMORY_SHARE = 0.8  # of a GPU's free memory that a stack may take

Datasets = Mapping[str, Transitions]


def load_datasets(specs: Sequence[RunSpec]) -> dict[str, Transitions]:
    """Return the runs' datasets by name, with the environment to evaluate in if the runs name another.

    Raises OffbenchError if one is missing or damaged.
    """
    named = {spec.dataset: spec.env_spec for spec in specs}
    return {name: dataclasses.replace(transitions.load(name), evaluated_in=env) for name, env in named.items()}


def check_datasets(datasets: Datasets) -> None:
    """Check that the datasets' environments can be evaluated in, and warn of what may change the scores.

    Raises:
        OffbenchError: an environment cannot be made, or does not fit its dataset.
    """
    for name, data in datasets.items():
        if data.env_spec:
            checked_spec(data.env_spec, name, data.observations.shape[1], data.low, data.high)
            recorded = provenance(data.metadata)
            if data.evaluated_in is None:
                report_margin_rule(name, data.metadata, data.env_spec)
                if changed := changes(recorded.env_code, environment_code(data.env_spec)):
                    warn(f"{name} was recorded in other code of its environment: {changed}; scores may not compare")
            warn_other_physics(name, recorded.versions, data.env_spec)
        else:
            inform(
                f"{name} names no environment, so nothing is evaluated during training; "
                "`offbench train --env RECIPE` names one"
            )


def group(specs: Sequence[RunSpec], datasets: Datasets, machine: Machine) -> list[Job]:
    """Return the runs in jobs for a machine."""
    jobs = []
    workers = 0 if machine.device == "cpu" else machine.workers
    by_times: dict[tuple[int, int, int], list[RunSpec]] = {}
    for spec in specs:
        by_times.setdefault(spec.times, []).append(spec)
    for same_times in by_times.values():
        compatible = _compatible_groups(same_times, datasets)
        share = max(1, machine.processes // len(compatible))  # of the processes, for each group
        for runs in compatible:
            size = machine.stack
            if isinstance(size, str):
                size = stack_size(runs[0], datasets[runs[0].dataset], machine.device)
            count = min(len(runs), -(-len(runs) // size // share) * share)
            for indices in np.array_split(np.arange(len(runs)), count):
                jobs.append(Job(tuple(runs[i] for i in indices), machine.device, workers))
    return jobs


def stack_size(spec: RunSpec, data: Transitions, device: str) -> int:
    """Return how many runs like `spec` train best as one stack on this device.

    On a GPU it is what the free memory holds, measured: the peak memory of stacks of one and of three runs over a few
    updates gives what a run takes in addition to the dataset.
    """
    if device == "cpu":
        return CPU_STACK
    peaks = []
    for runs in (1, 3):
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_reserved(device)
        stack = Stack(load_algorithm(spec.algorithm), [spec] * runs, {spec.dataset: data}, device)
        for _ in stack.train(4 * WARM_UP):
            pass
        peaks.append(torch.cuda.max_memory_reserved(device) - before)
        del stack
        gc.collect()
        torch.cuda.empty_cache()
    cost = max((peaks[1] - peaks[0]) / 2, 1.0)
    free, _ = torch.cuda.mem_get_info(device)
    return max(1, int((MEMORY_SHARE * free - peaks[0]) / cost) + 1)


def _compatible_groups(specs: Sequence[RunSpec], datasets: Datasets) -> list[list[RunSpec]]:
    """Group runs by algorithm, environment, shapes, precision and the settings that cannot differ within a stack."""
    groups: list[tuple[object, list[RunSpec]]] = []
    for spec in specs:
        data, settings = datasets[spec.dataset], fields(type(spec.config)).items()
        shared = [getattr(spec.config, name) for name, field in settings if not field.metadata.get("per_run")]
        key = (spec.algorithm, spec.precision, shared, data.observations.shape[1], data.actions.shape[1])
        for other_key, runs in groups:
            if key == other_key and same_environment(datasets[runs[0].dataset].env_spec, data.env_spec):
                runs.append(spec)
                break
        else:
            groups.append((key, [spec]))
    return [runs for _, runs in groups]


def check_folders(job: Job, datasets: Datasets) -> None:
    """Check that the runs' folders can be claimed, before any of them is. Raises OffbenchError if one cannot."""
    for spec in job.specs:
        spec.run.check(run_config(spec, datasets[spec.dataset], job.device, ""))


def pending(job: Job, datasets: Datasets, *, command: str = "") -> list[Job]:
    """Claim the runs' folders, and return what is left to train of them.

    Args:
        command: what the user typed, for config.json.

    Raises:
        OffbenchError: a folder holds another run, a run lacks files, or is further than its last step.
    """
    for spec in job.specs:
        data = datasets[spec.dataset]
        spec.run.claim(run_config(spec, data, job.device, command))
        _check_environment(spec, data)
        if data.env_spec:
            _check_evaluations(spec)
    left = [spec for spec in job.specs if not spec.run.diverged]
    return [dataclasses.replace(job, specs=tuple(specs)) for specs in by_common_step(left)]


def by_common_step(specs: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """Group unfinished runs of one job that can resume from a common step; runs without a checkpoint begin together.

    A job that was killed while it wrote its checkpoints has runs that are one checkpoint apart: they resume from the
    older one.

    Raises:
        OffbenchError: a run is further than its last step already.
    """
    left, groups = [], []
    steps_of = {spec.folder: set(checkpoints.steps(spec.folder)) for spec in specs}
    for spec in specs:
        newest = max(steps_of[spec.folder], default=0)
        if spec.run.finished(spec.steps):
            continue
        if newest > spec.steps:
            raise OffbenchError(f"{spec.folder} is at step {newest} already; give --steps {newest} or more, or --runs")
        left.append(spec)
    while left:
        counts = Counter(step for spec in left for step in steps_of[spec.folder] if step <= spec.steps)
        # the step that most runs share; among those the newest
        best = max(counts, key=lambda step: (counts[step], step), default=None)
        groups.append([spec for spec in left if best is None or best in steps_of[spec.folder]])
        left = [spec for spec in left if spec not in groups[-1]]
    return groups


def _check_environment(spec: RunSpec, data: Transitions) -> None:
    """Refuse a run that was evaluated in another environment so far, or in none.

    Other contact margins make another environment.
    """
    before = spec.run.config().env_spec
    if not same_environment(before, data.env_spec):
        raise OffbenchError(
            f"{spec.folder} was evaluated in another environment than it would be now "
            f"({before or 'none'}, not {data.env_spec or 'none'}); give the same --env as before, or {TRAIN_ANEW}"
        )


def _check_evaluations(spec: RunSpec) -> None:
    """Refuse a run that lacks an evaluation before its newest checkpoint: resuming it would give another score."""
    newest = max(checkpoints.steps(spec.folder), default=0)
    last = (newest - 1) // spec.eval_every * spec.eval_every  # the one of `newest` itself may not have finished
    if last > 0 and last not in spec.run.evaluations():
        raise OffbenchError(
            f"{spec.run.evaluations_path} lacks the evaluation of step {last}; put the file back, or delete the "
            "run to repeat it"
        )


def run_config(spec: RunSpec, data: Transitions, device: str, command: str) -> RunConfig:
    """Return the config.json of a run that starts now."""
    return RunConfig(
        algorithm=spec.algorithm,
        variant=spec.variant,
        label=spec.label,
        settings=settings_json(spec.config),
        dataset=data.dataset_id,
        dataset_sha256=data.content,
        seed=spec.seed,
        steps=spec.steps,
        eval_every=spec.eval_every,
        eval_episodes=spec.eval_episodes,
        references={"dataset": data.references, "d4rl": d4rl_reference(data.env_spec)},
        env_id=data.env_id,
        env_spec=data.env_spec,
        env_code=environment_code(data.env_spec) if data.env_spec else {},
        command=command.encode("utf-8", "backslashreplace").decode(),  # a path may hold bytes that are not UTF-8
        code=code_of(spec.algorithm),
        **training_platform(device, spec.precision),
    )
