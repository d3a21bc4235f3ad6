"""Files: written whole or not at all, read with errors of one line, and locked while a process writes."""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import socket
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from offbench.common.errors import DamagedError, LockedError, OffbenchError

JsonObject: TypeAlias = dict[str, Any]  # a JSON object whose values nothing has checked yet

# remedies by errno
OPEN_FILES: dict[int | None, str] = dict.fromkeys((errno.EMFILE, errno.ENFILE), "raise the limit with `ulimit -n`")
LOCKED = (
    "another program has it open for writing: wait until it is closed (if this disk has no file locks, set "
    "HDF5_USE_FILE_LOCKING=FALSE)"
)
WRITE_REMEDIES: dict[int | None, str] = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "free some space or "),
    **dict.fromkeys((errno.EACCES, errno.EPERM), "check its permissions or "),
}
DISK = "check the disk or the network that holds it, and run the command again"
NO_MEMORY = "close other programs; if there is enough memory, it is damaged"
READ_REMEDIES: dict[int | None, str] = {  # for errors that do not mean damaged content
    **OPEN_FILES,
    **dict.fromkeys((errno.EAGAIN, errno.EWOULDBLOCK, errno.EDEADLK, errno.ENOLCK), LOCKED),
    **dict.fromkeys((errno.EACCES, errno.EPERM), "check its permissions"),
    errno.ENOMEM: NO_MEMORY,
    **dict.fromkeys((errno.EIO, errno.ENXIO, errno.ENODEV, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN), DISK),
}
REINSTALL = "reinstall offbench"  # the remedy for damage to a file that comes with offbench
LOCK_TIMEOUT = 3.0  # seconds to wait for a lock: processes whose parent was killed notice it within one


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory has run out, of this machine or of a GPU."""
    # PyTorch's and NumPy's (the last two are of sizes beyond 64 bits), and the dynamic linker's
    words = (
        "can't allocate memory",
        "out of memory",
        "failed to map segment",
        "calculation overflowed",
        "array is too big",
    )
    by_number = isinstance(error, OSError) and error.errno == errno.ENOMEM
    by_text = isinstance(error, RuntimeError | ImportError | ValueError) and any(word in str(error) for word in words)
    return isinstance(error, MemoryError) or by_number or by_text


def is_exhausted(error: BaseException) -> bool:
    """Return whether memory or file descriptors have run out, so that the operation itself may be valid."""
    return is_out_of_memory(error) or (isinstance(error, OSError) and error.errno in OPEN_FILES)


@contextlib.contextmanager
def write_errors(what: str, elsewhere: str = "choose another folder") -> Iterator[None]:
    """Convert the operating system's errors while writing (full disk, no permission) into an error of one line.

    Args:
        what: the file or folder that is written.
        elsewhere: the advice to choose another location, as the end of the message.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        if isinstance(error, FileNotFoundError):
            gone = error.filename or "its folder"
            raise OffbenchError(
                f"cannot write {what}: {gone} is missing, or was moved or deleted meanwhile; run the command again"
            ) from error
        remedy = OPEN_FILES.get(error.errno) or f"{WRITE_REMEDIES.get(error.errno, '')}{elsewhere}"
        raise OffbenchError(f"cannot write {what}: {error.strerror or error}; {remedy}") from error


@contextlib.contextmanager
def exclusive_lock(path: Path, what: str, timeout: float = LOCK_TIMEOUT) -> Iterator[None]:
    """Hold a lock file for this process, so that no other one does the same work.

    Args:
        path: the lock file, with a hidden name; a second file in its folder names the process that holds it.
        what: what is locked and why, e.g. "hopper-medium-v0 is being recorded".
        timeout: seconds to wait for another process to release the lock.

    Raises:
        LockedError: another process holds it; its process id and host are named.
    """
    from filelock import FileLock, Timeout  # imported here to keep --help fast

    lock, holder = FileLock(path), path.with_suffix(".holder")
    with write_errors(str(path.parent)):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=timeout)
        except Timeout:
            raise LockedError(f"{what} by {_holder(holder)}; wait for it, or stop it") from None
    try:
        _inodes[path] = path.stat().st_ino  # no new file gets this number while the lock is open
        with write_errors(str(path.parent)):
            holder.unlink(missing_ok=True)
            with open(holder, "x", encoding="utf-8") as file:  # "x" follows no link that lies there
                file.write(f"process {os.getpid()} on {socket.gethostname()}")
        yield
    finally:
        if _holds(path):  # else the holder file belongs to another process
            with contextlib.suppress(OSError):
                holder.unlink(missing_ok=True)
        _inodes.pop(path, None)
        lock.release()


_inodes: dict[Path, int] = {}  # inodes of this process's lock files; a relative path may lead elsewhere later


def _holds(lock: Path) -> bool:
    """Return whether this process still holds the lock file at this path."""
    try:
        return lock.stat().st_ino == _inodes.get(lock)
    except OSError:
        return False


def check_ownership(path: Path) -> None:
    """Check, before a write, that the lock files of this process at or above `path` still exist.

    Args:
        path: relative if the lock's path is.

    Raises:
        OffbenchError: a folder was moved, deleted or replaced while its lock was held.
    """
    for lock in _inodes:
        if lock.parent in path.parents and not _holds(lock):
            raise OffbenchError(
                f"{lock.parent} was moved, deleted or replaced while this process was writing to it; "
                "nothing more is written: move it back and rerun the command to resume, or start over"
            )


def _holder(path: Path) -> str:
    try:
        text = read_text(path)
    except (OSError, ValueError):
        text = ""
    return text if text.startswith("process ") and len(text) < 300 else "another process"


def write_bytes(path: Path, data: bytes) -> None:
    """Replace the content of `path`, or leave it as it was.

    Raises:
        OffbenchError: the disk refuses, or the folder is no longer the one that this process has locked.
    """
    write_together({path: data})


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Replace the contents of several files, each whole, in this order once all are written next to them.

    A failure before all are written leaves all as they were; a later one (of a rename) leaves the first ones new.

    Raises:
        OffbenchError: as `write_bytes`.
    """
    temporaries: dict[Path, Path] = {}
    try:
        for path, data in contents.items():
            check_ownership(path)
            temporaries[path] = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
            with write_errors(str(path)):
                path.parent.mkdir(parents=True, exist_ok=True)
                with open(temporaries[path], "xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            with write_errors(str(path)):
                os.replace(temporary, path)
    except BaseException as error:
        for temporary in temporaries.values():
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        if isinstance(error, OffbenchError):
            for path in contents:
                check_ownership(path)  # raises a clearer error if the folder was moved
        raise


def remove_leftovers(folder: Path) -> None:
    """Delete the unfinished files of killed processes in `folder`, whose lock must be held."""
    for leftover in folder.glob(".*.tmp"):
        with write_errors(str(leftover)):
            delete(leftover)


def delete(path: Path) -> None:
    """Delete a file, a link (never what it leads to), or a folder with all that it holds, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def home_folder(variable: str) -> Path:
    """Return the user's home. Raises OffbenchError if there is none: `variable` names a folder to use instead."""
    try:
        return Path.home()
    except RuntimeError:
        raise OffbenchError(f"there is no home folder; set HOME or {variable}") from None


def output_file(path: str | Path) -> Path:
    """Return the path of a file to write.

    Raises:
        OffbenchError: its folder does not exist, or something other than a file is there.
    """
    path = Path(path)
    if not path.name or (path.exists() and not path.is_file()):
        raise OffbenchError(f"cannot write {path}: it is not a file; choose another name")
    if not path.parent.is_dir():
        raise OffbenchError(f"cannot write {path}: there is no folder {path.parent}")
    return path


def write_json(path: Path, value: object) -> None:
    """Write `value` as indented JSON, whole or not at all."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path, remedy: str = REINSTALL) -> JsonObject:
    """Read the JSON object in a file. Raises OffbenchError if it is missing or damaged: the `remedy` is for that."""
    try:
        with read_errors(str(path), "is damaged or not JSON", remedy):
            value = json.loads(read_text(path))
            json.dumps(value, ensure_ascii=False).encode()  # "\\ud800" is JSON, but cannot be printed or written
            if not isinstance(value, dict):
                raise ValueError(f"must be a JSON object, not {json.dumps(value)[:40]}")
            return value
    except FileNotFoundError:
        raise OffbenchError(f"no file {path}") from None


def csv_bytes(header: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """Return a CSV file's content; floats are written with full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()


@contextlib.contextmanager
def read_errors(name: str, fault: str, remedy: str) -> Iterator[None]:
    """Convert any exception raised while reading a file into an error of one line.

    Errors of the operating system (a lock, no permission, a failing disk) and missing packages are reported as such,
    all others as damage. A missing file is left to the caller.

    Args:
        name: the file, e.g. "run/config.json".
        fault: how the message describes invalid content, e.g. "is damaged".
        remedy: what to do about invalid content.

    Raises:
        DamagedError: the content is invalid.
        OffbenchError: it cannot be read for another reason.
    """
    try:
        yield
    except (OffbenchError, FileNotFoundError):
        raise
    except Exception as error:  # parsers raise anything for damaged bytes
        if other := _read_remedy(error):
            raise OffbenchError(f"cannot read {name}: {_reason(error)}; {other}") from error
        raise DamagedError(f"{name} {fault} ({_reason(error)}); {remedy}") from error


def _read_remedy(error: BaseException) -> str | None:
    """Return what to do about a read error that does not mean damaged content; None for any other error."""
    if is_out_of_memory(error):
        return NO_MEMORY
    if isinstance(error, ImportError):
        return f"install the package {error.name}" if error.name else "install it"
    number = getattr(error, "errno", None)
    if number is None and isinstance(error, OSError | RuntimeError):  # libhdf5 has the number in the text only
        inside = re.search(r"\berrno = (\d+)", str(error))
        number = int(inside[1]) if inside else None
    return READ_REMEDIES.get(number)


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return f"there is no {text}" if type(error) is KeyError else text


def open_regular(path: str | Path, flags: int = os.O_RDONLY) -> int:
    """Open a regular file (an `opener` for `open`): a FIFO or device could block or never end.

    Raises:
        OSError: it is not a regular file, or cannot be opened.
    """
    try:
        descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        if error.errno == errno.ENXIO:  # a socket, or a device that does not exist
            raise OSError(f"{path} is not a regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is not a regular file")
    return descriptor


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file. Raises OSError."""
    with open(path, "rb", opener=open_regular) as file:
        return file.read()


def read_text(path: Path) -> str:
    """Return the UTF-8 text of a regular file. Raises OSError or ValueError."""
    return read_bytes(path).decode("utf-8")


def sha256(data: bytes) -> str:
    """Return the hexadecimal SHA-256 of `data`."""
    return hashlib.sha256(data).hexdigest()


def sha256_of(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a regular file, read in pieces."""
    with open(path, "rb", opener=open_regular) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
