"""The speed of training and of environment steps on this machine, each measured for half a second."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from offbench.algorithm.interface import Algorithm
from offbench.algorithm.mlp import matmul_backend
from offbench.data.transitions import Transitions
from offbench.envs.environments import make_env, spaces_of
from offbench.rollouts.rollouts import reset, step
from offbench.training.captured_update import TRACED_UPDATES
from offbench.training.devices import matmul_settings
from offbench.training.grouping import stack_size
from offbench.training.registry import load_algorithm
from offbench.training.spec import RunSpec
from offbench.training.stack import Stack

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SECONDS = 0.5  # minimum duration of a measurement
ROWS = 4096  # random transitions
ENV_STEPS = 2000
COUNTED = 12  # updates whose operations are counted: a multiple of the usual intervals between actor updates


@dataclass(frozen=True)
class Rate:
    """What one algorithm costs on one device.

    Attributes:
        updates_per_second: updates per second, summed over the runs of a stack.
        bytes_per_run: size of a checkpoint.
    """

    updates_per_second: float
    bytes_per_run: int


def measure(spec: RunSpec, env_spec: str, device: str) -> Rate:
    """Time the updates of runs like `spec` on random data of an environment's shapes, for half a second or more.

    It is one run on a CPU, and a stack of what fits on a GPU. The updates are those from the middle of the run on, as
    the first ones may be cheaper.
    """
    with matmul_settings(device, spec.precision):
        runs = 1 if device == "cpu" else stack_size(spec, random_data(env_spec), device)
        stack = random_stack(load_algorithm(spec.algorithm), [spec.config] * runs, env_spec, device)
        start = stack.step = spec.steps // 2
        updates = 2 * TRACED_UPDATES
        while True:
            began, first = time.perf_counter(), stack.step
            stack.train(first + updates)
            stack.captured_update.logged()  # waits for the device
            spent = time.perf_counter() - began
            if spent >= SECONDS and first > start:
                break
            updates = max(2, min(10 * updates, round(1.2 * SECONDS * updates / spent)))
    size = sum(t.numel() * t.element_size() for t in stack.run_tensors(0).values())
    return Rate(updates * runs / spent, size)


def operations(spec: RunSpec, env_spec: str) -> float:
    """Return the floating-point operations of an update's matrix products, as PyTorch counts them (2 m n k each)."""
    from torch.utils.flop_counter import FlopCounterMode

    stack = random_stack(load_algorithm(spec.algorithm), [spec.config], env_spec)
    stack.captured_update.eager = True
    stack.step = spec.steps // 2  # as `measure` does
    stack.train(stack.step + 2 * TRACED_UPDATES)  # past work that is done only once
    with matmul_backend("pytorch"), FlopCounterMode(display=False) as counter:
        stack.train(stack.step + COUNTED)
    return float(counter.get_total_flops()) / COUNTED


def random_stack(
    algorithm: type[Algorithm],
    configs: Sequence[DataclassInstance],
    env_spec: str,
    device: str = "cpu",
    *,
    rows: int = ROWS,
) -> Stack:
    """Return a stack of runs with seeds 0, 1, ... on the same random data of an environment's shapes."""
    specs = [
        RunSpec("", config, "random", seed, steps=1, eval_every=1, eval_episodes=1, folder=Path())
        for seed, config in enumerate(configs)
    ]
    return Stack(algorithm, specs, {"random": random_data(env_spec, rows)}, device)


def random_data(env_spec: str, rows: int = ROWS) -> Transitions:
    """Return random transitions of an environment's shapes."""
    observations, actions = spaces_of(make_env(env_spec), "the environment")
    rng = np.random.default_rng(0)
    return Transitions(
        dataset_id="random",
        content_sha256="",
        observations=rng.standard_normal((rows + 1, *observations.shape)).astype(np.float32),
        rows=np.arange(rows),
        actions=rng.uniform(-1, 1, (rows, *actions.shape)).astype(np.float32),
        rewards=rng.standard_normal(rows).astype(np.float32),
        masks=np.ones(rows, np.float32),
        ends=np.array([rows]),
        returns=np.zeros(1),
        low=actions.low,
        high=actions.high,
        metadata={"env_spec": env_spec},
    )


def step_seconds(env_spec: str) -> float:
    """Return the seconds of one step of an environment under uniform actions."""
    env = make_env(env_spec)
    reset(env, 0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(ENV_STEPS)]
    began = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated = step(env, action)
        if terminated or truncated:
            reset(env, None)
    spent = time.perf_counter() - began
    env.close()
    return spent / ENV_STEPS
