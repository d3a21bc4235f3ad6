"""Detect changed files by their stamps (size, times, inode), and by their hashes where stamps differ."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, sha256_of
from offbench.data import minari_store

Stamps = dict[str, list[int]]


class ReplacedError(OffbenchError):
    """A dataset was replaced while it was read: what was read may be part the old one, part the new one."""


@contextlib.contextmanager
def unchanged(dataset_id: str) -> Iterator[Stamps]:
    """Read a dataset within this context; yields the stamps of its files.

    Raises:
        ReplacedError: it was replaced meanwhile.
    """
    before = dataset_stamps(dataset_id)
    message = f"{dataset_id} was replaced while it was read; wait until it is recorded, and run the command again"
    try:
        yield before
    except Exception as error:  # Minari raises a ValueError for a missing folder, for example
        if dataset_stamps(dataset_id) == before:
            raise
        raise ReplacedError(message) from error
    if dataset_stamps(dataset_id) != before:
        raise ReplacedError(message)


def dataset_stamps(dataset_id: str) -> Stamps:
    """Return the stamp of each file of a dataset by its name; {} if there is none, or it is being replaced."""
    stamps: Stamps = {}
    try:
        root = f"{minari_store.path_of(dataset_id)}/data/"
        for folder, _, names in os.walk(root):  # pathlib takes several times as long, twice in each load
            for path in (os.path.join(folder, name) for name in names):
                if os.path.isfile(path):
                    stamps[path.removeprefix(root)] = stamp(path)
    except (OffbenchError, OSError):
        return {}
    return dict(sorted(stamps.items(), key=lambda item: item[0].split("/")))


def stamp(path: Path | str) -> list[int]:
    """Return size, mtime, ctime and inode. A program can set a file's mtime, but not its ctime."""
    status = os.stat(path)
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def hash_and_stamp(path: Path) -> tuple[str, list[int]]:
    """Return a file's SHA-256, and its stamp from before it was read."""
    before = stamp(path)
    return sha256_of(path), before


def check_files(paths: Mapping[str, Path], written: JsonObject) -> JsonObject:
    """Return {name: [SHA-256, current stamp]} of files that are unchanged since `written` was recorded.

    A file with the recorded stamp has not been touched. Any other one, such as a copy, is hashed.

    Raises:
        ValueError: a file is missing, unexpected or changed.
    """
    if paths.keys() != written.keys():
        raise ValueError("files are missing or unexpected")
    current = dict(written)
    for name, path in paths.items():
        if stamp(path) != written[name][1]:
            current[name] = list(hash_and_stamp(path))
            if current[name][0] != written[name][0]:
                raise ValueError(f"{path} is not what was written")
    return current
