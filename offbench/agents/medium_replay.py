"""medium-replay: the transitions of a behaviour agent's training up to the medium rung, as episodes.

Where all of them are too many to ship, the recipe's `replay_envs` keeps those of the first of the environments that
were stepped together.

segment files [steps, envs, ...]  ->  per segment, per environment stream: episodes
HDF5: observations [N + E, obs] (T + 1 rows an episode, end to end)   actions [N, act] in [-1, 1]
      rewards [N]   lengths [E]   terminated [E]   stream [E]         (N transitions, E episodes)
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import h5py
import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import read_bytes, read_errors, sha256, write_bytes
from offbench.common.hdf5_file import MAX_COMPRESSION, stored_elsewhere
from offbench.rollouts.rollouts import Episode

if TYPE_CHECKING:
    from offbench.agents.training_folder import TrainingFolder

CHUNK_ROWS = 65_536
NO_SEED = -1  # episodes of a training have no reset seed of their own


class ReplayEpisode(NamedTuple):
    """An episode of SAC's replay buffer: float32, actions in [-1, 1]."""

    observations: Array
    actions: Array
    rewards: Array
    terminated: bool
    stream: int


def replay_episodes(folder: TrainingFolder, until: int) -> Iterator[ReplayEpisode]:
    """Yield the episodes of a training's first `until` steps, segment by segment, stream by stream.

    Of the streams, one for each environment, only the recipe's `replay_envs` are kept.
    """
    segment = folder.recipe.sac.segment
    for start in range(0, until, segment):
        arrays = folder.read_transitions(start + segment)
        streams = arrays["rewards"].shape[1]
        rows = (until - start) // streams  # all of them, except in the segment that `until` lies in
        arrays = {name: array[:rows] for name, array in arrays.items()}
        for stream in range(min(streams, folder.recipe.replay_envs or streams)):
            yield from _split_at_ends({name: array[:, stream] for name, array in arrays.items()}, stream)


def _split_at_ends(arrays: dict[str, Array], stream: int) -> Iterator[ReplayEpisode]:
    """Split one environment's stream of a segment into episodes; SB3's `dones` include truncations."""
    dones, timeouts = arrays["dones"].astype(bool), arrays["timeouts"].astype(bool)
    first = 0
    for last in [*np.flatnonzero(dones), len(dones) - 1]:
        if last < first:
            continue  # the segment ended with an episode's end
        rows = slice(first, last + 1)
        observations = np.concatenate([arrays["observations"][rows], arrays["next_observations"][last : last + 1]])
        ended = bool(dones[last] and not timeouts[last])
        yield ReplayEpisode(observations, arrays["actions"][rows], arrays["rewards"][rows], ended, stream)
        first = last + 1


def save_replay(path: Path, episodes: Iterator[ReplayEpisode]) -> dict[str, int | str]:
    """Write episodes to one compressed HDF5 file; return its transitions, episodes and SHA-256."""
    listed = list(episodes)
    arrays: dict[str, Array] = {
        "observations": np.concatenate([p.observations for p in listed]).astype(np.float32),
        "actions": np.concatenate([p.actions for p in listed]).astype(np.float32),
        "rewards": np.concatenate([p.rewards for p in listed]).astype(np.float32),
        "lengths": np.array([len(p.rewards) for p in listed], np.int64),
        "terminated": np.array([p.terminated for p in listed]),
        "stream": np.array([p.stream for p in listed], np.int64),
    }
    data = io.BytesIO()
    with h5py.File(data, "w") as file:
        for name, array in arrays.items():
            # one column per chunk, shuffled by bytes: similar bytes are adjacent and compress well
            chunks = (min(len(array), CHUNK_ROWS), *(1 for _ in array.shape[1:]))
            file.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=6, shuffle=True)
    write_bytes(path, data.getvalue())
    return {"transitions": len(arrays["rewards"]), "episodes": len(listed), "sha256": sha256(data.getvalue())}


def load_replay(
    path: Path, expected_sha256: str, observations: gym.spaces.Box, low: Array, high: Array
) -> Iterator[Episode]:
    """Yield the recorded episodes, in the environment's bounds and precision.

    Raises:
        OffbenchError: the file is missing, damaged, or not the one its ladder describes.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise OffbenchError(
            f"cannot read {path}: {error.strerror or error}; build the ladder again with `offbench behaviour`"
        ) from None
    if sha256(data) != expected_sha256:
        raise OffbenchError(
            f"{path} is damaged (its SHA-256 differs from the ladder's); reinstall, or build the ladder again"
        )
    with read_errors(str(path), "is damaged", "build the ladder again with `offbench behaviour`"):
        arrays = _arrays(data, observations.shape[0], len(low))
    span = (high.astype(np.float64) - low) / 2
    row = step = 0
    for length, terminated in zip(arrays["lengths"], arrays["terminated"], strict=True):
        actions = np.clip(low + (arrays["actions"][step : step + length] + 1.0) * span, low, high)
        yield Episode(
            NO_SEED,
            arrays["observations"][row : row + length + 1].astype(observations.dtype),
            actions.astype(low.dtype),
            arrays["rewards"][step : step + length].astype(np.float64),
            bool(terminated),
            not terminated,
        )
        row, step = row + length + 1, step + length


def _arrays(data: bytes, obs: int, act: int) -> dict[str, Array]:
    """Return the arrays of a replay file. Raises ValueError if they do not fit together or contain NaN."""
    with h5py.File(io.BytesIO(data), "r") as file:
        if elsewhere := stored_elsewhere(file):
            raise ValueError(f"{elsewhere} is not data of this file")
        columns = {name: file[name] for name in ("observations", "actions", "rewards", "lengths", "terminated")}
        for name, column in columns.items():
            dtype_kinds = {"lengths": "iu", "terminated": "biu"}.get(name, "f")
            if column.dtype.kind not in dtype_kinds or column.nbytes > MAX_COMPRESSION * len(data):
                raise ValueError(f"{name} are {column.dtype} {column.shape}")
        arrays: dict[str, Array] = {name: column[()] for name, column in columns.items()}
    steps, episodes = len(arrays["rewards"]), len(arrays["lengths"])
    shapes = {"observations": (steps + episodes, obs), "actions": (steps, act), "rewards": (steps,)}
    shapes |= dict.fromkeys(("lengths", "terminated"), (episodes,))
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} have shape {arrays[name].shape}, not {shape}")
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} contain NaN or infinite numbers")
    lengths = arrays["lengths"]
    if not ((lengths >= 1) & (lengths <= steps)).all() or lengths.sum() != steps:
        raise ValueError(f"the lengths of its episodes do not add up to {steps}")
    return arrays
