"""Writes episodes as a Minari dataset: to a temporary folder, renamed once it is complete."""

from __future__ import annotations

import contextlib
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, check_ownership, write_bytes, write_errors
from offbench.common.hdf5_file import SafeFile, safe_file
from offbench.data.content_hash import ContentHash
from offbench.data.minari_store import KEY, hidden_path, recover, root
from offbench.envs.environments import Space, parse_spec
from offbench.rollouts.rollouts import Episode

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

BYTES_PER_EPISODE = 14_000  # what HDF5 needs in addition to the numbers, measured on short episodes


def write(
    path: Path,
    episodes: Iterable[Episode],
    env_spec: str | None,
    metadata: JsonObject,
    steps: int,
    spaces: tuple[Space, Space],
    expected: str | None = None,
) -> str:
    """Write episodes as a Minari HDF5 dataset at `path`, whole or not at all; return the content hash.

    Args:
        path: the folder of a claimed id; an existing dataset is replaced at the end.
        env_spec: the environment's EnvSpec as JSON, None if unknown.
        metadata: Minari's fields; the content hash joins those under the key `offbench`.
        steps: the expected number of transitions, to check the free disk space.
        spaces: the spaces of observations and actions; without them, Minari would make the environment, which may no
            longer exist.
        expected: the content hash that the data must have (None: any).
    """
    spec = parse_spec(env_spec) if env_spec else None
    temporary = hidden_path(path, "partial")
    check_ownership(temporary)
    with write_errors(str(path)):
        (temporary / "data").mkdir(parents=True)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                storage = MinariStorage.new(temporary / "data", *spaces, spec, "hdf5")
            _check_room(temporary, storage, steps)
            content, dtype = ContentHash(), storage.observation_space.dtype
            with safe_file(storage._file_path) as storage._file_path:  # a full disk must not crash libhdf5
                storage.update_episodes(_buffers(episodes, dtype, content, storage._file_path, temporary))
            check_ownership(temporary)
            if not storage.total_steps:
                raise OffbenchError("there are no transitions to write")
            if expected not in (None, content.hexdigest()):
                raise OffbenchError(
                    "the data are not those that were exported (their hash differs); export them again"
                )
            provenance = metadata[KEY] | {"content_sha256": content.hexdigest()}
            storage.update_metadata(metadata | {KEY: provenance})
            with open(temporary / "data" / "metadata.json", "r+b") as file:
                os.fsync(file.fileno())
            _write_namespaces(path)
            check_ownership(temporary)
            if path.exists():
                path.replace(hidden_path(path, "old"))
            temporary.replace(path)
        except Exception as error:  # Minari raises a ValueError for a missing folder, for example
            if temporary.exists():
                raise
            raise OffbenchError(
                f"{temporary} was moved or deleted while it was written; run the command again"
            ) from error
        finally:
            with contextlib.suppress(OffbenchError):  # the folder is no longer this process's, or the disk refuses
                check_ownership(temporary)
                recover(path)
    return content.hexdigest()


def _write_namespaces(path: Path) -> None:
    """Write the metadata of a dataset's namespaces where there are none, which `minari upload` needs."""
    for parent in path.relative_to(root()).parents[:-1]:
        file = root() / parent / "namespace_metadata.json"
        if not file.exists():
            write_bytes(file, b"{}")


def _buffers(
    episodes: Iterable[Episode], dtype: npt.DTypeLike, content: ContentHash, file: SafeFile, folder: Path
) -> Iterator[EpisodeBuffer]:
    for episode in episodes:
        file.check()
        check_ownership(folder)
        observations = episode.observations.astype(dtype, copy=False)
        flags = np.zeros((2, len(episode)), bool)
        flags[:, -1] = episode.terminated, episode.truncated
        content.add(observations, episode.actions, episode.rewards, *flags)
        yield EpisodeBuffer(
            id=None,
            seed=episode.seed if episode.seed >= 0 else None,
            observations=observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=flags[0],
            truncations=flags[1],
            infos=None,
        )


def _check_room(folder: Path, storage: MinariStorage, steps: int) -> None:
    """Raise OffbenchError if the disk has no room for the dataset (episodes of 100 steps assumed)."""
    width = storage.observation_space.shape[0] * storage.observation_space.dtype.itemsize
    width += storage.action_space.shape[0] * storage.action_space.dtype.itemsize + 10
    need = steps * width + steps // 100 * BYTES_PER_EPISODE
    free = shutil.disk_usage(folder).free
    if free < need:
        raise OffbenchError(
            f"not enough room in {root()}: {need / 1e6:.0f} MB needed, {free / 1e6:.0f} MB free; "
            "free some, set MINARI_DATASETS_PATH to another disk, or record fewer --steps"
        )
