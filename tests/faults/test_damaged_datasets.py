"""Datasets and D4RL files of others: damage is noticed, and what they name is neither followed nor run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data import minari_store, transitions
from offbench.data.minari_reader import open_minari
from offbench.envs.environments import box

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


def changed(dataset_id: str, column: str, value: float) -> None:
    (path,) = (minari_store.path_of(dataset_id) / "data").glob("*.hdf5")
    with h5py.File(path, "a") as file:
        file[f"episode_0/{column}"][0] = value


@pytest.mark.parametrize(("column", "value"), [("terminations", True), ("truncations", True), ("rewards", 9.0)])
def test_data_that_are_not_those_of_the_recorded_hash_are_neither_loaded_nor_exported(
    column: str, value: float, medium: str, home: Path
) -> None:
    changed(medium, column, value)
    with pytest.raises(OffbenchError, match="its arrays are not those of the content_sha256 in its metadata"):
        offbench.load(medium)
    for name in ("out.npz", "out.hdf5"):
        with pytest.raises(OffbenchError, match="its arrays are not those of the content_sha256 in its metadata"):
            offbench.export(medium, home / name)
    assert not list(home.glob("*out*"))


@pytest.mark.parametrize("key", ["env_spec", "eval_env_spec"])
@pytest.mark.parametrize("entry_point", ["os:mkdir", "canary:Env"])
def test_a_d4rl_file_runs_nothing_that_it_names(
    key: str, entry_point: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without timeouts and next observations, the environment is made to compare the rows with its resets."""
    (home / "canary.py").write_text("open('imported', 'w').close()")
    monkeypatch.syspath_prepend(home)
    spec: dict[str, Any] = {
        "id": "A-v0",
        "entry_point": entry_point,
        "kwargs": {"path": "made"} if entry_point.startswith("os") else {},
        "additional_wrappers": [],
        "max_episode_steps": 100,
        **dict.fromkeys(("reward_threshold", "vector_entry_point")),
        **dict.fromkeys(("nondeterministic", "order_enforce", "disable_env_checker"), False),
    }
    with h5py.File("evil.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((200, 4)), np.zeros((200, 1), np.float32)
        file["rewards"], file["terminals"] = np.ones(200, np.float32), np.arange(200) % 20 == 19
        sound = {"env_spec": json.dumps(spec | {"entry_point": "gymnasium.envs.mujoco.hopper_v5:HopperEnv"})}
        file.attrs["offbench"] = json.dumps(sound | {key: json.dumps(spec)})
    if key == "env_spec":
        offbench.import_d4rl("evil.hdf5", "evil-v0")  # it is kept as text
    else:
        with pytest.raises(OffbenchError, match=r"evil\.hdf5: .*--trust"):
            offbench.import_d4rl("evil.hdf5", "evil-v0")
    assert not Path("made").exists()
    assert not Path("imported").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"ref_min_score": 1e300},
        {"ref_max_score": True},
        {"description": "\ud800"},
        {"offbench": {"level": 5}},
        {"offbench": {"seed": "x"}},
        {"offbench": {"parts": 5}},
    ],
)
def test_damaged_metadata_of_a_d4rl_file_replace_no_dataset(change: dict[str, Any], medium: str) -> None:
    offbench.export(medium, "in.hdf5")
    with h5py.File("in.hdf5", "a") as file:
        about = json.loads(file.attrs["offbench"])
        about |= {key: about[key] | value if isinstance(value, dict) else value for key, value in change.items()}
        file.attrs["offbench"] = json.dumps(about)
    before = minari_store.read_metadata(medium)
    with pytest.raises(OffbenchError, match=r"in\.hdf5.*damaged"):
        offbench.import_d4rl("in.hdf5", medium, overwrite=True)
    assert minari_store.read_metadata(medium) == before


def test_odd_metadata_of_a_dataset_are_no_bug(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = minari_store.path_of(medium) / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["dataset_id"] = "\x1b[31mother"
    metadata["requirements"] = [f"mujoco>={'9' * 5000}"]
    nested: Any = "uniform"
    for _ in range(600):
        nested = [nested]
    metadata["offbench"]["parts"][0]["source"] = nested
    path.write_text(json.dumps(metadata))
    main(["show", medium])
    with pytest.raises(SystemExit) as stopped:
        main(["verify", medium])
    assert stopped.value.code == 1
    said = capsys.readouterr()
    assert "bug" not in said.err
    assert "\x1b" not in said.err + said.out
    assert f"verifying {medium}" in said.err


def test_a_huge_space_is_refused_at_once() -> None:
    with pytest.raises(OffbenchError, match="must be a"):
        box(gym.spaces.Discrete(10**12), "observations")
