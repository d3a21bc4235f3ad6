"""What a grid leaves alone, and what the plan of a shard counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import offbench
from offbench.analysis.results import read_results
from offbench.benchmarks.benchmark import benchmark
from offbench.benchmarks.plan import prepare
from offbench.benchmarks.throughput import operations
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.envs.recipes import load_recipe
from offbench.training.registry import load_algorithm
from offbench.training.run import find_runs
from offbench.training.spec import RunSpec
from tests.benchmarks.test_benchmark import GRID, plan_lines
from tests.speed.arithmetic import ALGORITHMS


def silent(_: str) -> None:
    """Take a line of the plan and drop it."""


def test_runs_with_more_updates_than_the_grid_are_left_as_they_are(medium: str, home: Path) -> None:
    """As `benchmark medium` after `benchmark hopper-medium`, which trains the same runs further."""
    long, short = GRID.replace("DATASET", medium), GRID.replace("DATASET", medium).replace("seeds = 2", "seeds = 3")
    (home / "long.toml").write_text(long)
    (home / "short.toml").write_text(short.replace("steps = 200", "steps = 100"))
    assert benchmark(prepare("./long.toml", workers=1), say=silent)
    files = {run.policy_path: run.policy_path.read_bytes() for run in find_runs(home / "runs")}
    lines: list[str] = []
    assert benchmark(prepare("./short.toml", workers=1), say=lines.append)
    assert lines[0] == "short: 1 dataset, 3 variants, 5 runs, 1 to train"
    assert lines[1] == "  left as they are: 2 runs with more updates than the grid's steps"
    assert not [line for line in lines if "-" in line.partition(":")[2]]  # no negative times
    assert {path: path.read_bytes() for path in files} == files
    assert sorted(run.config().steps for run in find_runs(home / "runs")) == [100, 100, 100, 200, 200]
    run = next(run for run in find_runs(home / "runs") if run.config().seed == 2)
    run.mark_diverged(5, "actor.flat")
    (run.folder / "checkpoint-000000100.safetensors").rename(run.folder / "checkpoint-000000050.safetensors")
    assert plan_lines(prepare("./short.toml", workers=1))[0].endswith("5 runs, 0 to train")


def test_the_plan_of_a_shard_is_of_its_runs(medium: str, home: Path) -> None:
    (home / "grid.toml").write_text(GRID.replace("DATASET", medium))
    bench = prepare("./grid.toml", workers=1)
    firsts = [plan_lines(bench, (i, 3))[0] for i in range(3)]
    sizes = "grid: 1 dataset, 3 variants, 4 runs"
    assert firsts == [f"{sizes}, {count} to train by shard {i}/3" for i, count in enumerate((2, 1, 1))]


def test_a_dataset_that_nothing_can_record_is_refused_first(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = GRID.replace('"DATASET"', '"inverted-pendulum-random-v0", "inverted-pendulm-expert-v0"')
    (home / "grid.toml").write_text(text)
    for words in (["--plan"], []):
        with pytest.raises(SystemExit) as stopped:
            main(["benchmark", "./grid.toml", *words])
        assert stopped.value.code == 2
        assert "inverted-pendulm-expert-v0 is neither a local dataset nor" in capsys.readouterr().err
    assert not Path("minari").exists()


def test_train_takes_the_names_of_tables(medium: str) -> None:
    small = ["--steps", "20", "--eval-every", "20", "--eval-episodes", "1", "--hidden", "8", "--workers", "1"]
    for name in ("td3_bc (precision=float32)", "bdb (beta=0.5) (300,000 steps)"):
        main(["train", name, "--dataset", medium, *small])
    assert [method.named() for method in read_results("runs").methods] == [
        "td3_bc (hidden=8)",
        "bdb (beta=0.5, hidden=8)",
    ]
    with pytest.raises(SystemExit) as stopped:
        main(["train", "td3_bc (seeds=3)", "--dataset", medium, *small])
    assert stopped.value.code == 2


def test_runs_behind_a_link_are_found_once(medium: str, home: Path) -> None:
    offbench.train("bc", medium, steps=20, eval_every=20, eval_episodes=1, hidden=(8,), workers=1, runs="disk")
    (home / "runs").mkdir()
    (home / "runs" / medium).symlink_to(home / "disk" / medium)
    (home / "runs" / "again").symlink_to(home / "disk")
    (home / "disk" / "circle").symlink_to(home / "runs")
    assert len(find_runs(home / "runs")) == 1
    assert [row["method"] for row in offbench.normalize()] == ["bc"]
    with pytest.raises(OffbenchError, match="no evaluated runs"):
        offbench.normalize("elsewhere")


@pytest.mark.parametrize(("algorithm", "settings"), [("td3_bc", {}), ("bdb", {}), ("cql", {"bc_steps": 0})])
def test_the_plans_operations_are_those_counted_by_hand(algorithm: str, settings: dict[str, Any]) -> None:
    config: Any = load_algorithm(algorithm).Config(**settings)
    spec = RunSpec(algorithm, config, "any-v0", 0, 1, 1, 1, Path())
    by_hand = ALGORITHMS[algorithm](11, 3, config.batch_size, config.hidden)
    wanted = sum(often * 2 * np.prod([float(size) for size in product]) for often, product in by_hand)
    counted = operations(spec, load_recipe("hopper").env_spec())
    assert counted == pytest.approx(wanted, rel=1e-9)
