"""Too little memory, too few file descriptors, broken packages and streams: one line that names the reason."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from offbench import collect
from offbench.cli.main import main
from offbench.common import files
from offbench.common.errors import DamagedError, OffbenchError
from offbench.data import transitions
from offbench.training import registry
from tests.commands import refusal, run_offbench
from tests.made_runs import made_run


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_one_line() -> None:
    found = run_offbench("list", before="exec >/dev/full;")
    assert found.returncode == 2
    assert len(found.stderr.splitlines()) == 1
    assert "cannot write the output: No space left" in found.stderr


@pytest.mark.slow
@pytest.mark.parametrize("streams", ["2>/dev/full", "2>&-", "<&- >&- 2>&-"])
def test_a_log_that_cannot_be_written_stops_nothing(streams: str, home: Path) -> None:
    """Worker processes are started here too, which pass on the numbers of their streams."""
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--workers", "2"]
    assert run_offbench(*words, before=f"exec {streams};").returncode == 0
    assert run_offbench("show", "inverted-pendulum-random-v0").returncode == 0


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="`ulimit -n` of other systems begins elsewhere")
def test_few_file_descriptors_are_one_line_and_leave_nothing(home: Path) -> None:
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--workers", "2"]
    found = run_offbench(*words, before="ulimit -n 14;")
    assert found.returncode == 2
    assert len(found.stderr.splitlines()) == 1, found.stderr
    assert "ulimit -n" in found.stderr
    assert not [path for path in (home / "minari").iterdir() if path.suffix != ".lock"]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="`ulimit -n` of other systems begins elsewhere")
def test_few_file_descriptors_do_not_make_a_cache_or_an_environment_faulty(home: Path) -> None:
    dataset = collect("inverted-pendulum", "random", steps=300, workers=1)
    transitions.load(dataset)
    before = {path: path.stat().st_mtime_ns for path in (home / "cache").rglob("*.npy")}
    for limit in (8, 12):
        found = run_offbench(
            "train", "td3_bc", "--dataset", dataset, "--hidden", "8", "--steps", "2", before=f"ulimit -n {limit};"
        )
        assert found.returncode == 2
        assert len(found.stderr.splitlines()) == 1, found.stderr
        assert "ulimit -n" in found.stderr
        assert not any(word in found.stderr for word in ("converting", "delete", "--env"))
    assert before == {path: path.stat().st_mtime_ns for path in (home / "cache").rglob("*.npy")}


def test_full_shared_memory_is_one_line() -> None:
    own = ["unshare", "-m", "sh", "-c"]
    full = "mount -t tmpfs -o size=4k,nr_inodes=1 tmpfs /dev/shm"
    if not shutil.which("unshare") or subprocess.run([*own, full], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small tmpfs at /dev/shm")
    words = ["-m", "offbench", "collect", "inverted-pendulum", "--level", "random", "--steps", "300"]
    words += ["--workers", "2"]
    command = [*own, f'{full}; exec "$0" "$@"', sys.executable, *words]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert len(found.stderr.splitlines()) == 1, found.stderr
    assert "/dev/shm" in found.stderr


def test_an_unknown_backend_of_matplotlib(
    home: Path, offbench_cli: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    """Figures are files, whatever the user's other programs draw on."""
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50.0)
    done = offbench_cli("report", env=os.environ | {"MPLBACKEND": "nonsense"})
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.parametrize(
    ("error", "names"),
    [
        (MemoryError("Unable to allocate 8 EiB"), "not enough memory (Unable to allocate 8 EiB)"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried ..."), "not enough memory (Default"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "not enough memory (CUDA"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "not enough memory (libtorch"),
        (MemoryError(), "not enough memory (for this command)"),
        (RuntimeError("size mismatch"), "bug in offbench"),
        (OSError(24, "Too many open files", "a.csv"), "ulimit -n"),
        (ZeroDivisionError("by zero"), "bug in offbench"),
        (RecursionError("too deep"), "bug in offbench"),
    ],
)
def test_whatever_a_command_raises_is_one_line(
    error: Exception, names: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("offbench.tools.inventory.inventory", fail)
    assert names in refusal(["list"], capsys)
    monkeypatch.setenv("OFFBENCH_TRACEBACK", "1")
    with pytest.raises(SystemExit):
        main(["list"])
    assert "in fail" in capsys.readouterr().err


MINE = """
from offbench.algos.bc import BC

class Mine(BC):
    def update(self, *_, **__):
        raise ZeroDivisionError("of mine")
"""


@pytest.mark.parametrize("processes", ["1", "2"])
def test_an_error_in_an_installed_algorithm_keeps_its_traceback(
    processes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In this process, and once for the worker processes of two runs."""
    package = tmp_path / "mine-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[offbench.algos]\nmine = mine:Mine\n")
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    registry._entry_points.cache_clear()
    dataset = collect("inverted-pendulum", "random", steps=300, workers=1)
    words = ["--seeds", "0:" + processes, "--workers", processes, "--steps", "2", "--hidden", "8", "--batch-size", "8"]
    with pytest.raises(SystemExit) as stopped:
        main(["train", "mine", "--dataset", dataset, *words])
    registry._entry_points.cache_clear()
    said = capfd.readouterr().err
    assert stopped.value.code == 2
    assert said.count('mine.py", line 6, in update') == 1
    assert "an error in mine: ZeroDivisionError: of mine" in said.splitlines()[-1]


@pytest.mark.parametrize("fault", ["exits", "missing", "damaged", "binary", "gymnasium"])
def test_a_broken_package_stops_nothing_else(fault: str, tmp_path: Path) -> None:
    """It is named where it is asked for, or where its entry points cannot be read."""
    package = tmp_path / "broken-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    group = "gymnasium.envs" if fault == "gymnasium" else "offbench.algos"
    text = {"damaged": b"[offbench.algos\nbroken\n", "binary": b"[offbench.algos]\n\xf5 = x:Y\n"}
    points = text.get(fault, f"[{group}]\nbroken = broken_module:Broken\n".encode())
    (package / "entry_points.txt").write_bytes(points)
    if fault in ("exits", "gymnasium"):
        (tmp_path / "broken_module.py").write_text("raise SystemExit(3)\n")
    path = {"PYTHONPATH": str(tmp_path)}
    found = run_offbench("list", "algorithms", **path)
    assert found.returncode == 0
    assert "td3_bc" in found.stdout
    assert (str(package) in found.stderr) == (fault == "binary")
    asked = run_offbench("train", "broken", "--dataset", "x-v0", **path)
    assert asked.returncode == 2
    assert "Traceback" not in asked.stderr
    words = {"exits": "does not import: SystemExit: 3", "missing": "No module named 'broken_module'"}
    assert words.get(fault, "unknown algorithm 'broken'") in asked.stderr.splitlines()[-1]


def test_damage_brings_no_error_of_a_parser_out() -> None:
    for error in (RecursionError(), KeyError("x"), StopIteration(), AssertionError("odd")):
        with pytest.raises(DamagedError, match="delete it"), files.read_errors("a.bin", "is damaged", "delete it"):
            raise error


@pytest.mark.parametrize(
    "error", [MemoryError("8 EiB"), RuntimeError("can't allocate memory"), OSError(12, "No memory")]
)
def test_no_memory_is_no_damage(error: Exception) -> None:
    """An absurd size in a damaged file may ask for it, but so does a sound file beside other programs."""
    with (
        pytest.raises(OffbenchError, match="close other programs") as raised,
        files.read_errors("a.bin", "is bad", "delete"),
    ):
        raise error
    assert not isinstance(raised.value, DamagedError)
