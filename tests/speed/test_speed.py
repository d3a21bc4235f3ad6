"""`make bench`: its sides start, work and answer; its targets are those that are judged."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from offbench.rollouts.rollouts import PARALLEL_EPISODES
from tests.speed import gpu, profile
from tests.speed.__main__ import environment, line
from tests.speed.rows import peer, side
from tests.speed.side import Side

# the other libraries' and the recording ones are left to `make bench`: they need another environment, or minutes
QUICK = {
    "train": {"algorithm": "td3_bc", "hidden": "16,16", "rows": "1000"},
    "evaluate": {"workers": "1", "episodes": "1"},
    "sb3_evaluate": {"episodes": "1"},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_side_works_for_about_as_long_as_it_is_told(name: str) -> None:
    working = Side(list(side(name, **QUICK[name])), environment())
    try:
        assert working.rate(0.05) > 0
        assert 50 < working.memory < 5000
    finally:
        working.close()


@pytest.mark.slow
def test_a_profile_adds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that advances a second whenever it is read, so that a busy machine cannot fail the test."""
    readings = itertools.count()
    monkeypatch.setattr(profile, "time", SimpleNamespace(perf_counter=lambda: next(readings)))
    monkeypatch.setattr(profile, "ROUNDS", 1)
    alone, environment_rest, worker_rest = profile.recording().values()
    assert alone > 0  # one second an episode
    assert environment_rest == 0  # as many episodes as of the physics alone
    assert alone + worker_rest == pytest.approx(alone / PARALLEL_EPISODES)  # all episodes are one play
    for algorithm in ("td3_bc", "bdb", "cql"):
        parts = profile.update(algorithm, "float32")
        assert parts.keys() == {profile.PRODUCTS, profile.ACTIVATIONS, profile.OPTIMISER, profile.REST}
        assert all(value > 0 for value in parts.values()), parts
    assert [row[-1] for row in profile.rows("x", "ms", {"one": 3.0, "other": 1.0})] == ["75%", "25%"]


def test_d3rlpys_side_has_the_standard_librarys_modules(tmp_path: Path) -> None:
    """Ours of the same names (profile) do not hide them, from any folder."""
    (tmp_path / "d3rlpy.py").write_text("import cProfile\nprint(cProfile.__doc__)\nraise SystemExit(7)\n")
    paths = f"{tmp_path}:{environment()['PYTHONPATH']}"
    command = [sys.executable, *peer("d3rlpy", "update", "td3_bc")[1:]]
    done = subprocess.run(command, env=environment() | {"PYTHONPATH": paths}, capture_output=True, check=False)
    assert done.returncode == 7, done.stderr


def test_a_row_that_misses_its_target_says_so() -> None:
    found = {"name": "x", "ratio": 0.59, "low": 0.5, "high": 0.7, "ours": 1.0, "theirs": 2.0, "memory": (1.0, 2.0)}
    assert line(found | {"at_least": 0.6, "aim": 0.8})[4] == "**no**"
    assert line(found | {"at_least": 0.59, "aim": 0.8})[4] == "yes"
    assert line(found | {"at_least": None, "aim": None})[4] == ""


def test_the_gpu_table_shows_the_committed_figures() -> None:
    results = Path(__file__).parents[2] / "docs" / "results"
    figures = json.loads((results / "gpu.json").read_text())["figures"]
    text = (results / "gpu.md").read_text()
    assert text == gpu.table(figures)
    assert f"| {figures['bdb, 25 runs, captured, tf32']['updates_per_second']:,.0f} |" in text
