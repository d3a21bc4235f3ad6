"""Files of others: what they name is not followed or imported, and damage to what was derived from them is mended."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

import offbench
from offbench import transitions
from offbench.policy import uniform

REWARDS = "episode_0/rewards"


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
    medium: str, home: Path, lead_away: Callable[[h5py.File, Path], None]
) -> None:
    path = home / "minari" / medium / "data" / "main_data.hdf5"
    with h5py.File(path) as file:
        rewards = file[REWARDS][:]
    with h5py.File(home / "secret", "w") as file:
        file["secret"] = rewards  # the right numbers: only where they lie is wrong
    with h5py.File(path, "a") as file:
        lead_away(file, home / "secret")
    for read in (transitions.load, transitions.open_minari, lambda name: offbench.export(name, "out.npz")):
        with pytest.raises(offbench.OffbenchError, match=r"episode_0/rewards is not data of .*main_data\.hdf5"):
            read(medium)


def test_data_other_than_the_recorded_hash_are_refused(medium: str, home: Path) -> None:
    with h5py.File(home / "minari" / medium / "data" / "main_data.hdf5", "a") as file:
        file[REWARDS][0] += 1
    for _ in range(2):  # the second time they are converted already
        with pytest.raises(offbench.OffbenchError, match="content_sha256"):
            transitions.load(medium)


@pytest.mark.parametrize(
    ("name", "size"), [("rewards.npy", 500), ("masks.npy", 0), ("ends.npy", 20), ("rows.npy", None), ("meta.json", 5)]
)
def test_a_damaged_cache_is_converted_again(medium: str, home: Path, name: str, size: int | None) -> None:
    right = transitions.load(medium)
    wanted = {array: np.array(getattr(right, array)) for array in transitions.ARRAYS}
    (meta,) = (home / "cache").glob("*/meta.json")
    path = meta.parent / name
    if size is None:
        path.unlink()
    else:
        os.truncate(path, size)
    found = transitions.load(medium)
    assert found.content == right.content
    for array, values in wanted.items():
        np.testing.assert_array_equal(getattr(found, array), values)


def test_reading_a_converted_dataset_takes_no_lock(medium: str, home: Path) -> None:
    """Root may write anywhere, so the right to write is taken away by a lock that cannot be a file."""
    transitions.load(medium)
    (lock,) = (home / "cache").glob("*.lock")
    lock.unlink()
    lock.mkdir()
    assert len(transitions.load(medium)) > 0


def test_a_module_that_a_policy_names_is_not_imported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "evil.py").write_text("open('PWNED', 'w')")
    monkeypatch.syspath_prepend(str(home))
    low, high = np.array([-3.0], np.float32), np.array([3.0], np.float32)
    policy = uniform(low, high, 4, "evil:Evil-v0")
    policy.save(home / "evil.safetensors")
    with pytest.raises(offbench.OffbenchError, match=r"'evil:Evil-v0'.*--env"):
        offbench.evaluate("evil.safetensors", episodes=1)
    dataclasses.replace(policy, env_id="evil:InvertedPendulum-v5").save(home / "known.safetensors")
    offbench.evaluate("known.safetensors", episodes=1)  # registered, so that no module is needed
    assert "evil" not in sys.modules
    assert not (home / "PWNED").exists()
