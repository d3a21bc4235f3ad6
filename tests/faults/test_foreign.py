"""Files of others: what they name is not followed or imported, and damage to what was derived from them is mended."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.common import files
from offbench.data import file_stamps, minari_store, minari_writer, transitions
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.rollouts.policy import uniform_policy
from tests.commands import refusal

REWARDS = "episode_0/rewards"


@pytest.fixture
def recorded(home: Path) -> str:
    """The id of a small dataset."""
    return offbench.collect("inverted-pendulum", "random", steps=300, workers=1)


def external_link(file: h5py.File, secret: Path) -> None:
    """Put a link to another file in the place of the rewards."""
    del file[REWARDS]
    file[REWARDS] = h5py.ExternalLink(str(secret), "/secret")


def soft_link(file: h5py.File, secret: Path) -> None:
    """Put a link to other data of the same file in the place of the rewards."""
    del file[REWARDS]
    file[REWARDS] = h5py.SoftLink("/episode_1/rewards")


def external_storage(file: h5py.File, secret: Path) -> None:
    """Let the rewards lie in the raw bytes of another file."""
    shape, dtype = file[REWARDS].shape, file[REWARDS].dtype
    del file[REWARDS]
    file.create_dataset(REWARDS, shape, dtype, external=[(str(secret), 0, secret.stat().st_size)])


def virtual(file: h5py.File, secret: Path) -> None:
    """Map the rewards from another file."""
    shape, dtype = file[REWARDS].shape, file[REWARDS].dtype
    layout = h5py.VirtualLayout(shape, dtype)
    layout[:] = h5py.VirtualSource(str(secret), "secret", shape)
    del file[REWARDS]
    file.create_virtual_dataset(REWARDS, layout)


@pytest.mark.parametrize("lead_away", [external_link, soft_link, external_storage, virtual])
def test_data_in_another_file_are_not_read(
    recorded: str, home: Path, lead_away: Callable[[h5py.File, Path], None]
) -> None:
    path = home / "minari" / recorded / "data" / "main_data.hdf5"
    with h5py.File(path) as file:
        rewards = file[REWARDS][:]
    with h5py.File(home / "secret", "w") as file:
        file["secret"] = rewards  # the right numbers: only where they lie is wrong
    with h5py.File(path, "a") as file:
        lead_away(file, home / "secret")
    for read in (transitions.load, open_minari, lambda name: offbench.export(name, "out.npz")):
        with pytest.raises(offbench.OffbenchError, match=r"episode_0/rewards is not data of .*main_data\.hdf5"):
            read(recorded)


@pytest.mark.parametrize("place", ["a FIFO", "a broken link", "a folder"])
def test_what_is_no_file_is_neither_waited_for_nor_read(recorded: str, home: Path, place: str) -> None:
    path = home / "minari" / recorded / "data" / "main_data.hdf5"
    path.unlink()
    if place == "a FIFO":
        os.mkfifo(path)
    elif place == "a folder":
        path.mkdir()
    else:
        path.symlink_to("/nowhere")
    for read in (transitions.load, open_minari, lambda name: offbench.export(name, "out.npz")):
        with pytest.raises(
            offbench.OffbenchError, match=r"is damaged .*main_data\.hdf5.*; record or download it again"
        ):
            read(recorded)


def test_data_other_than_the_recorded_hash_are_refused(recorded: str, home: Path) -> None:
    with h5py.File(home / "minari" / recorded / "data" / "main_data.hdf5", "a") as file:
        file[REWARDS][0] += 1
    for _ in range(2):  # the second time they are converted already
        with pytest.raises(offbench.OffbenchError, match="content_sha256"):
            transitions.load(recorded)


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


@pytest.mark.parametrize("times", [1, 9])
def test_a_dataset_replaced_while_it_is_loaded(
    times: int, recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between its metadata and its arrays: the new one is read, or, if that goes on and on, none."""
    key, left = transitions._key, itertools.count()

    def replaced(*arguments: Any) -> str:
        if next(left) < times:
            shutil.rmtree(home / "minari" / recorded)
            offbench.collect("inverted-pendulum", "random", steps=300 + next(left), dataset_id=recorded, workers=1)
        return key(*arguments)

    monkeypatch.setattr(transitions, "_key", replaced)
    if times > 1:
        with pytest.raises(offbench.OffbenchError, match="was replaced while it was read"):
            transitions.load(recorded)
        return
    found = transitions.load(recorded)
    monkeypatch.undo()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / "minari"))
    monkeypatch.setenv("OFFBENCH_CACHE", str(home / "fresh"))
    now = transitions.load(recorded)
    assert found.content_sha256 == now.content_sha256 == now.metadata["offbench"]["content_sha256"]
    for name in transitions.ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(now, name))


@pytest.mark.parametrize(
    ("module", "read"),
    [("data.export", lambda name: offbench.export(name, "out.npz")), ("verification.scan", offbench.verify)],
)
def test_a_dataset_replaced_while_it_is_exported_or_verified(
    module: str, read: Callable[[str], Any], recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replaced(*arguments: Any) -> Any:
        shutil.rmtree(home / "minari" / recorded)
        offbench.collect("inverted-pendulum", "random", steps=301, dataset_id=recorded, workers=1)
        return episodes_of(*arguments)

    monkeypatch.setattr(f"offbench.{module}.episodes_of", replaced)
    with pytest.raises(offbench.OffbenchError, match=f"{recorded} was replaced while it was read"):
        read(recorded)
    assert not list(home.glob("*out.npz*"))


def test_a_dataset_deleted_while_it_is_verified(recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After its arrays are read: Minari itself notices, with an error of its own."""
    monkeypatch.setattr(
        "offbench.verification.verify._check_counts", lambda *_: shutil.rmtree(home / "minari" / recorded)
    )
    with pytest.raises(offbench.OffbenchError, match="was replaced while it was read"):
        offbench.verify(recorded)


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_a_dataset_deleted_while_it_is_recorded(
    overwrite: list[str],
    recorded: str,
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--seed", "1", "--workers", "1"]
    words += overwrite or ["--id", "new-v0"]
    with monkeypatch.context() as patched:
        patched.setattr(minari_writer, "_check_room", lambda folder, *_: shutil.rmtree(folder))
        assert "was moved or deleted while it was written" in refusal(words, capsys)
    assert minari_store.local_ids() == [recorded]
    main(words)
    assert minari_store.read_provenance(minari_store.read_metadata(words[-1] if not overwrite else recorded)).seed == 1


def test_reading_a_converted_dataset_takes_no_lock(recorded: str, home: Path) -> None:
    """Root may write anywhere, so the right to write is taken away by a lock that cannot be a file."""
    transitions.load(recorded)
    (lock,) = (home / "cache").glob("*.lock")
    lock.unlink()
    lock.mkdir()
    assert len(transitions.load(recorded)) > 0


def test_a_module_that_a_policy_names_is_not_imported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "evil.py").write_text("open('PWNED', 'w')")
    monkeypatch.syspath_prepend(str(home))
    low, high = np.array([-3.0], np.float32), np.array([3.0], np.float32)
    policy = uniform_policy(low, high, 4, "evil:Evil-v0")
    policy.save(home / "evil.safetensors")
    with pytest.raises(offbench.OffbenchError, match=r"'evil:Evil-v0'.*--env"):
        offbench.evaluate("evil.safetensors", episodes=1)
    dataclasses.replace(policy, env_id="evil:InvertedPendulum-v5").save(home / "known.safetensors")
    offbench.evaluate("known.safetensors", episodes=1)  # registered, so that no module is needed
    assert "evil" not in sys.modules
    assert not (home / "PWNED").exists()
