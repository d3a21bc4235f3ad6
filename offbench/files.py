"""Files that are whole or absent: written aside, flushed to disk, then renamed into place."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from offbench.errors import OffbenchError

ORPHANS = 3.0  # seconds to wait for a lock: processes whose parent was killed notice it within one


@contextlib.contextmanager
def disk_errors(what: str) -> Iterator[None]:
    """Turn the operating system's refusals (full disk, no permission) into one clear line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, FileNotFoundError | BrokenPipeError):
            raise
        reason = error.strerror or str(error)
        raise OffbenchError(f"cannot write {what}: {reason}; free some room or choose another folder") from error


@contextlib.contextmanager
def sole(lock: Path, what: str, patience: float = ORPHANS) -> Iterator[None]:
    """Hold a lock file for this process, so that no other does the same work.

    Args:
        lock: its path, a hidden name; beside it lies who holds it, for the other process to say.
        what: what is held and how, e.g. "hopper-medium-v0 is being recorded".
        patience: seconds to wait for another process to let go.

    Raises:
        OffbenchError: another process holds it; its process id and host are named.
    """
    held, holder = FileLock(lock), lock.with_suffix(".holder")
    with disk_errors(str(lock.parent)):
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            held.acquire(timeout=patience)
        except Timeout:
            raise OffbenchError(f"{what} by {_holder(holder)}; wait for it, or stop it") from None
    try:
        with disk_errors(str(lock.parent)):
            holder.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        holder.unlink(missing_ok=True)
        held.release()


def _holder(path: Path) -> str:
    try:
        words = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        words = ""
    return words if words.startswith("process ") and len(words) < 300 else "another process"


def write_bytes(path: Path, data: bytes) -> None:
    """Replace the content of `path`, or leave it as it was. Raises OffbenchError when the disk refuses."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with disk_errors(str(path)):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(aside, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(aside, path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise


def output_file(path: str | Path) -> Path:
    """Return the path of a file that a user asks for. Raises OffbenchError if its folder is not there."""
    path = Path(path)
    if not path.parent.is_dir():
        raise OffbenchError(f"cannot write {path}: there is no folder {path.parent}")
    return path


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, whole or not at all."""
    write_bytes(path, (json.dumps(value, indent=1, sort_keys=False, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises OffbenchError if it is missing or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        json.dumps(found, ensure_ascii=False).encode()  # "\\ud800" is JSON, but no text that can be shown or written
        return found
    except FileNotFoundError:
        raise OffbenchError(f"no file {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise OffbenchError(f"{path} is damaged or not JSON ({error}); delete it to start over") from None


def csv_bytes(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """Return a CSV file's content; floats keep every digit that matters."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()


def sha256(data: bytes) -> str:
    """Return the hexadecimal SHA-256 of `data`."""
    return hashlib.sha256(data).hexdigest()


def sha256_of(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file, read in pieces."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
