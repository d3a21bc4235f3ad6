"""losses.csv: each row is the mean over all updates since the row before, also where a training was stopped."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import offbench
from offbench.algorithm import Algorithm, Batch, Logs, Noise, setting
from offbench.common import checkpoints
from offbench.data.transitions import Transitions
from offbench.training.batches import CHUNK, draw_chunk
from offbench.training.devices import Machine
from offbench.training.jobs import train_job
from offbench.training.registry import load_algorithm, register
from offbench.training.spec import Job, RunSpec
from offbench.training.train import Training

BATCH = 16
SEEDS = (3, 8)


@dataclass(frozen=True)
class Config:
    batch_size: int = setting(BATCH, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((8,), "hidden layers", low=1)
    normalize: bool = setting(True, "normalize observations")


class Rewards(Algorithm[Config]):
    """Logs the mean reward of each batch, at every third update by another name too."""

    def setup(self, c: Config) -> None:
        self.actor = self.actor_network(self.action_dim, 1e-3)

    def phase(self, step: int) -> bool:
        return step % 3 == 0

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        rewards = batch.rewards.mean(-1)
        return {"all": rewards, "third": rewards} if phase else {"all": rewards}


def job_of(dataset: str, steps: int) -> Job:
    name = register(Rewards)
    config = load_algorithm(name).Config()
    folders = [Path("runs", str(seed)) for seed in SEEDS]
    specs = [RunSpec(name, config, dataset, s, steps, 250, 1, f) for s, f in zip(SEEDS, folders, strict=True)]
    (job,) = Training(specs, Machine("cpu", 1)).jobs
    return job


def by_hand(data: Transitions, seed: int, start: int, stop: int) -> dict[str, float]:
    """Return the means over the updates from `start` to `stop`, from the indices that the run draws."""
    rewards: list[float] = []
    for chunk in range(start // CHUNK, -(-stop // CHUNK)):
        indices, _ = draw_chunk([seed], [len(data)], BATCH, {}, chunk, torch.device("cpu"))
        rewards += data.rewards.astype(np.float64)[indices[:, 0].numpy()].mean(-1).tolist()
    means = rewards[start % CHUNK :][: stop - start]
    assert len(means) == stop - start
    third = [mean for step, mean in zip(range(start, stop), means, strict=True) if step % 3 == 0]
    return {"all": float(np.mean(means)), "third": float(np.mean(third))}


@pytest.mark.parametrize("stops", [0, 2])
def test_losses_are_means_over_the_updates_since_the_row_before(stops: int, home: Path) -> None:
    """A deadline that has passed ends a training after one chunk: at 100 and at 200, before the first row."""
    dataset = offbench.collect("hopper", "random", steps=200, workers=1)
    for i in range(stops):
        job = replace(job_of(dataset, 500), deadline=1.0)
        train_job(job, lambda *_: None)
        assert checkpoints.steps(job.first.folder)[0] == 100 * (i + 1)
        assert not job.first.run.losses_path.read_text().strip()
    train_job(job_of(dataset, 500), lambda *_: None)
    data = offbench.load(dataset)
    for seed in SEEDS:
        with open(f"runs/{seed}/losses.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row.pop("step") for row in rows] == ["250", "500"]
        for row, start in zip(rows, (0, 250), strict=True):
            found = {name: float(value) for name, value in row.items()}
            assert found == pytest.approx(by_hand(data, seed, start, start + 250), rel=2e-5)
