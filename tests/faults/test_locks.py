"""Locks of folders that are moved or replaced, and what lies in the place of a lock's files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from offbench.common.errors import OffbenchError
from offbench.common.files import exclusive_lock
from offbench.training.run import Run
from tests.made_runs import small_run


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
    run = small_run(tmp_path / "seed-0")
    for pid in (1, os.getpid(), 999_999):
        (run.folder / f".policy.safetensors.{pid}.tmp").write_bytes(b"half")
    with run.locked():
        assert not list(run.folder.glob("*.tmp"))
        assert not list(run.folder.glob(".*.tmp"))


@pytest.mark.parametrize("kind", ["link", "fifo"])
def test_a_link_or_fifo_in_place_of_the_holder_file_is_replaced(kind: str, tmp_path: Path) -> None:
    precious, holder = tmp_path / "precious", tmp_path / "run" / ".lock.holder"
    precious.write_text("mine")
    holder.parent.mkdir()
    holder.symlink_to(precious) if kind == "link" else os.mkfifo(holder)
    with exclusive_lock(tmp_path / "run" / ".lock", "the run is being trained"):
        assert holder.read_text().startswith(f"process {os.getpid()} on ")
    assert precious.read_text() == "mine"
    assert not holder.exists()
