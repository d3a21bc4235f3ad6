"""From nothing to a score, on a real environment: SAC trained here, five levels, three algorithms, one table."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import offbench
from offbench.data.levels import LEVELS
from offbench.training.registry import algorithm_names

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.slow
def test_inverted_pendulum_goes_the_whole_way(offbench_cli: Cli, home: Path) -> None:
    done = offbench_cli("collect", "inverted-pendulum", "--level", "medium", "--retrain", "--steps", "20000")
    assert done.returncode == 0, done.stderr
    assert "no behaviour agent in behaviour yet; training one first" in done.stderr
    for level in LEVELS:
        if level != "medium":
            words = [] if level == "medium-replay" else ["--steps", "20000"]
            done = offbench_cli("collect", "inverted-pendulum", "--level", level, "--retrain", *words)
            assert done.returncode == 0, done.stderr
            assert "no behaviour agent" not in done.stderr  # the ladder is there now
    means = {level: offbench.show(f"inverted-pendulum-{level}-v0").returns.mean() for level in LEVELS}
    assert means["expert"] > 900  # SAC has solved it
    assert means["random"] < means["medium"] < means["expert"]
    assert means["random"] < means["medium-replay"] < means["expert"]
    assert means["medium"] < means["medium-expert"] < means["expert"]
    dataset = "inverted-pendulum-medium-expert-v0"
    for algorithm, extra in {"td3_bc": [], "bdb": ["--seeds", "0:2"], "cql": ["--bc-steps", "200"]}.items():
        sizes = ["--steps", "600", "--eval-every", "300", "--eval-episodes", "4", "--hidden", "64,64"]
        done = offbench_cli("train", algorithm, "--dataset", dataset, *sizes, *extra)
        assert done.returncode == 0, done.stderr
    rows = offbench.normalize("runs")
    assert {row["algorithm"] for row in rows} == {"td3_bc", "bdb", "cql"} <= set(algorithm_names())
    assert all(row["steps"] == 600 and np.isfinite(row["score"]) for row in rows)
    done = offbench_cli("normalize", "--plot", "curves.png")
    assert done.returncode == 0
    assert done.stdout.count(dataset) == 3
    run = next(Path("runs").rglob("td3_bc/*/seed-0"))
    done = offbench_cli("evaluate", str(home / run), "--episodes", "3")
    assert done.returncode == 0, done.stderr
    assert "normalized score" in done.stdout


@pytest.mark.slow
def test_td3_bc_learns_from_expert_data(home: Path) -> None:
    """A short training on the shipped expert's data must be far above chance."""
    name = offbench.collect("inverted-pendulum", "expert", steps=20_000)
    offbench.train("td3_bc", name, steps=2_000, eval_every=500, eval_episodes=5, hidden=(64, 64))
    (row,) = offbench.normalize("runs")
    assert row["score"] > 30
