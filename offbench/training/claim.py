"""Run folders: which may be trained, and what is left to train of a job."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence

from offbench.common import checkpoints
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.common.provenance import training_platform
from offbench.data.transitions import Transitions
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import same_environment
from offbench.envs.recipes import d4rl_reference_of_env
from offbench.training.datasets import Datasets
from offbench.training.run import TRAIN_ANEW
from offbench.training.run_config import RunConfig
from offbench.training.source_code import code_of
from offbench.training.spec import Job, RunSpec, settings_json


def check_folders(job: Job, datasets: Datasets) -> None:
    """Check that the runs' folders can be claimed, before any of them is. Raises OffbenchError if one cannot."""
    for spec in job.specs:
        spec.run.check(new_run_config(spec, datasets[spec.dataset], job.device, ""))


def claim_unfinished(job: Job, datasets: Datasets, *, command: str = "") -> list[Job]:
    """Claim the folders of a job's runs, and return what is left to train of them.

    Args:
        command: what the user typed, for config.json.

    Raises:
        OffbenchError: a folder holds another run, a run lacks files, or is further than its last step.
    """
    for spec in job.specs:
        data = datasets[spec.dataset]
        spec.run.claim(new_run_config(spec, data, job.device, command))
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


def check_algorithm_code(job: Job) -> None:
    """Check that this process has imported the algorithm's code that a job's runs were claimed with.

    Raises:
        OffbenchError: it was edited between the claim and the import.
    """
    for spec in job.specs:
        _check_code(spec, spec.run.config().code, code_of(spec.algorithm))


def check_environment_code(job: Job) -> None:
    """As `check_algorithm_code`, for the code and the files of the environment."""
    for spec in job.specs:
        if (config := spec.run.config()).env_spec:
            _check_code(spec, config.env_code, environment_code(config.env_spec))


def _check_code(spec: RunSpec, claimed: Mapping[str, str], imported: Mapping[str, str]) -> None:
    if changed := describe_changes(claimed, imported):
        raise OffbenchError(
            f"{spec.folder}: code was edited since this command began ({changed}); run the command again"
        )


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
    newest = spec.run.newest_checkpoint()
    last = (newest - 1) // spec.eval_every * spec.eval_every  # the one of `newest` itself may not have finished
    if last > 0 and last not in spec.run.evaluations():
        raise OffbenchError(
            f"{spec.run.evaluations_path} lacks the evaluation of step {last}; put the file back, or delete the "
            "run to repeat it"
        )


def new_run_config(spec: RunSpec, data: Transitions, device: str, command: str) -> RunConfig:
    """Return the RunConfig of a run that starts now."""
    return RunConfig(
        algorithm=spec.algorithm,
        variant=spec.variant,
        label=spec.label,
        settings=settings_json(spec.config),
        dataset=data.dataset_id,
        dataset_sha256=data.content_sha256,
        seed=spec.seed,
        steps=spec.steps,
        eval_every=spec.eval_every,
        eval_episodes=spec.eval_episodes,
        references={"dataset": data.references, "d4rl": d4rl_reference_of_env(data.env_spec)},
        env_id=data.env_id,
        env_spec=data.env_spec,
        env_code=environment_code(data.env_spec) if data.env_spec else {},
        command=command.encode("utf-8", "backslashreplace").decode(),  # a path may hold bytes that are not UTF-8
        code=code_of(spec.algorithm),
        **training_platform(device, spec.precision),
    )
