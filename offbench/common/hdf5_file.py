"""HDF5 files written through callbacks that never raise, because libhdf5 can crash the process if one does.

The callbacks record errors (a full disk) and signals (Ctrl-C, SIGTERM), which are raised between writes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py

from offbench.common.interrupts import collect_stop_signals

MAX_COMPRESSION = 1000  # ratio of an array's size to the file's; others are damaged or malicious


class SafeFile:
    """A file object for h5py whose writes never raise.

    The first error is kept and later writes are dropped; `check` raises it. The caller runs `check`
    regularly and at the end.

    Args:
        stops: the signals that `collect_stop_signals` collects.
    """

    def __init__(self, path: Path, stops: Sequence[int] = ()) -> None:
        self._stops = stops
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115 (closed by `close`)
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error of a failed write if there was one, and KeyboardInterrupt if the process is to stop."""
        if self._error is not None:
            raise self._error
        if self._stops:
            raise KeyboardInterrupt  # `collect_stop_signals` raises the signal's exception at its end

    def write(self, data: bytes | memoryview) -> int:
        """Write, or keep the error."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self._error is None:
            try:
                done += self._file.write(view[done:])
            except OSError as error:
                self._error = error
        return len(view)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """Read; bytes that a failed write left out are zero."""
        view = memoryview(buffer).cast("B")
        count = self._file.readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        return len(view)

    def read(self, size: int) -> bytes:
        """Read `size` bytes."""
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, as `io.IOBase.seek`."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self._file.tell()

    def truncate(self, size: int) -> int:
        """Set the size, or keep the error."""
        try:
            self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
        return size

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""

    def close(self) -> None:
        """Flush to the disk and close. Raises the error of a failed write."""
        with self._file:
            self.check()
            os.fsync(self._file.fileno())


CALLBACKS = {
    function.__code__
    for function in (
        SafeFile.write,
        SafeFile.readinto,
        SafeFile.read,
        SafeFile.seek,
        SafeFile.tell,
        SafeFile.truncate,
        SafeFile.flush,
    )
}


@contextlib.contextmanager
def safe_file(path: Path) -> Iterator[SafeFile]:
    """Open a new file for libhdf5. Raises OSError at the end if a write failed."""
    with collect_stop_signals(within=CALLBACKS) as stops:
        file = SafeFile(path, stops)
        try:
            yield file
        except BaseException:
            with contextlib.suppress(OSError, KeyboardInterrupt):
                file.close()
            raise
        file.close()


def stored_elsewhere(file: h5py.File) -> str | None:
    """Return the name of an object below the root that is a link or stored in another file, or None."""
    groups, seen = [file["/"]], set()
    while groups:
        group = groups.pop()
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                return f"{group.name}/{name}".replace("//", "/")
            member = group[name]
            if isinstance(member, h5py.Dataset) and (member.external or member.is_virtual):
                return str(member.name)
            if isinstance(member, h5py.Group) and member.id not in seen:  # hard links can make a circle
                seen.add(member.id)
                groups.append(member)
    return None
