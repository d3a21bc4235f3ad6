"""Runs that move, rows that repeat, text that commands: each is refused, named or made harmless."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from offbench import collect
from offbench.analysis import normalize
from offbench.cli.main import main
from offbench.common import files
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.text import printable
from offbench.data import transitions
from offbench.training import registry
from offbench.training.run import Run, find_runs
from tests.commands import refusal
from tests.made_runs import made_run

ROWS = "step,episode,return,length\n100,0,1.0,5\n100,1,2.0,5\n200,0,3.0,5\n200,1,4.0,5\n"


def trained(folder: Path, rows: str = ROWS, references: list[float] | None = None) -> Run:
    """Write a run of two evaluations of two episodes."""
    seed = int(folder.name.removeprefix("seed-"))
    folder.mkdir(parents=True)
    config = {
        "format": "offbench-run-1",
        "algorithm": "bc",
        "variant": "default",
        "settings": {},
        "dataset": "a-random-v0",
        "dataset_sha256": "0",
        "seed": seed,
        "steps": 200,
        "eval_episodes": 2,
        "references": {"dataset": references or [0.0, 10.0]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "evaluations.csv").write_text(rows)
    return Run(folder)


def test_a_lock_whose_folder_is_moved_stops_every_write(tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    with run.locked():
        run.write_losses([{"step": 1.0}])
        run.folder.rename(tmp_path / "moved")
        with pytest.raises(OffbenchError, match="moved, deleted or replaced"):
            run.write_losses([{"step": 2.0}])
    assert not run.folder.exists()
    assert Run(tmp_path / "moved").losses() == [{"step": 1.0}]


def test_a_lock_whose_folder_is_replaced_leaves_the_new_owner_alone(tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    with run.locked():
        shutil.rmtree(run.folder)
        run.folder.mkdir()
        (run.folder / ".lock").touch()  # as another trainer would
        (run.folder / ".holder").write_text("process 1 on another")
        with pytest.raises(OffbenchError, match="moved, deleted or replaced"):
            run.write_losses([{"step": 1.0}])
    assert [path.name for path in sorted(run.folder.iterdir())] == [".holder", ".lock"]


def test_leftovers_of_any_process_are_removed_under_the_lock(tmp_path: Path) -> None:
    run = trained(tmp_path / "seed-0")
    for pid in (1, os.getpid(), 999_999):
        (run.folder / f".policy.safetensors.{pid}.tmp").write_bytes(b"half")
    with run.locked():
        assert not list(run.folder.glob("*.tmp"))
        assert not list(run.folder.glob(".*.tmp"))


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (ROWS + "200,0,99999.0,5\n", "duplicated"),
        (ROWS + "-7,0,1.0,5\n", "-7"),
        (ROWS + "9" * 400 + ",0,1.0,5\n", "999"),
        (ROWS + "300,0,1.0,5\n300,1,1.0,5\n", "step 300"),
        (ROWS.replace("200,1,4.0,5\n", "200,1,4.0,5,6\n"), "cells"),
        (ROWS.replace("200,1,4.0,5\n", ""), "step 200 has 1"),
        (ROWS.replace("100,0,1.0,5\n", ""), "step 100"),
        (ROWS.replace("4.0", "1e308"), "1e+308"),
        (ROWS.replace("4.0", "nan"), "nan"),
        (ROWS.replace("4.0", "1_000"), "1_000"),
        (ROWS.replace("4.0", "٤"), "٤"),
        (ROWS.replace("4.0", " 4"), "' 4'"),
    ],
)
def test_rows_that_do_not_fit_their_key_are_damage(
    tmp_path: Path, rows: str, names: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A damaged run alone is refused; beside a sound one it is named and left out."""
    trained(tmp_path / "seed-1", rows)
    assert names in refusal(["normalize", "--runs", str(tmp_path)], capsys)
    trained(tmp_path / "seed-0")
    (row,) = normalize.score_runs(tmp_path)
    assert row["seeds"] == 1
    assert row["score"] == pytest.approx(25.0)  # mean of 1, 2, 3, 4 between 0 and 10
    said = capsys.readouterr().err
    assert str(tmp_path / "seed-1" / "evaluations.csv") in said
    assert names in said


@pytest.mark.parametrize("references", [[0, 5e-324], [0, 1e-300], [-1e308, 1e308], [1.0, 1.0]])
def test_references_beyond_reason_are_damage(
    tmp_path: Path, references: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    trained(tmp_path / "seed-0", references=references)
    assert "references" in refusal(["normalize", "--runs", str(tmp_path)], capsys)


def test_an_earlier_runs_precision_is_read_from_its_tf32(tmp_path: Path) -> None:
    run = trained(tmp_path / "seed-0")
    written = json.loads(run.config_path.read_text())
    run.config_path.write_text(json.dumps(written | {"tf32": True, "sessions": [{"step": 100, "tf32": False}]}))
    assert [session.precision for session in run.config().history] == ["tf32", "float32"]


@pytest.mark.parametrize(
    "change",
    [
        {"sessions": [3]},
        {"sessions": {}},
        {"sessions": None},
        {"env_spec": "{"},
        {"steps": 10**15},
        {"format": "offbench-run-2"},
        {"label": "a\nhopper-medium-v0  fake  999.9"},
        {"variant": "alpha=2\n\\input{x}"},
        {"dataset": "a\u2028b"},
    ],
)
def test_a_config_of_other_types_is_damage(
    tmp_path: Path, change: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(tmp_path / "seed-0")
    run.config_path.write_text(json.dumps(json.loads(run.config_path.read_text()) | change))
    line = refusal(["normalize", "--runs", str(tmp_path)], capsys)
    assert str(run.config_path) in line
    assert "delete the run" in line


def test_a_run_with_an_unreadable_config_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained(tmp_path / "seed-0")
    (trained(tmp_path / "seed-1").folder / "config.json").write_text("{")
    assert len(find_runs(tmp_path)) == 2
    assert normalize.score_runs(tmp_path)[0]["seeds"] == 1
    assert "seed-1/config.json" in capsys.readouterr().err


def test_escape_sequences_are_shown_not_obeyed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = trained(tmp_path / "seed-0")
    config = json.loads(run.config_path.read_text()) | {"dataset": "\x1b]0;owned\x07\x1b[2J\u202e"}
    run.config_path.write_text(json.dumps(config))
    main(["normalize", "--runs", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "\\x1b[2J" in shown
    assert not set(shown) & set("\x1b\x07\u202e")
    assert printable("a\tb\n±é") == "a\tb\n±é"
    assert printable("\u061c\u200b\u2028\U000e0041") == "\\u061c\\u200b\\u2028\\U000e0041"


@pytest.mark.parametrize(
    "cell", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", " =1", "\n=1", "-1 (A1*2)"]
)
def test_no_cell_is_a_formula(cell: str) -> None:
    text = normalize.render([{"dataset": cell, "return": -1.5}], "csv")
    header, row = csv.reader(io.StringIO(text))
    assert (header, row) == (["dataset", "return"], ["'" + cell, "-1.5"])


def test_a_fifo_is_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It would be waited for without end."""
    for name in ("grid.toml", "recipe.toml", "policy.safetensors", "ppo.zip"):
        os.mkfifo(tmp_path / name)
    names = {"benchmark": "grid.toml", "collect": "recipe.toml", "evaluate": "policy.safetensors"}
    for words in (*names.items(), ("collect inverted-pendulum --name x --policy", "ppo.zip")):
        line = refusal([*words[0].split(), str(tmp_path / words[1])], capsys)
        assert words[1] in line
        assert "not a regular file" in line


@pytest.mark.parametrize("kind", ["fifo", "/dev/full", "/dev/zero", "folder"])
def test_a_report_is_not_written_over_what_is_no_file(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An older page is read, to see whether offbench wrote it; a device would never end."""
    trained(tmp_path / "runs" / "seed-0")
    page = tmp_path / "report" / "index.html"
    page.parent.mkdir()
    if kind == "fifo":
        os.mkfifo(page)
    elif kind == "folder":
        page.mkdir()
    else:
        page.symlink_to(kind)
    line = refusal(["report", "--runs", str(tmp_path / "runs"), "--out", str(page.parent)], capsys)
    assert f"{page} is not a report of offbench" in line
    assert list(page.parent.iterdir()) == [page]


def offbench(*words: str, before: str = "", **how: str) -> subprocess.CompletedProcess[str]:
    command = f'{before} exec "$0" -m offbench "$@"'
    environment = os.environ | how
    return subprocess.run(
        ["sh", "-c", command, sys.executable, *words], env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_one_line() -> None:
    found = offbench("list", before="exec >/dev/full;")
    assert found.returncode == 2
    assert len(found.stderr.splitlines()) == 1
    assert "cannot write the output: No space left" in found.stderr


@pytest.mark.slow
@pytest.mark.parametrize("streams", ["2>/dev/full", "2>&-", "<&- >&- 2>&-"])
def test_a_log_that_cannot_be_written_stops_nothing(streams: str, home: Path) -> None:
    """Worker processes are started here too, which pass on the numbers of their streams."""
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--workers", "2"]
    assert offbench(*words, before=f"exec {streams};").returncode == 0
    assert offbench("show", "inverted-pendulum-random-v0").returncode == 0


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="`ulimit -n` of other systems begins elsewhere")
def test_few_file_descriptors_are_one_line_and_leave_nothing(home: Path) -> None:
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--workers", "2"]
    found = offbench(*words, before="ulimit -n 14;")
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
        found = offbench(
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


def test_odd_terminals_get_what_they_can_show() -> None:
    assert offbench("list", PYTHONIOENCODING="ascii").returncode == 0
    assert offbench("list", before="exec >&-;").returncode == 0


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
    found = offbench("list", "algorithms", **path)
    assert found.returncode == 0
    assert "td3_bc" in found.stdout
    assert (str(package) in found.stderr) == (fault == "binary")
    asked = offbench("train", "broken", "--dataset", "x-v0", **path)
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
