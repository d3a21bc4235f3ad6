"""Which runs train together: same algorithm, environment, shapes, schedule and settings that are not `per_run`.

Groups fit the device and leave no process idle. They do not depend on what is trained already.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence

import numpy as np
import torch

from offbench.common.settings import fields
from offbench.data.transitions import Transitions
from offbench.envs.environments import same_environment
from offbench.training.captured_update import WARM_UP
from offbench.training.datasets import Datasets
from offbench.training.devices import Machine
from offbench.training.registry import load_algorithm
from offbench.training.spec import Job, RunSpec
from offbench.training.stack import Stack

CPU_STACK = 8  # runs of a process: a larger stack is no faster on a CPU, and its runs end together
MEMORY_SHARE = 0.8  # share of a GPU's free memory that a stack may use


def group(specs: Sequence[RunSpec], datasets: Datasets, machine: Machine) -> list[Job]:
    """Group runs into jobs for a machine."""
    jobs = []
    workers = 0 if machine.device == "cpu" else machine.workers
    by_schedule: dict[tuple[int, int, int], list[RunSpec]] = {}
    for spec in specs:
        by_schedule.setdefault(spec.schedule, []).append(spec)
    for same_schedule in by_schedule.values():
        compatible = _compatible_groups(same_schedule, datasets)
        share = max(1, machine.processes // len(compatible))  # number of processes for each group
        for runs in compatible:
            size = machine.stack
            if isinstance(size, str):
                size = stack_size(runs[0], datasets[runs[0].dataset], machine.device)
            rounds = math.ceil(math.ceil(len(runs) / size) / share)  # in each, every process of the share trains a job
            count = min(len(runs), rounds * share)
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
        stack.train(4 * WARM_UP)
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
