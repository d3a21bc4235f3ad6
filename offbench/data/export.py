"""`export`: a Minari dataset as a D4RL file, or as the arrays that D4RL's loader would make of it.

d4rl   HDF5, the recorded numbers as they are: what D4RL's get_dataset reads, and with it CORL and the TD3+BC
       author's code. Minari's metadata is in the file's attributes, seeds in infos/seed: `import-d4rl` gives
       the same dataset back.
npz    float32, the keys of D4RL's qlearning_dataset: what their replay buffers take.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, output_file, write_errors
from offbench.common.hdf5_file import SafeFile, safe_file
from offbench.common.progress import Progress
from offbench.data import minari_store
from offbench.data.content_hash import ContentHash
from offbench.data.d4rl_file import KEPT
from offbench.data.file_stamps import unchanged
from offbench.data.minari_reader import episodes_of, finite, flags, float32, open_minari, reading, shape_faults
from offbench.envs.environments import box

if TYPE_CHECKING:
    from minari import MinariDataset

FORMATS = {"d4rl": (".hdf5", ".h5"), "npz": (".npz",)}  # {format: endings of its files}
CHUNK = 16_384  # rows of a compressed piece
PIECE = 1 << 20  # bytes copied at once
ATTRIBUTE = 60_000  # bytes that HDF5 lets an attribute have

Columns = dict[str, Array]


def export(dataset_id: str, out: str | Path, *, drop_timeouts: bool = False) -> Path:
    """Write a local Minari dataset with flat Box spaces to one file for other programs.

    Args:
        dataset_id: its id.
        out: the file, .hdf5 (D4RL) or .npz; an existing one is replaced at the end.
        drop_timeouts: .npz only: leave out the steps at a timeout, as D4RL's qlearning_dataset does. (It also never
            reads a file's very last row; one that terminates is kept here.)

    Returns:
        The file.

    Raises:
        OffbenchError: no such dataset, other spaces, damaged data, a file with another ending, no such folder, the
            disk refuses, or the dataset was replaced meanwhile.
    """
    style = _format(Path(out))
    if drop_timeouts and style == "d4rl":
        raise OffbenchError("--drop-timeouts needs an .npz file: readers of D4RL files drop the steps themselves")
    path = output_file(out)
    with write_errors(str(path)), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        temporary = Path(folder) / path.name
        with unchanged(dataset_id):
            _write(dataset_id, temporary, style, drop_timeouts)
        with open(temporary, "r+b") as file:  # Windows flushes only what is open for writing
            os.fsync(file.fileno())
        os.replace(temporary, path)
    return path


def _write(dataset_id: str, path: Path, style: str, drop_timeouts: bool) -> None:
    metadata, data = minari_store.read_metadata(dataset_id), open_minari(dataset_id)
    for name in ("observation_space", "action_space"):
        box(getattr(data, name), f"{dataset_id}: {name}")
    if not data.total_steps:
        raise OffbenchError(f"{dataset_id} has no transitions; record it again")
    content = ContentHash()
    with Progress(int(data.total_steps), f"exporting {dataset_id}") as progress:
        columns = _columns(data, dataset_id, progress, content)
        if style == "d4rl":
            _write_d4rl(path, columns, _about(metadata))
        else:
            dropped = minari_store.read_provenance(metadata).timeouts == "dropped"
            _write_npz(path, (_float32(part, dataset_id) for part in columns), drop_timeouts, dropped)
    minari_store.check_content(dataset_id, metadata, content.hexdigest())


def _format(out: Path) -> str:
    """Return the format that a file's name ends in. Raises OffbenchError for another ending."""
    for name, endings in FORMATS.items():
        if out.suffix.lower() in endings:
            return name
    wanted = " or ".join(itertools.chain(*FORMATS.values()))
    raise OffbenchError(f"cannot write {out.name!r}: exports end in {wanted}")


def _columns(data: MinariDataset, dataset_id: str, progress: Progress, content: ContentHash) -> Iterator[Columns]:
    """Yield the columns of one episode after another, checked to fit together, and add each to `content`."""
    seeds = _seed_columns(data, dataset_id)
    for e in episodes_of(data):
        for fault in shape_faults(e, data.observation_space, data.action_space):
            raise OffbenchError(f"{dataset_id}, episode {e.index}: {fault}; see `offbench verify`")
        for name in ("observations", "actions", "rewards"):
            finite(getattr(e, name), f"{dataset_id}, episode {e.index}: {name}")
        content.add(e.observations, e.actions, e.rewards, e.terminations, e.truncations)
        terminals = flags(e.terminations, f"{dataset_id}, episode {e.index}: terminations")
        timeouts = flags(e.truncations, f"{dataset_id}, episode {e.index}: truncations")
        timeouts[-1] |= not terminals[-1]  # readers find an episode's end by its flags; Minari's buffers need none
        yield {
            "observations": e.observations[:-1],
            "actions": e.actions,
            "rewards": e.rewards,
            "terminals": terminals,
            "timeouts": timeouts,
            "next_observations": e.observations[1:],
            **seeds(e.seed, len(e)),
        }
        progress.to(progress.done + len(e))


def _seed_columns(data: MinariDataset, dataset_id: str) -> Callable[[int | None, int], Columns]:
    """Return a function from an episode's seed and length to its seed columns.

    Seeds are int64, and -1 where there is none; if one is 2**63 or more (Minari's DataCollector draws 64 bits) they
    are uint64, with a column that says which episodes have one.
    """
    with reading(dataset_id):
        largest = max(about.get("seed") or 0 for about in data.storage.get_episode_metadata(data.episode_indices))
    if largest < 2**63:
        return lambda seed, steps: {"infos/seed": np.full(steps, -1 if seed is None else seed, np.int64)}
    return lambda seed, steps: {
        "infos/seed": np.full(steps, seed or 0, np.uint64),
        "infos/seeded": np.full(steps, seed is not None),
    }


def _about(metadata: JsonObject) -> str:
    """Return the metadata that the file keeps, as JSON."""
    about = {key: metadata[key] for key in KEPT if metadata.get(key) is not None}
    text = json.dumps(about)
    if len(text.encode()) > ATTRIBUTE:
        raise OffbenchError(f"{metadata.get('dataset_id')} has more metadata than a D4RL file can carry; shorten them")
    return text


def _write_d4rl(path: Path, parts: Iterator[Columns], about: str) -> None:
    with safe_file(path) as disk, h5py.File(disk, "w") as file:
        file.attrs["offbench"] = about
        for rows in _blocks(parts):
            disk.check()
            for name, array in rows.items():
                _append(_column_for(file, name, array), array)


def _column_for(file: h5py.File, name: str, array: Array) -> h5py.Dataset:
    """Return the column `name`, made or copied to a wider type so that it takes `array`.

    The episodes of a Minari dataset may have different types, such as whole rewards in some of them.
    """
    earlier = file.get(name)
    dtype = np.result_type(array.dtype, earlier.dtype) if earlier else array.dtype
    if earlier and earlier.dtype == dtype:
        return earlier
    if earlier:
        del file[name]  # `earlier` can still be read
    row = array.shape[1:]
    extents = {"shape": (0, *row), "maxshape": (None, *row), "chunks": (CHUNK, *row)}
    column = file.create_dataset(name, dtype=dtype, **extents, compression="gzip", compression_opts=4, shuffle=True)
    for first in range(0, len(earlier) if earlier else 0, CHUNK):
        _append(column, earlier[first : first + CHUNK])
    return column


def _append(column: h5py.Dataset, array: Array) -> None:
    column.resize(len(column) + len(array), axis=0)
    column[-len(array) :] = array


def _blocks(parts: Iterator[Columns]) -> Iterator[Columns]:
    """Join episodes to blocks of at least CHUNK rows."""
    waiting: list[Columns] = []
    rows = 0
    for part in parts:
        waiting.append(part)
        rows += len(part["rewards"])
        if rows >= CHUNK:
            yield _joined(waiting)
            waiting, rows = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _float32(part: Columns, dataset_id: str) -> Columns:
    """Return what qlearning_dataset has of an episode: float32 numbers, boolean flags."""
    numbers = ("observations", "actions", "rewards", "next_observations")
    floats: Columns = {name: float32(part[name], f"{dataset_id}: {name}") for name in numbers}
    return floats | {name: part[name] for name in ("terminals", "timeouts")}


def _write_npz(path: Path, parts: Iterator[Columns], drop_timeouts: bool, dropped: bool) -> None:
    """Write the columns one by one to raw files, then zip them: no column is ever whole in memory.

    Args:
        dropped: whether an import has left out the steps at timeouts, so that the step before is flagged.
    """
    layouts: dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]] = {}
    count = 0
    with contextlib.ExitStack() as stack:
        raw: dict[str, SafeFile] = {}
        for part in parts:
            keep = np.ones(len(part["rewards"]), bool)
            if drop_timeouts:
                keep = ~part["timeouts"] | (dropped & ~part["terminals"])
            for name, array in part.items():
                if name not in raw:
                    raw[name] = stack.enter_context(safe_file(path.with_name(f"{name}.raw")))
                    layouts[name] = (array.dtype, array.shape[1:])
                raw[name].write(np.ascontiguousarray(array[keep]).tobytes())
                raw[name].check()
            count += int(keep.sum())
        disk = stack.enter_context(safe_file(path))
        with zipfile.ZipFile(disk, "w") as archive:
            for name, file in raw.items():
                dtype, shape = layouts[name]
                header = {
                    "descr": np.lib.format.dtype_to_descr(dtype),
                    "fortran_order": False,
                    "shape": (count, *shape),
                }
                size = file.seek(0, os.SEEK_END)
                file.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    for first in range(0, size, PIECE):
                        member.write(file.read(min(PIECE, size - first)))
                        disk.check()
