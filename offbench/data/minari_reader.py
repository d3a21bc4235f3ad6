"""Local datasets as Minari reads them, opened after a check of their files, and checks of their arrays."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from gymnasium.spaces import Box

from offbench.common.arrays import Array
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import open_regular, read_errors
from offbench.common.hdf5_file import stored_elsewhere
from offbench.data import minari_store

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset

RECORD_AGAIN = "record or download it again"
MAX_FLOAT32 = float(np.finfo(np.float32).max)


@contextlib.contextmanager
def reading(dataset_id: str) -> Iterator[None]:
    """Read a dataset within this context.

    Raises:
        DamagedError: its content is invalid.
        OffbenchError: its files are locked, may not be read, or need a package that is not installed.
    """
    try:
        with read_errors(dataset_id, "is damaged", RECORD_AGAIN):
            yield
    except FileNotFoundError as error:
        raise DamagedError(
            f"{dataset_id} is damaged (there is no {error.filename or error}); {RECORD_AGAIN}"
        ) from error


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode as a dataset has it, unchecked. Arrays as in Minari's EpisodeData."""

    index: int
    seed: int | None
    observations: Array
    actions: Array
    rewards: Array
    terminations: Array
    truncations: Array

    def __len__(self) -> int:
        return len(self.rewards) if self.rewards.ndim else 0

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Observations, actions, rewards, terminations, truncations."""
        return self.observations, self.actions, self.rewards, self.terminations, self.truncations


def episodes_of(data: MinariDataset, indices: Iterable[int] | None = None) -> Iterator[RecordedEpisode]:
    """Yield a MinariDataset's episodes (all, or those of `indices`) with their seeds.

    Raises:
        DamagedError, OffbenchError: as in `reading`.
    """
    wanted = [int(i) for i in (data.episode_indices if indices is None else indices)]
    with reading(str(data.storage.metadata.get("dataset_id"))):
        metadata = data.storage.get_episode_metadata(wanted)
        for episode, about in zip(data.iterate_episodes(wanted), metadata, strict=True):
            # an episode that was reset with options cannot be reset from its seed alone
            seed = None if about.get("options") else about.get("seed")
            flags = episode.terminations, episode.truncations
            arrays = map(np.asarray, (episode.observations, episode.actions, episode.rewards, *flags))
            yield RecordedEpisode(int(episode.id), None if seed is None else int(seed), *arrays)


def shape_faults(episode: RecordedEpisode | EpisodeData, observations: Box, actions: Box) -> Iterator[str]:
    """Yield what is wrong with the shapes of an episode: T + 1 observations, T of all else, T at least 1."""
    steps = len(episode.rewards) if np.ndim(episode.rewards) else 0
    shapes = {"observations": (steps + 1, *observations.shape), "actions": (steps, *actions.shape)}
    for name, shape in (shapes | dict.fromkeys(("rewards", "terminations", "truncations"), (steps,))).items():
        actual = np.shape(getattr(episode, name))
        if actual != shape or not steps:
            yield f"{name} have shape {actual}, expected {shape}"


def open_minari(dataset_id: str) -> MinariDataset:
    """Return the MinariDataset of a local id, to read its episodes.

    Raises:
        OffbenchError: there is none, it is damaged, or its files lead to others.
    """
    check_storage(dataset_id)
    return open_unchecked(dataset_id)


def check_storage(dataset_id: str) -> None:
    """Refuse HDF5 files whose arrays lie elsewhere: HDF5 would follow them to any file of this machine."""
    for path in _files(dataset_id):
        if path.suffix != ".hdf5":
            continue
        with reading(dataset_id), h5py.File(path) as file:
            elsewhere = stored_elsewhere(file)
        if elsewhere:
            raise DamagedError(f"{dataset_id} is not read: {elsewhere} is not data of {path}; get it from its source")


def _files(dataset_id: str) -> list[Path]:
    """Return the files of a dataset. Raises DamagedError if one is not a regular file: it could block."""
    paths = sorted((minari_store.path_of(dataset_id) / "data").rglob("*"))
    files = [path for path in paths if not path.is_dir() or path.suffix == ".hdf5"]
    with reading(dataset_id):
        for path in files:
            os.close(open_regular(path))
    return files


def open_unchecked(dataset_id: str) -> MinariDataset:
    """Return the MinariDataset of a local id whose storage has not been checked yet; see `open_minari`."""
    metadata = minari_store.read_metadata(dataset_id)
    if "observation_space" not in metadata or "action_space" not in metadata:
        # Minari would make the environment to ask it, running whatever code the file names
        raise DamagedError(f"{dataset_id} is damaged (its metadata lack a space); {RECORD_AGAIN}")
    size = sum(path.stat().st_size for path in _files(dataset_id))
    if not 0 <= (metadata.get("total_episodes") or 0) <= size:
        raise DamagedError(f"{dataset_id} is damaged (its files are too small for its episodes); {RECORD_AGAIN}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari

        with reading(dataset_id):
            try:
                data = minari.MinariDataset(minari_store.root() / dataset_id / "data")
            except ValueError as error:
                if "Minari version" not in str(error):
                    raise
                message = " ".join(str(error).split())
                raise OffbenchError(
                    f"cannot read {dataset_id}: {message}; install another version of minari"
                ) from error
            int(data.total_steps)  # Minari reads it from the metadata when it is asked for
            return data


def finite(array: Array, what: str) -> Array:
    """Return finite real numbers as they are. Raises OffbenchError if they are anything else."""
    if array.dtype.kind not in "fiub":
        raise OffbenchError(f"{what} are {array.dtype}, not numbers; the dataset is damaged")
    if not np.isfinite(array).all():
        raise OffbenchError(f"{what} contain NaN or infinite numbers; filter them out of the dataset")
    return array


def float32(array: Array, what: str) -> Array:
    """Return finite numbers as float32. Raises OffbenchError if they are anything else, or too large for float32."""
    largest = float(np.abs(finite(array, what)).max(initial=0))
    if largest > MAX_FLOAT32:
        raise OffbenchError(
            f"{what} reach {largest:.3g}, beyond float32's {MAX_FLOAT32:.2g}; scale them in the dataset"
        )
    return np.asarray(array, np.float32)


def flags(array: Array, what: str) -> Array:
    """Return zeros and ones as booleans. Raises OffbenchError if there is any other value."""
    if not np.isin(finite(array, what), (0, 1)).all():
        raise OffbenchError(f"{what} contain values other than 0 and 1; the dataset is damaged")
    return array.astype(bool)
