"""Worker processes: how many, and how they start and end."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
import time
import types
from collections.abc import Iterator, Sequence
from typing import Any

from offbench.common.errors import OffbenchError
from offbench.common.files import OPEN_FILES

STOPS = {signal.SIGINT, signal.SIGTERM}
LAST = 2.0  # seconds that a worker has to end when its pool closes
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_workers(workers: int | None) -> int:
    """Return `workers`, or one a core if it is None. Raises OffbenchError below 1."""
    if workers is None:
        return cores()
    if workers < 1:
        raise OffbenchError(f"workers must be at least 1, not {workers}")
    return workers


@contextlib.contextmanager
def start_errors() -> Iterator[None]:
    """Turn the operating system's refusals to start a process, or to share memory with it, into one line."""
    try:
        yield
    except OSError as error:
        full = error.errno == errno.ENOSPC
        remedy = OPEN_FILES.get(error.errno, "free some room in /dev/shm" if full else "use fewer --workers")
        raise OffbenchError(f"cannot start a worker process: {error.strerror or error}; {remedy}") from error


@contextlib.contextmanager
def quiet_start() -> Iterator[None]:
    """Let a worker start undisturbed: submitting a task may start one.

    Ctrl-C and SIGTERM are held back meanwhile (half a start would leave the pool unusable), and the user's script
    is hidden: a spawned process would run it again, and a worker needs nothing of it. A worker gets one thread for
    its matrix products: as many threads as cores in each of as many workers made recording several times slower.
    """
    script = sys.modules["__main__"]
    threads = {name: "1" for name in THREADS if name not in os.environ}
    with start_errors(), _held_back():
        sys.modules["__main__"] = types.ModuleType("__main__")
        os.environ |= threads
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name in threads:
                del os.environ[name]


@contextlib.contextmanager
def _held_back() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM, and let them come at the end.

    The mask is for the process that starts, which inherits it. Here it is not enough: another thread, of a library's
    say, may take the signal, and Python's handler runs in the main thread all the same.
    """
    masks = hasattr(signal, "pthread_sigmask")
    with stops_noted():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS) if masks else set()
        try:
            yield
        finally:
            if masks:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def stops_noted(second_at_once: bool = False) -> Iterator[list[int]]:
    """Take note of Ctrl-C and SIGTERM in the list that this yields; what they do, they do at the end.

    Args:
        second_at_once: let a second Ctrl-C raise KeyboardInterrupt without waiting for the end.
    """
    came: list[int] = []

    def note(number: int, frame: types.FrameType | None) -> None:
        came.append(number)
        if second_at_once and number == signal.SIGINT:
            if came.count(number) > 1:
                signal.default_int_handler(number, frame)
            announce_stop()

    # only the main thread may set handlers; None is a handler that Python cannot put back
    ours = STOPS if threading.current_thread() is threading.main_thread() else ()
    known = [stop for stop in ours if signal.getsignal(stop) not in (None, signal.SIG_IGN)]
    handlers = {stop: signal.signal(stop, note) for stop in known}
    try:
        yield came
    finally:
        for stop, handler in handlers.items():
            signal.signal(stop, handler)
        if came:
            signal.raise_signal(came[0])


def announce_stop() -> None:
    """Tell who pressed Ctrl-C on a terminal what is being waited for."""
    if sys.stderr.isatty():  # written past Python's buffers, which a signal handler must leave alone
        os.write(sys.stderr.fileno(), b"\noffbench: saving a checkpoint; press Ctrl-C again to stop at once\n")


class _Here:
    """What a worker knows of its pool."""

    closing: Any = None  # a shared number that the parent sets


def start_worker(parent: int, closing: Any = None) -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone (even by kill -9).

    Args:
        closing: a shared number; when it is not 0, nothing that this worker is at is wanted any more. A worker that
            has one leaves SIGTERM to the parent too: Slurm sends it to all processes, and a parent that saves a
            checkpoint still waits for its evaluations.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if closing is not None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)  # held back while it started
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    _Here.closing = closing


def closing() -> bool:
    """Return whether nobody waits any more for what this worker is doing."""
    return _Here.closing is not None and bool(_Here.closing.value)


def loaded(names: Sequence[str]) -> list[str]:
    """Return which of these modules this process has loaded (a worker should have no PyTorch)."""
    return [name for name in names if name in sys.modules]


def _watch(parent: int) -> None:
    while os.getppid() == parent and not closing():
        time.sleep(1.0)
    if os.getppid() == parent:
        time.sleep(LAST)  # the pool ends its workers itself, unless one of them was killed
    os._exit(1)
