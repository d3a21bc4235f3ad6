"""What training costs here: a moment of each algorithm on made-up data, and of the environment."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offbench.algorithm.mlp import products_by
from offbench.data.transitions import Transitions
from offbench.envs.environments import make_env
from offbench.training.batches import Member
from offbench.training.devices import arithmetic, stack_size
from offbench.training.registry import load_algorithm
from offbench.training.run import Run
from offbench.training.stack import RECORDED, Stack

SECONDS = 0.5  # that a measurement lasts at least
ROWS = 4096  # made-up transitions
ENV_STEPS = 2000
COUNTED = 4  # updates whose operations are counted: of every kind that takes turns


@dataclass(frozen=True)
class Rate:
    """What one algorithm costs on one device.

    Attributes:
        updates: updates a second of all runs of a stack together.
        stack: runs of that stack.
        bytes_per_run: of a checkpoint.
    """

    updates: float
    stack: int
    bytes_per_run: int


def measure(
    algorithm: str, config: Any, spec: str, device: str, *, precision: str = "float32", stack: int = 0
) -> Rate:
    """Time an algorithm's updates on made-up data of an environment's shapes, for half a second or more.

    Args:
        stack: runs together; 0 for one on a CPU and for what fits on a GPU.
    """
    kind, member = load_algorithm(algorithm), made_up(algorithm, config, spec)
    with arithmetic(device, precision):
        runs = stack or (1 if device == "cpu" else stack_size(kind, member, device))
        learning = Stack(kind, [member] * runs, device)
        wanted = 2 * RECORDED
        while True:
            began, first = time.perf_counter(), learning.step
            for _ in learning.train(first + wanted):
                pass
            learning.logged()  # waits for the device
            spent = time.perf_counter() - began
            if spent >= SECONDS and first:
                break
            wanted = max(2, min(10 * wanted, round(1.2 * SECONDS * wanted / spent)))
    size = sum(t.numel() * t.element_size() for t in learning.run_tensors(0).values())
    return Rate(wanted * runs / spent, runs, size)


def operations(algorithm: str, config: Any, spec: str) -> float:
    """Return the floating-point operations of an update's matrix products, as PyTorch counts them (2 m n k each)."""
    from torch.utils.flop_counter import FlopCounterMode

    learning = Stack(load_algorithm(algorithm), [made_up(algorithm, config, spec)], "cpu")
    learning.program.eager = True
    for _ in learning.train(2 * RECORDED):  # past whatever happens only once
        pass
    with products_by("pytorch"), FlopCounterMode(display=False) as counter:
        for _ in learning.train(2 * RECORDED + COUNTED):
            pass
    return float(counter.get_total_flops()) / COUNTED


def made_up(algorithm: str, config: Any, spec: str) -> Member:
    """Return a run on random numbers of an environment's shapes."""
    env = make_env(spec)
    space: Any = env.action_space
    shape = env.observation_space.shape
    env.close()
    assert shape is not None
    rng = np.random.default_rng(0)
    data = Transitions(
        "calibration",
        "",
        rng.standard_normal((ROWS + 1, *shape)).astype(np.float32),
        np.arange(ROWS),
        rng.uniform(-1, 1, (ROWS, *space.shape)).astype(np.float32),
        rng.standard_normal(ROWS).astype(np.float32),
        np.ones(ROWS, np.float32),
        np.array([ROWS]),
        np.zeros(1),
        space.low,
        space.high,
        {"env_spec": spec},
    )
    return Member(Run(Path()), 0, config, data, algorithm)


def step_seconds(spec: str) -> float:
    """Return the seconds of one step of an environment under uniform actions."""
    env = make_env(spec)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(ENV_STEPS)]
    began = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    spent = time.perf_counter() - began
    env.close()
    return spent / ENV_STEPS
