"""A dataset's episodes through Minari, nothing believed yet."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.data import minari_store


@dataclass(frozen=True)
class Recorded:
    """An episode as a dataset has it, nothing believed yet. Arrays as in Minari's EpisodeData."""

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


def episodes_of(data: Any, indices: Iterable[int] | None = None) -> Iterator[Recorded]:
    """Yield a MinariDataset's episodes (all, or those of `indices`) with their seeds.

    Whatever Minari raises about damaged files goes through.
    """
    wanted = [int(i) for i in (data.episode_indices if indices is None else indices)]
    known = data.storage.get_episode_metadata(wanted)
    for episode, about in zip(data.iterate_episodes(wanted), known, strict=True):
        # an episode that was reset with options cannot be reset from its seed alone
        seed = None if about.get("options") else about.get("seed")
        arrays = (episode.observations, episode.actions, episode.rewards, episode.terminations, episode.truncations)
        yield Recorded(int(episode.id), None if seed is None else int(seed), *map(np.asarray, arrays))


def open_minari(dataset_id: str) -> Any:
    """Return the MinariDataset of a local id, to read its episodes.

    Raises:
        OffbenchError: there is none, it is damaged, or its files lead to others.
    """
    check_storage(dataset_id)
    return open_parsed(dataset_id)


def check_storage(dataset_id: str) -> None:
    """Refuse HDF5 files whose arrays lie elsewhere: HDF5 would follow them to any file of this machine."""
    for path in sorted((minari_store.path_of(dataset_id) / "data").rglob("*.hdf5")):
        try:
            with h5py.File(path) as file:
                elsewhere = _elsewhere(file)
        except (OSError, KeyError, ValueError, RuntimeError) as error:
            raise OffbenchError(f"{dataset_id} cannot be read: {error}; record or download it again") from error
        if elsewhere:
            raise OffbenchError(f"{dataset_id} is not read: {elsewhere} is not data of {path}; get it from its source")


def _elsewhere(file: h5py.File) -> str | None:
    """Return the name of something below the root that is a link, or stored in another file."""
    groups, seen = [file["/"]], set()
    while groups:
        group = groups.pop()
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                return f"{group.name}/{name}".replace("//", "/")
            found = group[name]
            if isinstance(found, h5py.Dataset) and (found.external or found.is_virtual):
                return str(found.name)
            if isinstance(found, h5py.Group) and found.id not in seen:  # hard links can make a circle
                seen.add(found.id)
                groups.append(found)
    return None


def open_parsed(dataset_id: str) -> Any:
    """Return the MinariDataset of a local id whose storage has not been checked yet; see `open_minari`."""
    metadata = minari_store.read_metadata(dataset_id)
    if "observation_space" not in metadata or "action_space" not in metadata:
        # Minari would make the environment to ask it, running whatever code the file names
        raise OffbenchError(f"{dataset_id} cannot be read: its metadata lack a space; record or download it again")
    size = sum(
        path.stat().st_size for path in (minari_store.root() / dataset_id / "data").rglob("*") if path.is_file()
    )
    if not 0 <= (metadata.get("total_episodes") or 0) <= size:
        raise OffbenchError(
            f"{dataset_id} cannot be read: its files are too small for its episodes; download it again"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari

        try:
            return minari.MinariDataset(minari_store.root() / dataset_id / "data")
        except Exception as error:  # Minari, h5py and JSON each raise their own kinds for damaged files
            raise OffbenchError(f"{dataset_id} cannot be read: {error}; record or download it again") from error
