"""Folders and files that change hands while a process writes: it stops, and nothing of another's is touched."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.cli.main import Terminated, _stop_on_signals, main
from offbench.common import hdf5_file
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import exclusive_lock, write_bytes
from offbench.common.hdf5_file import SafeFile
from offbench.data import minari_store
from offbench.data.export import export
from offbench.evaluation.similarity import read_similarity, similarity
from offbench.training import jobs
from offbench.training.run import Run
from offbench.training.trainer import Trainer

SMALL: dict[str, Any] = {"eval_every": 50, "eval_episodes": 1, "workers": 1, "hidden": (8, 8), "batch_size": 16}
FILES = ("evaluations.csv", "losses.csv", "policy.safetensors", "checkpoint-000000150.safetensors")


def once(patch: pytest.MonkeyPatch, owner: object, name: str, act: Callable[[], object], call: int = 1) -> None:
    """Do something before the n-th call of a function."""
    original, calls = getattr(owner, name), []

    def replacement(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            act()
        return original(*arguments, **options)

    patch.setattr(owner, name, replacement)


@pytest.mark.parametrize("lost", ["folder", "lock"])
def test_a_recording_that_has_lost_its_lock_leaves_anothers_alone(
    lost: str, tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = home / "minari" / ".offbench-tiny-random-v0.partial" / "data" / "main_data.hdf5"

    def lose() -> None:
        if lost == "folder":
            (home / "minari").rename(home / "moved")
        else:
            (home / "minari" / ".offbench-tiny-random-v0.lock").unlink()
            shutil.rmtree(home / "minari" / ".offbench-tiny-random-v0.partial")
        theirs.parent.mkdir(parents=True)
        theirs.write_bytes(b"another's")

    once(monkeypatch, SafeFile, "check", lose, call=2)
    with pytest.raises(OffbenchError, match="was moved, deleted or replaced while this process was writing"):
        offbench.collect(tiny[0], "random", behaviour_dir=tiny[1], workers=1, steps=600)
    assert theirs.read_bytes() == b"another's"
    assert minari_store.local_ids() == []


def test_a_lock_by_a_relative_path_is_lost_with_the_current_folder(home: Path) -> None:
    (home / "here").mkdir()
    os.chdir(home / "here")
    with exclusive_lock(Path("run/.lock"), "held"):
        write_bytes(Path("run/mine"), b"1")
        (home / "here").rename(home / "there")
        (home / "there/run").rename(home / "there/mine")
        with exclusive_lock(home / "there/run/.lock", "another's"):
            with pytest.raises(OffbenchError, match="run was moved, deleted or replaced"):
                write_bytes(Path("run/mine"), b"2")
            assert not (home / "there/run/mine").exists()
            assert (home / "there/run/.lock.holder").exists()


def test_a_folder_that_is_moved_at_the_last_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with exclusive_lock(tmp_path / "run/.lock", "held"):
        once(monkeypatch, os, "replace", lambda: (tmp_path / "run").rename(tmp_path / "moved"))
        with pytest.raises(OffbenchError, match="run was moved, deleted or replaced"):
            write_bytes(tmp_path / "run/mine", b"1")
    once(monkeypatch, os, "replace", lambda: shutil.rmtree(tmp_path / "free"))
    with pytest.raises(OffbenchError, match="moved or deleted meanwhile; run the command again"):
        write_bytes(tmp_path / "free/file", b"1")


def test_data_that_are_recorded_anew_before_the_training_begins(
    medium: str, tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def record() -> None:
        offbench.collect(tiny[0], "medium", behaviour_dir=tiny[1], workers=1, seed=1, overwrite=True)

    once(monkeypatch, jobs, "load_datasets", record)
    with pytest.raises(OffbenchError, match=r"trained on another content of tiny-medium-v0.*run the command again"):
        offbench.train("td3_bc", medium, steps=50, **SMALL)
    (folder,) = offbench.train("td3_bc", medium, steps=50, **SMALL)
    assert Run(folder).config().dataset_sha256 == offbench.load(medium).content_sha256


def test_a_run_that_is_claimed_anew_before_the_training_begins(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def claim() -> None:
        (path,) = Path("runs").rglob("config.json")
        path.write_text(json.dumps(json.loads(path.read_text()) | {"eval_episodes": 2}))

    once(monkeypatch, jobs, "load_datasets", claim)
    with pytest.raises(OffbenchError, match=r"was started with --eval-episodes 2, not 1.*run the command again"):
        offbench.train("td3_bc", medium, steps=50, **SMALL)


@pytest.mark.parametrize("change", ["delete", "replace"])
def test_a_config_that_is_lost_during_the_training_stops_it(
    change: str, medium: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (whole,) = offbench.train("td3_bc", medium, runs="whole", steps=150, **SMALL)
    kept: list[bytes] = []

    def lose() -> None:
        (path,) = Path("runs").rglob("config.json")
        kept.append(path.read_bytes())
        path.unlink() if change == "delete" else path.write_bytes(kept[0].replace(b'"seed": 0', b'"seed": 7'))

    with monkeypatch.context() as patch:
        once(patch, Trainer, "_checkpoint", lose, call=2)
        with pytest.raises(OffbenchError, match=r"config\.json was deleted or changed during the training"):
            offbench.train("td3_bc", medium, steps=150, **SMALL)
    folder = Path("runs", *whole.parts[1:])
    (folder / "config.json").write_bytes(kept[0])
    offbench.train("td3_bc", medium, steps=150, **SMALL)
    assert all((folder / name).read_bytes() == (whole / name).read_bytes() for name in FILES)


def test_a_similar_score_is_not_written_into_a_run_that_is_trained(medium: str) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=50, **SMALL)
    with Run(folder).locked(), pytest.raises(OffbenchError, match="is being trained"):
        similarity(folder)
    assert not (folder / "similarity.json").exists()
    assert read_similarity(Run(folder)) is None
    assert similarity(folder) == read_similarity(Run(folder))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("command", ["collect", "import-d4rl", "export", "export npz"])
@pytest.mark.parametrize("call", [1, 20])
def test_a_stop_within_a_write_of_hdf5_is_a_stop(
    command: str,
    number: int,
    call: int,
    medium: str,
    tiny: tuple[str, str],
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    ctrl_c: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An exception in a callback of libhdf5 would crash the process, or be lost."""
    words = {
        "collect": ["collect", tiny[0], "--level", "random", "--behaviour-dir", tiny[1], "--workers", "1"],
        "import-d4rl": ["import-d4rl", str(export(medium, home / "in.hdf5")), "--id", "back-v0"],
        "export": ["export", medium, "--out", "out.hdf5"],
        "export npz": ["export", medium, "--out", "out.npz"],
    }[command]
    before = {path for path in home.rglob("*") if path.suffix not in (".lock", ".tmp")}
    monkeypatch.setattr(hdf5_file, "memoryview", memoryview, raising=False)  # which `write` and `readinto` call
    once(monkeypatch, hdf5_file, "memoryview", lambda: signal.raise_signal(number), call)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 128 + number
    said = capsys.readouterr().err
    assert "offbench: stopped" in said
    assert "Traceback" not in said
    assert "bug" not in said
    after = {path for path in home.rglob("*") if path.suffix not in (".lock", ".tmp") and path.is_file()}
    assert after <= before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_between_writes_of_hdf5_is_not_delayed(number: int, tmp_path: Path, ctrl_c: None) -> None:
    """The next episode may take long, or never come."""
    with _stop_on_signals(), hdf5_file.safe_file(tmp_path / "x") as file:
        file.write(b"1")
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


def test_a_stop_within_a_finalizer_is_not_lost() -> None:
    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    with _stop_on_signals():
        thing = Finalized()
        del thing  # Python prints what a finalizer raises, and goes on
        with pytest.raises(Terminated):
            time.sleep(10)


@pytest.mark.parametrize("size", [0, 500, None])
def test_a_damaged_dataset_is_not_recorded_already(size: int | None, medium: str, tiny: tuple[str, str]) -> None:
    path = minari_store.path_of(medium) / "data" / "main_data.hdf5"
    path.unlink() if size is None else os.truncate(path, size)
    with pytest.raises(DamagedError, match="record or download it again: --overwrite replaces it"):
        offbench.collect(tiny[0], "medium", behaviour_dir=tiny[1], workers=1)


def test_the_current_folder_is_gone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "gone").mkdir()
    os.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(SystemExit) as stopped, contextlib.suppress(FileNotFoundError):
        main(["list"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "offbench: the current folder was deleted; change to another one\n"
