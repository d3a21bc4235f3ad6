"""Worker processes: how many, and how they start and end."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import operator
import os
import signal
import sys
import threading
import time
import types
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from offbench.common.errors import OffbenchError
from offbench.common.files import OPEN_FILES
from offbench.common.interrupts import STOP_SIGNALS, delay_stop_signals

if TYPE_CHECKING:
    from ctypes import c_byte

MAX_WORKERS = 61 if sys.platform == "win32" else 1_000  # Windows waits for 61 processes at most
GRACE = 2.0  # seconds that a worker has to end when its pool closes
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def environment(variables: Mapping[str, str | None]) -> Iterator[None]:
    """Set environment variables within this context, also for processes started in it; None deletes a variable."""
    before = {name: os.environ.get(name) for name in variables}
    _set(variables)
    try:
        yield
    finally:
        _set(before)


def _set(variables: Mapping[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def cores() -> int:
    """Return the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_workers(workers: int | None) -> int:
    """Return `workers`, or one per core if it is None. Raises OffbenchError below 1 or above MAX_WORKERS."""
    if workers is None:
        return min(cores(), MAX_WORKERS)
    try:
        count = operator.index(workers)
    except TypeError:
        count = 0
    if not 1 <= count <= MAX_WORKERS:
        raise OffbenchError(f"workers must be a whole number from 1 to {MAX_WORKERS:,}, not {workers!r}")
    return count


def blocking_workers(workers: int) -> int:
    """Return 0 instead of 1: where this process would only wait, a single worker process gains nothing."""
    return workers if workers > 1 else 0


@contextlib.contextmanager
def process_start() -> Iterator[None]:
    """Start a process, or what it needs, such as shared memory.

    The operating system's errors are converted into an error of one line. Python must not import from the working
    directory: it may hold files that were handed over, and a process that starts with `-c` has it on its path.
    """
    try:
        with environment({"PYTHONSAFEPATH": "1"}):
            yield
    except OSError as error:
        full = error.errno == errno.ENOSPC
        remedy = OPEN_FILES.get(error.errno, "free some space in /dev/shm" if full else "use fewer --workers")
        raise OffbenchError(f"cannot start a worker process: {error.strerror or error}; {remedy}") from error


@contextlib.contextmanager
def uninterrupted_start() -> Iterator[None]:
    """Start a worker process without interruption (submitting a task may start one).

    Ctrl-C, SIGTERM and SIGHUP are delayed meanwhile, as an interrupted start would leave the pool unusable. The user's
    script is hidden, as a spawned process would run it again. A worker gets one thread for its matrix products: with a
    thread per core in each worker, recording was several times slower.
    """
    script = sys.modules["__main__"]
    threads = {name: "1" for name in THREADS if name not in os.environ}
    with process_start(), delay_stop_signals(), environment(threads):
        sys.modules["__main__"] = types.ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script


class _Worker:
    """The state of this process, if it is a worker."""

    closing: c_byte | None = None  # a shared number that the parent sets


def start_worker(parent: int, closing: c_byte | None = None) -> None:
    """Ignore Ctrl-C, which the parent handles, and exit when the parent has exited (even by kill -9).

    Args:
        closing: a shared number; once it is not 0, the results of this worker are not needed any more. A worker that
            has one leaves SIGTERM and SIGHUP to the parent too: Slurm and a closed terminal send them to all
            processes, and a parent that saves a checkpoint still waits for its evaluations.
    """
    for stop in STOP_SIGNALS if closing is not None else {signal.SIGINT}:
        signal.signal(stop, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)  # blocked while it started
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    _Worker.closing = closing


def closing() -> bool:
    """Return whether the pool of this worker is closing, so that its results are not needed."""
    return _Worker.closing is not None and bool(_Worker.closing.value)


def _parent_is_alive(parent: int) -> bool:
    """Return whether the parent of this process lives; on Windows, getppid still returns it after its end."""
    process = multiprocessing.parent_process()
    return os.getppid() == parent and (process is None or process.is_alive())


def _watch(parent: int) -> None:
    while _parent_is_alive(parent) and not closing():
        time.sleep(1.0)
    if _parent_is_alive(parent):
        time.sleep(GRACE)  # the pool ends its workers itself, unless one of them was killed
    os._exit(1)
