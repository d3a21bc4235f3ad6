"""Checkpoints at every evaluation while they are quick, else rarely; evaluations between two of them are repeated."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import offbench
from offbench.common import checkpoints
from offbench.common.scores import Evaluations
from offbench.training import trainer
from offbench.training.run import Run
from offbench.training.trainer import Trainer

SMALL: dict[str, Any] = {"steps": 100, "eval_every": 20, "eval_episodes": 2, "hidden": (8,), "batch_size": 8}


def train(dataset: str, runs: str) -> Run:
    (folder,) = offbench.train("td3_bc", dataset, runs=runs, workers=1, **SMALL)
    return Run(folder)


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The steps of the checkpoints that are written."""
    steps: list[int] = []
    save = checkpoints.save_checkpoint

    def noted(folder: Path, step: int, *content: Any) -> None:
        steps.append(step)
        save(folder, step, *content)

    monkeypatch.setattr(checkpoints, "save_checkpoint", noted)
    return steps


@pytest.fixture
def slow_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every checkpoint count as slow, and the share of the time for slow ones be used up by the first."""
    monkeypatch.setattr(trainer, "QUICK_SAVE", 0.0)
    monkeypatch.setattr(trainer, "SLOW_SAVE_SHARE", 1e-9)


def test_quick_checkpoints_are_written_at_every_evaluation(medium: str, written: list[int]) -> None:
    train(medium, "runs")
    assert written == [20, 40, 60, 80, 100]


@pytest.mark.usefixtures("slow_disk")
def test_slow_checkpoints_are_written_at_the_first_evaluation_and_the_end(medium: str, written: list[int]) -> None:
    train(medium, "runs")
    assert written == [20, 100]


@pytest.mark.parametrize(
    ("took", "ago", "due"), [(0.9, 0, True), (2, 39, False), (2, 41, True), (30, 599, False), (30, 601, True)]
)
def test_slow_checkpoints_take_a_twentieth_of_the_time(took: float, ago: float, due: bool) -> None:
    state = SimpleNamespace(_save_seconds=took, _saved=time.monotonic() - ago)
    assert Trainer._checkpoint_is_due(cast(Trainer, state)) == due


@pytest.mark.usefixtures("slow_disk")
@pytest.mark.parametrize("last", [40, 60])
def test_a_run_that_died_long_after_its_checkpoint_ends_with_the_same_bytes(
    medium: str, written: list[int], last: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, write = train(medium, "whole"), Run.write_evaluations
    written.clear()

    def dies(run: Run, evaluations: Evaluations) -> None:
        write(run, evaluations)
        if last in evaluations:
            raise RuntimeError("killed")

    with monkeypatch.context() as patched:
        patched.setattr(Run, "write_evaluations", dies)
        with pytest.raises(RuntimeError, match="killed"):
            train(medium, "runs")
    assert written == [20]
    run = train(medium, "runs")
    for name in ("evaluations.csv", "losses.csv", "policy.safetensors", "checkpoint-000000100.safetensors"):
        assert (run.folder / name).read_bytes() == (whole.folder / name).read_bytes(), name
