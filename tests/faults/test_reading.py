"""Files that cannot be read for other reasons than their content: the reason is named, and the remedy works."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import offbench
from offbench.common import checkpoints
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import read_errors
from offbench.data import minari_store
from offbench.data.export import export
from offbench.training.run import Run
from offbench.verification.verify import verify
from tests.made_datasets import episode, foreign

HOLD = "import h5py, sys, time; file = h5py.File(sys.argv[1], 'r+'); print('held', flush=True); time.sleep(60)"


@pytest.fixture
def house() -> str:
    """The id of a dataset that somebody else made."""
    return foreign("house-v0", [episode(30, 0, True), episode(50, 100, False)])


def hdf5(name: str) -> Path:
    return minari_store.path_of(name) / "data" / "main_data.hdf5"


def attempts(name: str) -> dict[str, Any]:
    """What reads a dataset's arrays."""
    return {
        "load": lambda: offbench.load(name),
        "show": lambda: offbench.show(name),
        "export": lambda: export(name, "out.npz"),
        "verify": lambda: verify(name, workers=1),
    }


def test_a_file_that_is_being_written_is_not_called_damaged(house: str) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLD, str(hdf5(house))], stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        try:
            for attempt in attempts(house).values():
                with pytest.raises(OffbenchError, match=r"cannot read house-v0.*HDF5_USE_FILE_LOCKING") as error:
                    attempt()
                assert not isinstance(error.value, DamagedError)
        finally:
            writer.kill()
    for attempt in attempts(house).values():
        attempt()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_permission_is_named(house: str) -> None:
    hdf5(house).chmod(0)
    for attempt in attempts(house).values():
        with pytest.raises(OffbenchError, match="check its permissions"):
            attempt()


def test_a_cut_file_is_damaged_and_nothing_is_said_of_writing(house: str) -> None:
    os.truncate(hdf5(house), hdf5(house).stat().st_size // 2)
    for name, attempt in attempts(house).items():
        if name == "verify":
            assert {finding.code for finding in attempt().findings} == {"unreadable"}
            continue
        with pytest.raises(DamagedError, match="record or download it again") as error:
            attempt()
        assert "cannot write" not in str(error.value)


def test_a_missing_package_is_named(house: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataset in arrow's format, where pyarrow is not installed."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "minari.dataset._storages.arrow_storage", raising=False)
    path = minari_store.path_of(house) / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"data_format": "arrow"}))
    for attempt in attempts(house).values():
        with pytest.raises(OffbenchError, match=r"minari\[arrow\]") as error:
            attempt()
        assert not isinstance(error.value, DamagedError)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EIO, "check the disk"),
        (errno.ESTALE, "check the disk"),
        (errno.EACCES, "permissions"),
        (errno.EMFILE, "ulimit -n"),
        (errno.EAGAIN, "HDF5_USE_FILE_LOCKING"),
        (errno.ENOLCK, "HDF5_USE_FILE_LOCKING"),
        (errno.ENOMEM, "close other programs"),
    ],
)
def test_the_operating_systems_refusals_are_no_damage(number: int, remedy: str) -> None:
    """As Python raises them, and as libhdf5 does, which has the number in its text alone."""
    inside = f"Can't synchronously read data (file read failed: errno = {number}, error message = '...')"
    for error in (OSError(number, os.strerror(number)), OSError(inside)):
        with (
            pytest.raises(OffbenchError, match=f"cannot read a.hdf5: .*{remedy}") as raised,
            read_errors("a.hdf5", "is damaged", "x"),
        ):
            raise error
        assert not isinstance(raised.value, DamagedError)
    for error in (OSError("truncated file: eof = 5, stored_eof = 9"), ValueError("odd"), KeyError("rewards")):
        with (
            pytest.raises(DamagedError, match=r"a.hdf5 is damaged \(.*\); x"),
            read_errors("a.hdf5", "is damaged", "x"),
        ):
            raise error


def test_a_failing_disk_does_not_send_a_run_back_to_an_older_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for step in (10, 20):
        checkpoints.save_checkpoint(tmp_path, step, {"w": torch.full((2,), float(step))}, {"step": step})

    def fail(path: Path) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(checkpoints, "open_regular", fail)
    with pytest.raises(OffbenchError, match=r"cannot read .*checkpoint-000000020.*check the disk"):
        checkpoints.load_newest(tmp_path)
    monkeypatch.undo()
    os.truncate(tmp_path / "checkpoint-000000020.safetensors", 30)
    found = checkpoints.load_newest(tmp_path)
    assert found is not None
    assert found[1]["step"] == 10
    assert "is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"minari_version": "99.0.0"}, "install another version of minari"),
        ({"data_format": None}, "is damaged"),
        ({"total_steps": None}, r"is damaged \(there is no 'total_steps'\)"),
        ({"total_episodes": 9}, "is damaged"),
    ],
    ids=str,
)
def test_metadata_of_another_kind_are_one_line(house: str, changes: dict[str, Any], cause: str) -> None:
    path = minari_store.path_of(house) / "data" / "metadata.json"
    metadata = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in metadata.items() if value is not None}))
    for name, attempt in attempts(house).items():
        if name == "verify" and "damaged" in cause:
            assert {finding.code for finding in attempt().findings} == {"unreadable"}
            continue
        with pytest.raises(OffbenchError, match=cause) as error:
            attempt()
        assert isinstance(error.value, DamagedError) == ("damaged" in cause)


def test_metadata_that_are_no_json_are_not_to_be_deleted(house: str) -> None:
    (minari_store.path_of(house) / "data" / "metadata.json").write_text("{")
    for name in ("load", "show", "export"):
        with pytest.raises(DamagedError, match=r"not JSON .*; record or download the dataset again"):
            attempts(house)[name]()


@pytest.mark.parametrize("content", ["", "[]", "null", "3"])
def test_json_that_is_no_object_is_damage_with_a_remedy_that_works(content: str, house: str, home: Path) -> None:
    small: dict[str, Any] = {"steps": 4, "eval_every": 2, "hidden": (8,), "batch_size": 4}
    (folder,) = offbench.train("bc", house, **small)
    (folder / "config.json").write_text(content)
    for attempt in (Run(folder).config, lambda: offbench.train("bc", house, **small)):
        with pytest.raises(DamagedError, match=r"config\.json is damaged .*; delete the run to repeat it"):
            attempt()
    shutil.rmtree(folder)
    assert offbench.train("bc", house, **small) == [folder]


def test_a_behaviour_folder_with_other_json_is_named(tiny: tuple[str, str], home: Path) -> None:
    folder = home / "behaviour" / "tiny" / "seed-0"
    folder.mkdir(parents=True)
    (folder / "training.json").write_text("[]")
    with pytest.raises(DamagedError, match=r"training\.json is damaged .*; delete .*seed-0 to train the agent again"):
        offbench.behaviour(tiny[0], workers=1)


@pytest.mark.parametrize("content", [b"", b"[]", b"PK\x03\x04", None, "a FIFO"])
def test_a_damaged_segment_of_a_behaviour_agents_training_is_named(
    content: bytes | str | None, tiny: tuple[str, str], home: Path
) -> None:
    folder = shutil.copytree(Path(tiny[1]) / "tiny" / "seed-0", home / "behaviour" / "tiny" / "seed-0")
    shutil.rmtree(folder / "ladder")
    path = folder / "transitions" / "000000400.npz"
    path.unlink()
    if content == "a FIFO":
        os.mkfifo(path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    with pytest.raises(
        OffbenchError, match=r"000000400\.npz is (damaged|missing).*; delete .*seed-0 to train the agent"
    ):
        offbench.behaviour(tiny[0], workers=1)


def test_an_id_in_the_metadata_that_is_none_stops_no_export(house: str) -> None:
    path = minari_store.path_of(house) / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"dataset_id": "house"}))
    assert export(house, "out.npz").exists()
    assert {finding.code for finding in verify(house, workers=1).findings} == {"metadata"}
