"""`make bench`: its sides start, work and answer; its targets are those that are judged."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from tests.speed import profile
from tests.speed.__main__ import environment, line
from tests.speed.rows import peer, side
from tests.speed.side import Side

# d3rlpy's and the recording ones are left to `make bench` itself: they need an environment of their own, and minutes
QUICK = {
    "train": {"algorithm": "td3_bc", "hidden": "16,16", "rows": "1000"},
    "products": {"algorithm": "bdb"},
    "product": {"way": "onednn"},
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
    monkeypatch.setattr(profile, "ROUNDS", 1)
    for parts in (profile.recording(), *map(profile.update, ("td3_bc", "bdb", "cql"))):
        assert all(0 < value < 10_000 for value in parts.values()), parts
    assert [row[-1] for row in profile.rows("x", "ms", {"one": 3.0, "other": 1.0})] == ["75%", "25%"]


def test_d3rlpys_side_has_the_standard_librarys_modules(tmp_path: Path) -> None:
    """Ours of the same names (profile) do not hide them, from any folder."""
    (tmp_path / "d3rlpy.py").write_text("import cProfile\nprint(cProfile.__doc__)\nraise SystemExit(7)\n")
    paths = f"{tmp_path}:{environment()['PYTHONPATH']}"
    command = [sys.executable, *peer("td3_bc")[1:]]
    done = subprocess.run(command, env=environment() | {"PYTHONPATH": paths}, capture_output=True, check=False)
    assert done.returncode == 7, done.stderr


def test_a_row_that_misses_its_target_says_so() -> None:
    found = {"name": "x", "ratio": 0.59, "low": 0.5, "high": 0.7, "ours": 1.0, "theirs": 2.0, "memory": (1.0, 2.0)}
    assert line(found | {"at_least": 0.6, "aim": 0.8})[4] == "**no**"
    assert line(found | {"at_least": 0.59, "aim": 0.8})[4] == "yes"
    assert line(found | {"at_least": None, "aim": None})[4] == ""


FAULTS = """
import resource, torch
from offbench.devices import arithmetic

def update():
    large = [torch.ones(2**21) for _ in range(8)]  # 64 MB, of which glibc by itself would keep half
    return float(large[0][0])

with arithmetic("cpu", tf32=False):
    update()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        update()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library's memory is its own affair")
def test_a_training_keeps_the_memory_that_an_update_frees() -> None:
    """64 MB are 16,384 pages: ten updates ask for less than half of one, whatever lies where."""
    found = subprocess.run([sys.executable, "-c", FAULTS], check=True, capture_output=True, text=True)
    assert int(found.stdout) < 8_192
