"""Collect Ctrl-C, SIGTERM and SIGHUP while work such as a checkpoint completes, and raise them afterwards.

offbench.training.trainer writes the checkpoint, offbench.training.jobs ends the worker processes.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
import types
from collections.abc import Collection, Iterator
from typing import Any

# SIGHUP comes when a terminal or an SSH connection is closed; Windows has none
STOP_SIGNALS = {signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)}


def stop_handlers() -> dict[signal.Signals, Any]:
    """Return the handlers of the signals that stop a command and are not ignored (as nohup ignores SIGHUP).

    Empty outside the main thread, which alone may set handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {stop: signal.getsignal(stop) for stop in STOP_SIGNALS}
    # None is a handler that Python cannot restore
    return {stop: handler for stop, handler in handlers.items() if handler not in (None, signal.SIG_IGN)}


@contextlib.contextmanager
def delay_stop_signals() -> Iterator[None]:
    """Delay Ctrl-C, SIGTERM and SIGHUP until the context ends.

    A process started within it inherits the signal mask. In this process the mask alone is not enough: another
    thread, such as a library's, may take the signal, and Python's handler still runs in the main thread.
    """
    masks = hasattr(signal, "pthread_sigmask")
    with collect_stop_signals():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS) if masks else set()
        try:
            yield
        finally:
            if masks:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def collect_stop_signals(
    second_at_once: bool = False, within: Collection[types.CodeType] | None = None
) -> Iterator[list[int]]:
    """Collect Ctrl-C, SIGTERM and SIGHUP in the list that this yields, and raise the first again at the end.

    Args:
        second_at_once: let a second Ctrl-C raise KeyboardInterrupt without waiting for the end.
        within: collect only what arrives while one of these functions runs.
    """
    received: list[int] = []

    def note(number: int, frame: types.FrameType | None) -> None:
        if within is not None and not any(caller.f_code in within for caller, _ in traceback.walk_stack(frame)):
            signal.signal(number, handlers[signal.Signals(number)])
            signal.raise_signal(number)
            signal.signal(number, note)  # the original handler did not raise
            return
        received.append(number)
        if second_at_once and number == signal.SIGINT:
            if received.count(number) > 1:
                signal.default_int_handler(number, frame)
            announce_stop()

    handlers = stop_handlers()  # before `note` is called
    for stop in handlers:
        signal.signal(stop, note)
    try:
        yield received
    finally:
        for stop, handler in handlers.items():
            signal.signal(stop, handler)
        if received:
            signal.raise_signal(received[0])


def announce_stop() -> None:
    """Tell the user who pressed Ctrl-C on a terminal what the program waits for."""
    if sys.stderr.isatty():  # not through Python's buffers, which a signal handler must not use
        os.write(sys.stderr.fileno(), b"\noffbench: saving a checkpoint; press Ctrl-C again to stop at once\n")
