"""The time and the disk space of a plan against numbers computed by hand, and against what a recording takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest

import offbench
from offbench.benchmarks import plan
from offbench.benchmarks.grid import GridDataset
from offbench.benchmarks.plan import Cost, prepare, write_plan
from offbench.benchmarks.throughput import Rate, operations
from offbench.envs.recipes import load_recipe
from offbench.training.devices import Machine
from offbench.training.registry import load_algorithm
from offbench.training.spec import RunSpec
from tests.benchmarks.test_benchmark import GRID

RATE = Rate(updates_per_second=1000.0, bytes_per_run=10**9)
MISSING = '{id = "mine-v0", env = "inverted-pendulum", level = "random", steps = 10_000_000}'


def test_a_run_costs_its_updates_and_its_evaluations() -> None:
    """1,050 updates at 1,000/s, and 11 evaluations of 3 episodes of 1,000 steps of a millisecond."""
    spec = RunSpec("bc", load_algorithm("bc").Config(), "any-v0", 0, 1050, 100, 3, Path())
    env_spec = load_recipe("inverted-pendulum").env_spec()
    assert plan._run_seconds(spec, RATE, 1e-3, env_spec) == pytest.approx(1.05 + 33)
    exact = dataclasses.replace(spec, steps=1000)
    assert plan._run_seconds(exact, RATE, 1e-3, env_spec) == pytest.approx(1 + 30)


def test_a_plan_adds_up_time_and_disk_space(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs of TD3+BC and one of each of two BDB variants, on two processes, with a dataset to be recorded."""
    monkeypatch.setattr(plan, "measure", lambda *_: RATE)
    monkeypatch.setattr(plan, "operations", lambda *_: 1e9)
    monkeypatch.setattr(plan, "step_seconds", lambda _: 1e-3)
    monkeypatch.setattr(plan, "_bytes_per_step", lambda *_: 50)
    costs: list[Cost] = []
    totals = plan._totals

    def noted(found: list[Cost], machine: Machine) -> Iterator[str]:
        costs.extend(found)
        return totals(found, machine)

    monkeypatch.setattr(plan, "_totals", noted)
    (home / "grid.toml").write_text(GRID.replace('"DATASET"', MISSING))
    lines: list[str] = []
    update_seconds = write_plan(prepare("./grid.toml", workers=2, device="cpu"), say=lines.append)
    td3_bc = 200 / 1000 + 2 * 2 * 1000 * 1e-3  # updates; evaluations x episodes x steps
    bdb = 100 / 1000 + 1 * 2 * 1000 * 1e-3
    assert [cost.seconds for cost in costs] == pytest.approx([2 * td3_bc / 2, bdb / 2, bdb / 2, 10_000 / 2])
    assert [cost.disk for cost in costs] == [4e9, 2e9, 2e9, 5e8]  # two checkpoints for each run
    assert [cost.products for cost in costs] == [2 * 200 * 1e9, 100 * 1e9, 100 * 1e9, 0]
    assert update_seconds == pytest.approx({"td3_bc": td3_bc / 200, "bdb": bdb / 100})
    assert lines[-2] == "  on 2 processes of one thread about 1 h 23 min, 8.5 GB of disk (measured just now)"


@pytest.mark.parametrize(
    ("env", "level"), [("inverted-pendulum", "expert"), ("halfcheetah", "random"), ("hopper", "random")]
)
def test_a_transition_takes_as_much_disk_space_as_the_plan_says(env: str, level: str, home: Path) -> None:
    """In the dataset and in the cache, for episodes of 1,000 steps and of 22."""
    offbench.load(offbench.collect(env, level, steps=2000, workers=1))
    files = [path for folder in ("minari", "cache") for path in (home / folder).rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 2000
    length = plan._episode_length(GridDataset("x-v0", env, level))
    assert plan._bytes_per_step(load_recipe(env).env_spec(), length) == pytest.approx(size, rel=0.2)


def test_the_operations_of_an_update_are_those_of_the_middle_of_a_run() -> None:
    """BEAR's warm-up leaves out the critic in the actor's loss."""
    config = load_algorithm("bear").Config
    small = {"hidden": (16, 16), "vae_hidden": (16,), "batch_size": 8}
    costs = []
    for warm_up in (0, 400, 1000):
        spec = RunSpec("bear", config(**small, warm_up_steps=warm_up), "any-v0", 0, 1000, 100, 3, Path())
        costs.append(operations(spec, load_recipe("inverted-pendulum").env_spec()))
    assert costs[0] == costs[1] > costs[2]
