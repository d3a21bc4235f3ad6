"""Training on a GPU: against the CPU, captured against plain updates, stacks, precisions and resumed runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import offbench
from offbench.training.batches import draw_chunk
from offbench.training.devices import PRECISIONS, matmul_settings
from offbench.training.registry import load_algorithm
from offbench.training.run import Run
from offbench.training.stack import Stack
from tests.algorithm.test_cpu_capture import CASES, SMALL, stack_of, trained

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

UPDATES = 30  # of them 6 run before both phases are captured
# An element of a gradient that is almost 0 can change its sign by rounding, and Adam then takes a step of the other
# sign: after a few updates weights of learning rate 3e-4 differ by a few of these steps where they differ most.
STEP = 3e-4


def stack_on(device: str, algorithm: str, settings: dict[str, str], runs: int = 2) -> Stack:
    return stack_of(load_algorithm(algorithm), runs, device, **(SMALL | settings))


def assert_same_learning(
    ours: tuple[dict[str, Tensor], list[dict[str, float]]],
    theirs: tuple[dict[str, Tensor], list[dict[str, float]]],
    tolerance: float,
) -> None:
    """The same runs but for rounding: the mean of each logged quantity, and the weights in the mean."""
    for our_logs, their_logs in zip(ours[1], theirs[1], strict=True):
        for name, value in their_logs.items():
            assert our_logs[name] == pytest.approx(value, rel=tolerance, abs=tolerance), name
    for name, tensor in theirs[0].items():
        difference = (ours[0][name].cpu() - tensor.cpu()).abs()
        assert difference.double().mean() < tolerance, name


@pytest.fixture
def cpu_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let stacks on a GPU draw what stacks on the CPU draw."""

    def draw(seeds: Any, sizes: Any, batch: int, noise: Any, chunk: int, device: torch.device) -> Any:
        indices, drawn = draw_chunk(seeds, sizes, batch, noise, chunk, torch.device("cpu"))
        return indices.to(device), {name: values.to(device) for name, values in drawn.items()}

    monkeypatch.setattr("offbench.training.stack.draw_chunk", draw)


@pytest.mark.parametrize(("algorithm", "settings"), CASES)
def test_a_gpu_learns_what_the_cpu_does(algorithm: str, settings: dict[str, str], cpu_draws: None) -> None:
    found = []
    for device in ("cuda", "cpu"):
        with matmul_settings(device):
            found.append(trained(stack_on(device, algorithm, settings), UPDATES))
    assert_same_learning(found[0], found[1], tolerance=1e-3)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(("algorithm", "settings"), CASES)
def test_a_captured_update_equals_a_plain_one(algorithm: str, settings: dict[str, str], precision: str) -> None:
    captured, plain = (stack_on("cuda", algorithm, settings) for _ in range(2))
    plain.captured_update.eager = True
    with matmul_settings("cuda", precision):
        ours, theirs = trained(captured, UPDATES), trained(plain, UPDATES)
    assert captured.captured_update._graphs
    assert not plain.captured_update._graphs
    assert_same_learning(ours, theirs, tolerance=1e-5 if precision == "float32" else 1e-3)


@pytest.mark.parametrize(("algorithm", "settings"), CASES)
def test_a_run_is_the_same_alone_and_in_a_stack(algorithm: str, settings: dict[str, str]) -> None:
    with matmul_settings("cuda"):
        alone, stack = (trained(stack_on("cuda", algorithm, settings, runs), UPDATES) for runs in (1, 3))
    first = {name: value[:, :1] if value.dim() else value for name, value in stack[0].items()}
    assert_same_learning((first, stack[1][:1]), alone, tolerance=1e-3)
    other = {name: value[:, 1:2] for name, value in stack[0].items() if value.dim()}
    assert max(float((other[name] - first[name]).abs().max()) for name in other) > STEP, "seeds 0 and 1 are one run"


@pytest.mark.parametrize("precision", ["tf32", "bfloat16"])
def test_a_precision_rounds_products_and_nothing_else(precision: str) -> None:
    with matmul_settings("cuda"):
        exact = trained(stack_on("cuda", "td3_bc", {"hidden": "128,128"}), UPDATES)
    with matmul_settings("cuda", precision):
        rounded = trained(stack_on("cuda", "td3_bc", {"hidden": "128,128"}), UPDATES)
    assert all(tensor.dtype in (torch.float32, torch.int64) for tensor in rounded[0].values())
    assert any(not torch.equal(rounded[0][name], exact[0][name]) for name in exact[0])
    assert_same_learning(rounded, exact, tolerance=0.02)


def test_a_run_is_trained_evaluated_and_resumed(medium: str) -> None:
    arguments: dict[str, Any] = {"eval_every": 100, "eval_episodes": 2, "hidden": (16, 16), "batch_size": 32}
    (whole,) = offbench.train("bdb", medium, steps=400, runs="whole", device="cuda", **arguments)
    for steps in (150, 400):
        (parts,) = offbench.train("bdb", medium, steps=steps, runs="parts", device="cuda", **arguments)
    config = Run(Path(parts)).config()
    assert (config.device, config.hardware["gpu"]) == ("cuda", torch.cuda.get_device_name())
    ours, theirs = Run(Path(parts)).losses(), Run(Path(whole)).losses()
    assert list(Run(Path(parts)).evaluations()) == list(Run(Path(whole)).evaluations()) == [100, 200, 300, 400]
    assert math.isclose(ours[-1]["critic_loss"], theirs[-1]["critic_loss"], rel_tol=0.05)
