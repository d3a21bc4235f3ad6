"""A D4RL file, opened and checked: its columns, and the metadata that `offbench export` left in it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import h5py
from minari.serialization import deserialize_space

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.hdf5_file import MAX_COMPRESSION
from offbench.data import minari_store
from offbench.envs.environments import parse_spec

COLUMNS = ("observations", "actions", "rewards", "terminals")
SEEDS = ("infos/seed", "infos/seeded")  # seeded: where some episodes have a seed of 2**63 or more, and some none
OPTIONAL = ("timeouts", "next_observations", *SEEDS)


@dataclass(frozen=True)
class Source:
    """An opened D4RL file, its columns checked."""

    path: Path
    columns: dict[str, h5py.Dataset]
    about: JsonObject  # what `offbench export` added: Minari's metadata

    def __len__(self) -> int:
        return len(self.columns["rewards"])

    @property
    def shapes(self) -> tuple[int, int]:
        """The dimensions of observations and actions."""
        return self.columns["observations"].shape[1], self.columns["actions"].shape[1]

    def read(self, name: str, first: int, end: int) -> Array:
        """Return rows [first, end) of a column, in this machine's byte order; rewards and flags flat."""
        rows: Array = self.columns[name][first:end]
        rows = rows.astype(rows.dtype.newbyteorder("="), copy=False)
        return rows.reshape(len(rows)) if rows.ndim == 2 and name not in _WIDE else rows


_WIDE = ("observations", "actions", "next_observations")


def read_source(path: Path, file: h5py.File) -> Source:
    """Return an opened file's columns, checked. Raises OffbenchError if it is not a D4RL file, or damaged."""
    columns = {}
    for name in (*COLUMNS, *OPTIONAL):
        column = _local_column(path, file, name)
        if column is not None:
            columns[name] = column
        elif name in COLUMNS:
            raise OffbenchError(f"{path} is not a D4RL file: it has no {name}")
    _check(path, columns)
    return Source(path, columns, _export_metadata(path, file))


def _local_column(path: Path, file: h5py.File, name: str) -> h5py.Dataset | None:
    """Return a column of the file itself, None if there is none.

    Every link is checked before it is followed: it may lead to any file of this machine.
    """
    node = file
    for part in name.split("/"):
        link = node.get(part, getlink=True)
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise OffbenchError(f"{path}: {name} is not data of this file")
        node = node[part]
    if not isinstance(node, h5py.Dataset) or node.external or node.is_virtual:
        raise OffbenchError(f"{path}: {name} is not data of this file")
    return node


def _check(path: Path, columns: dict[str, h5py.Dataset]) -> None:
    """Refuse columns of other lengths, shapes and types, and those that claim more than the file can hold."""
    rows = columns["observations"].shape[0] if columns["observations"].ndim == 2 else 0
    if not rows:
        raise OffbenchError(f"{path}: observations {columns['observations'].shape} are not rows of numbers")
    for name in ("observations", "actions"):
        if columns[name].dtype.kind in "biu":
            raise OffbenchError(f"{path}: {name} are {columns[name].dtype}; convert them to float32 in the file")
    for name, column in columns.items():
        flat = column.shape in ((rows,), (rows, 1)) and name not in _WIDE
        wide = column.ndim == 2 and column.shape[0] == rows and column.shape[1] > 0 and name in _WIDE
        if not (flat or wide) or column.dtype.kind not in "fiub":
            raise OffbenchError(f"{path}: {name} {column.shape} {column.dtype} does not fit {rows:,} rows")
        if column.nbytes > MAX_COMPRESSION * (path.stat().st_size + 1000):
            raise OffbenchError(f"{path}: {name} claims {column.nbytes / 1e9:.0f} GB, more than the file can contain")
    if "next_observations" in columns and columns["next_observations"].shape != columns["observations"].shape:
        raise OffbenchError(f"{path}: next_observations {columns['next_observations'].shape} differ from observations")


def _export_metadata(path: Path, file: h5py.File) -> JsonObject:
    """Return the metadata that `offbench export` wrote into the file, checked; {} for other files."""
    text = file.attrs.get("offbench")
    if text is None:
        return {}
    try:
        about = json.loads(text)
        fields = {key: about[key] for key in KEPT if key in about}
        valid = all(isinstance(fields.get(key, ""), str) for key in minari_store.TEXTS)
        valid = valid and all(all(isinstance(item, str) for item in fields.get(key, [])) for key in _LISTS)
        valid = valid and all(math.isfinite(fields.get(key, 0)) for key in NUMBERS)
        if not valid or not isinstance(fields.get(minari_store.KEY, {}), dict):
            raise ValueError("a value has the wrong type")
        for key in ("env_spec", "eval_env_spec"):
            if key in fields:
                parse_spec(fields[key])
        spaces = tuple(
            deserialize_space(fields[key]) for key in ("observation_space", "action_space") if key in fields
        )
    except Exception as error:  # Gymnasium and Minari raise anything for JSON that is not theirs
        raise OffbenchError(f"{path}: its offbench metadata is damaged ({error}); export the dataset again") from None
    return fields | {"spaces": spaces}


_LISTS = ("author", "author_email", "requirements")
NUMBERS = ("ref_min_score", "ref_max_score", "num_episodes_average_score")
KEPT = (*minari_store.TEXTS, *_LISTS, *NUMBERS, minari_store.KEY)  # Minari's metadata in a file that offbench exported
