"""Transitions: any Minari dataset with Box spaces as flat float32 arrays, converted once and then mapped.

episode 0: o o o o      observations [N + E, obs]   every episode's T + 1 rows, end to end
episode 1: o o o        rows [N]                    the row of each transition's observation
           s s s.       next observation = row + 1  so nothing is stored twice

actions [N, act] in [-1, 1]   rewards [N]   masks [N] = 1 - terminations   ends [E]: transitions up to each
episode's end   returns [E]
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from filelock import FileLock, Timeout

from offbench.common.arrays import Array
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import (
    JsonObject,
    delete,
    home_folder,
    read_errors,
    read_json,
    read_text,
    remove_leftovers,
    write_errors,
    write_json,
)
from offbench.common.progress import Progress
from offbench.common.terminal import warn
from offbench.data import minari_store
from offbench.data.content_hash import ContentHash
from offbench.data.file_stamps import ReplacedError, Stamps, check_files, hash_and_stamp, unchanged
from offbench.data.minari_reader import check_storage, flags, float32, open_unchecked, reading, shape_faults
from offbench.data.recorded_env import evaluation_spec
from offbench.envs.environments import action_box, box, same_environment

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset

ARRAYS = ("observations", "rows", "actions", "rewards", "masks", "ends", "returns")
ATTEMPTS = 3  # attempts to read a dataset that is being replaced
NUMBERS = ("observations", "actions", "rewards")
MIN_ACTION_RANGE = 1e-3  # share of the range between the action bounds that actions should use
CLIP_TOLERANCE = 1e-5  # actions out of bounds by more than rounding cause a warning


@dataclass(frozen=True, repr=False)
class Transitions:
    """A dataset as flat float32 arrays of N transitions in E episodes, memory-mapped read-only from the cache.

    Transition i leads from `observations[rows[i]]` to `observations[rows[i] + 1]` by `actions[i]`. The action that the
    environment takes is `low + (actions[i] + 1) * (high - low) / 2`.

    Attributes:
        content_sha256: SHA-256 over the arrays, the same as in an offbench dataset's metadata.
        observations: [N + E, obs], the T + 1 observations of every episode, end to end.
        rows: [N], the row of each transition's observation.
        actions: [N, act], scaled from the bounds of the action space to [-1, 1].
        rewards: [N].
        masks: [N], 0 where the episode terminated and 1 elsewhere, also at a truncation.
        ends: [E], the number of transitions up to each episode's end.
        returns: [E], the sum of each episode's rewards.
        low, high: [act], the bounds of the action space.
        evaluated_in: EnvSpec JSON of the environment that the user chose instead of the dataset's.
    """

    dataset_id: str
    content_sha256: str
    observations: Array
    rows: Array
    actions: Array
    rewards: Array
    masks: Array
    ends: Array
    returns: Array
    low: Array
    high: Array
    metadata: JsonObject
    evaluated_in: str | None = None

    def __len__(self) -> int:
        return len(self.rewards)

    def __repr__(self) -> str:
        """Return id and sizes."""
        sizes = f"{len(self):,} transitions, {len(self.ends):,} episodes"
        return f"Transitions({self.dataset_id}, {sizes}, observations {self.observations.shape[1:]})"

    @property
    def env_spec(self) -> str | None:
        """The environment to evaluate in, as EnvSpec JSON; None if the dataset does not name one."""
        return self.evaluated_in or evaluation_spec(self.metadata)

    @property
    def env_id(self) -> str:
        """The environment's id, for the policy file; empty if the dataset does not name one."""
        return str(json.loads(self.env_spec).get("id", "")) if self.env_spec else ""

    @property
    def references(self) -> tuple[float, float] | None:
        """The dataset's own reference returns (random, expert); None if it has none, or of another environment."""
        recorded = evaluation_spec(self.metadata)
        if self.evaluated_in and recorded and not same_environment(self.evaluated_in, recorded):
            return None
        return minari_store.references(self.metadata)

    def best(self, share: float) -> Array:
        """Return the indices of the transitions of the best `share` of all episodes by return, in order."""
        count = max(1, round(share * len(self.ends)))
        lengths = np.diff(self.ends, prepend=0)
        chosen = np.zeros(len(self.ends), bool)
        chosen[np.argsort(-self.returns, kind="stable")[:count]] = True
        return np.flatnonzero(np.repeat(chosen, lengths))

    def normalizer(self) -> tuple[Array, Array]:
        """Return mean and std + 1e-3 of the transitions' observations, [obs] float32, as TD3+BC's authors do."""
        count, dim = len(self), self.observations.shape[1]

        def blocks() -> Iterator[Array]:
            for first in range(0, count, 100_000):
                yield self.observations[self.rows[first : first + 100_000]].astype(np.float64)

        mean = sum((block.sum(0) for block in blocks()), np.zeros(dim)) / count
        square = sum((((block - mean) ** 2).sum(0) for block in blocks()), np.zeros(dim))
        return mean.astype(np.float32), (np.sqrt(square / count) + 1e-3).astype(np.float32)


def load(dataset_id: str) -> Transitions:
    """Return a local Minari dataset as flat arrays, with actions scaled to [-1, 1].

    Raises:
        OffbenchError: no such dataset, spaces other than flat Boxes, NaN or infinite numbers, wrong shapes,
            damaged files, data that are not those of the recorded hash.
    """
    for _ in range(ATTEMPTS - 1):
        with contextlib.suppress(ReplacedError), unchanged(dataset_id) as stamps:
            return _load(dataset_id, stamps)
    with unchanged(dataset_id) as stamps:
        return _load(dataset_id, stamps)


def _load(dataset_id: str, stamps: Stamps) -> Transitions:
    metadata = minari_store.read_metadata(dataset_id)
    expected = minari_store.read_provenance(metadata).content_sha256
    data = open_unchecked(dataset_id)
    observation_space = box(data.observation_space, f"{dataset_id}: observations")
    action_space = action_box(data.action_space, f"{dataset_id}: actions")
    folder = cache() / _key(dataset_id, expected, stamps)
    sources = {f"data/{name}": minari_store.path_of(dataset_id) / "data" / name for name in stamps}
    cached = _read_converted(folder, sources)
    if cached is None:
        with write_errors(str(folder), "set OFFBENCH_CACHE to another folder"):
            folder.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(folder.with_name(f"{folder.name}.lock")):
                cached = _read_converted(folder, sources)  # another process may have converted it meanwhile
                if cached is None:
                    with unchanged(dataset_id):
                        temporary = _convert(data, dataset_id, observation_space, action_space, folder, sources)
                    temporary.replace(folder)
                    cached = _read_converted(folder, sources)
    if cached is None:
        raise OffbenchError(f"cannot read back {folder}; delete it and try again")
    content, arrays = cached[0], dict[str, Any](cached[1])
    minari_store.check_content(dataset_id, metadata, content)
    return Transitions(dataset_id, content, **arrays, low=action_space.low, high=action_space.high, metadata=metadata)


def _read_converted(folder: Path, sources: Mapping[str, Path]) -> tuple[str, dict[str, Array]] | None:
    """Return the content hash and the arrays of a converted dataset.

    None if it is not there, is damaged, or was converted from other files than `sources` are now.

    Raises:
        OffbenchError: it cannot be read for another reason, such as its permissions.
    """
    try:
        with read_errors(str(folder), "is damaged", "it is converted again"):
            meta = json.loads(read_text(folder / "meta.json"))
            paths = {**sources, **{f"{name}.npy": folder / f"{name}.npy" for name in ARRAYS}}
            files = check_files(paths, meta["files"])
            arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in ARRAYS}
            content = str(meta["content_sha256"])
    except (FileNotFoundError, DamagedError):
        return None
    if files != meta["files"]:
        lock = FileLock(folder.with_name(f"{folder.name}.lock"))
        # on a read-only disk they are hashed each time
        with contextlib.suppress(OffbenchError, OSError, Timeout), lock.acquire(timeout=0):
            remove_leftovers(folder)
            write_json(folder / "meta.json", meta | {"files": files})
    return content, arrays


def cache() -> Path:
    """Return the folder of converted datasets: $OFFBENCH_CACHE, else offbench in $XDG_CACHE_HOME or ~/.cache."""
    path = os.environ.get("OFFBENCH_CACHE")
    if path:
        return Path(path)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else home_folder("OFFBENCH_CACHE") / ".cache") / "offbench"


def _key(dataset_id: str, content: str | None, stamps: Stamps) -> str:
    """Return the cache's name for a dataset: it changes with the content and with the files."""
    folder = minari_store.path_of(dataset_id) / "data"
    sizes_and_times = [(name, size, mtime) for name, (size, mtime, *_) in stamps.items()]
    text = json.dumps([4, dataset_id, content, str(folder), sizes_and_times])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _convert(
    data: MinariDataset,
    dataset_id: str,
    observations: gym.spaces.Box,
    actions: gym.spaces.Box,
    folder: Path,
    sources: Mapping[str, Path],
) -> Path:
    """Read every episode once and write the arrays beside `folder`, meta.json last; return where they are."""
    check_storage(dataset_id)
    columns: dict[str, list[Array]] = {name: [] for name in ("observations", "actions", "rewards", "masks")}
    content, lengths, returns = ContentHash(), [], []
    with Progress(int(data.total_steps), f"converting {dataset_id}") as progress:
        for episode in _episodes(data, dataset_id):
            flat = _episode_arrays(episode, observations, actions, f"{dataset_id}, episode {episode.id}")
            observed, acted, earned = map(np.asarray, (episode.observations, episode.actions, episode.rewards))
            content.add(observed, acted, earned, episode.terminations, episode.truncations)
            for name, array in flat.items():
                columns[name].append(array)
            lengths.append(len(flat["rewards"]))
            returns.append(float(np.sum(episode.rewards, dtype=np.float64)))
            progress.to(progress.done + lengths[-1])
    if not lengths:
        raise OffbenchError(f"{dataset_id} has no episodes; record it again")
    arrays = {name: np.concatenate(columns.pop(name)) for name in tuple(columns)}  # frees each column's parts
    arrays["actions"] = _scaled(arrays["actions"], actions, dataset_id)
    ends = np.cumsum(lengths)
    # each earlier episode put one extra observation row (its last) before this transition
    arrays["rows"] = np.arange(ends[-1]) + np.repeat(np.arange(len(lengths)), lengths)
    arrays |= {"ends": ends, "returns": np.array(returns)}
    temporary = folder.with_name(f".{folder.name}.tmp")
    source = str(minari_store.path_of(dataset_id))
    _delete_earlier_conversions(source)
    _remove_leftovers(folder)
    temporary.mkdir()
    try:
        files = {name: hash_and_stamp(path) for name, path in sources.items()}
        for name in ARRAYS:
            with open(temporary / f"{name}.npy", "wb") as file:
                np.save(file, arrays[name], allow_pickle=False)
                file.flush()
                os.fsync(file.fileno())
            files[f"{name}.npy"] = hash_and_stamp(temporary / f"{name}.npy")
        meta = {"source": source, "content_sha256": content.hexdigest(), "files": files}
        write_json(temporary / "meta.json", meta)
        delete(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return temporary


def _delete_earlier_conversions(source: str) -> None:
    """Delete what was converted from an earlier content of the same dataset."""
    for meta in cache().glob("*/meta.json"):
        with contextlib.suppress(OffbenchError):  # another dataset's, which is damaged
            if read_json(meta).get("source") == source:
                # removed by `_remove_leftovers` after a kill
                temporary = meta.parent.with_name(f".{meta.parent.name}.old")
                with contextlib.suppress(OSError):
                    meta.parent.replace(temporary)
                    shutil.rmtree(temporary)


def _remove_leftovers(folder: Path) -> None:
    """Delete what killed processes left of their conversions: `folder`'s, whose lock is held, and those unlocked."""
    for temporary in folder.parent.glob(".*"):
        key = temporary.name[1:].partition(".")[0]
        if key == folder.name:
            delete(temporary)
        elif len(key) == len(folder.name) and temporary.is_dir():
            with contextlib.suppress(Timeout, OSError), FileLock(temporary.with_name(f"{key}.lock"), timeout=0):
                shutil.rmtree(temporary, ignore_errors=True)


def _episodes(data: MinariDataset, dataset_id: str) -> Iterator[EpisodeData]:
    with reading(dataset_id):
        yield from data.iterate_episodes()


def _episode_arrays(
    episode: EpisodeData, observations: gym.spaces.Box, actions: gym.spaces.Box, where: str
) -> dict[str, Array]:
    """Return one episode's arrays as float32, checked: shapes and finite numbers."""
    for fault in shape_faults(episode, observations, actions):
        raise OffbenchError(f"{where}: {fault}; the dataset is damaged")
    flat = {name: float32(np.asarray(getattr(episode, name)), f"{where}: {name}") for name in NUMBERS}
    flat["masks"] = 1.0 - flags(np.asarray(episode.terminations), f"{where}: terminations").astype(np.float32)
    return flat


def _scaled(actions: Array, space: gym.spaces.Box, dataset_id: str) -> Array:
    """Return actions scaled from the space's bounds to [-1, 1]; actions outside are clipped, with a warning."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    scaled = 2.0 * (actions - low) / (high - low) - 1.0
    outside = int((np.abs(scaled) > 1 + CLIP_TOLERANCE).any(1).sum())
    if outside:
        warn(f"{dataset_id}: {outside} actions out of bounds were clipped")
    if 0 < (used := float((scaled.max(0) - scaled.min(0)).max()) / 2) < MIN_ACTION_RANGE:
        warn(
            f"{dataset_id}: actions use {used:.1g} of the range between the action space's bounds, "
            "which policies can hardly resolve; correct the action space to what the environment takes"
        )
    return np.clip(scaled, -1, 1).astype(np.float32)
