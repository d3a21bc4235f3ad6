"""The cache of converted datasets: damage in it is noticed, and it is made again."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

import offbench
from offbench.common import files
from offbench.data import file_stamps, transitions

REWARDS = "episode_0/rewards"


@pytest.mark.parametrize(
    ("name", "size"), [("rewards.npy", 500), ("masks.npy", 0), ("ends.npy", 20), ("rows.npy", None), ("meta.json", 5)]
)
def test_a_damaged_cache_is_converted_again(recorded: str, home: Path, name: str, size: int | None) -> None:
    right = transitions.load(recorded)
    wanted = {array: np.array(getattr(right, array)) for array in transitions.ARRAYS}
    (meta,) = (home / "cache").glob("*/meta.json")
    path = meta.parent / name
    if size is None:
        path.unlink()
    else:
        os.truncate(path, size)
    found = transitions.load(recorded)
    assert found.content_sha256 == right.content_sha256
    for array, values in wanted.items():
        np.testing.assert_array_equal(getattr(found, array), values)


def other_actions(home: Path) -> None:
    """Change the cache's numbers, not its sizes."""
    (path,) = (home / "cache").glob("*/actions.npy")
    actions = np.load(path)
    actions[:] = 1
    np.save(path, actions)


@pytest.mark.parametrize("reset_times", [False, True])
def test_a_changed_number_in_the_cache_is_not_believed(recorded: str, home: Path, reset_times: bool) -> None:
    right = np.array(transitions.load(recorded).actions)
    (path,) = (home / "cache").glob("*/actions.npy")
    before = path.stat()
    other_actions(home)
    if reset_times:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    np.testing.assert_array_equal(transitions.load(recorded).actions, right)


def test_a_copied_cache_is_hashed_once_and_believed(
    recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container's image: the same bytes, other times and inodes."""
    transitions.load(recorded)
    (home / "cache").rename(home / "old")
    shutil.copytree(home / "old", home / "cache")
    hashed: list[Path] = []
    monkeypatch.setattr(file_stamps, "sha256_of", lambda path: hashed.append(path) or files.sha256_of(path))
    monkeypatch.setattr(transitions, "_convert", None)
    transitions.load(recorded)
    assert len(hashed) == len(transitions.ARRAYS)
    transitions.load(recorded)
    assert len(hashed) == len(transitions.ARRAYS)


def test_other_content_of_equal_size_and_time_is_converted(recorded: str, home: Path) -> None:
    """The recorded hash is taken out, as in datasets of others: the files alone tell."""
    folder = home / "minari" / recorded / "data"
    metadata = json.loads((folder / "metadata.json").read_text())
    del metadata["offbench"]
    (folder / "metadata.json").write_text(json.dumps(metadata))
    rewards = np.array(transitions.load(recorded).rewards)
    path = folder / "main_data.hdf5"
    before = path.stat()
    with h5py.File(path, "a") as file:
        file[REWARDS][0] += 1
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert transitions.load(recorded).rewards[0] == rewards[0] + 1


def test_reading_a_converted_dataset_takes_no_lock(recorded: str, home: Path) -> None:
    """Root may write anywhere, so the right to write is taken away by a lock that cannot be a file."""
    transitions.load(recorded)
    (lock,) = (home / "cache").glob("*.lock")
    lock.unlink()
    lock.mkdir()
    assert len(transitions.load(recorded)) > 0


def test_what_lies_in_the_cache_is_replaced(medium: str, home: Path) -> None:
    content = offbench.load(medium).content_sha256
    (folder,) = (path for path in transitions.cache().iterdir() if path.is_dir())
    shutil.rmtree(folder)
    (home / "precious").write_text("mine")
    folder.symlink_to(home / "precious")
    folder.with_name(f".{folder.name}.tmp").symlink_to(home / "precious")
    (transitions.cache() / "x").mkdir()
    (transitions.cache() / "x" / "meta.json").write_text("[" * 100_000)
    assert offbench.load(medium).content_sha256 == content
    assert folder.is_dir()
    assert not folder.is_symlink()
    assert (home / "precious").read_text() == "mine"
