"""Progress of long work: a bar with rate and time left on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from tqdm import tqdm

PLAIN_INTERVAL = 30.0  # seconds between two plain lines


class Progress:
    """Counts steps towards a total. Writes to stderr, so that stdout stays for results."""

    def __init__(self, total: int, what: str, start: int = 0) -> None:
        self.total, self.what, self.done = total, what, start
        self._first, self._note = start, ""
        self._began = self._last = time.monotonic()
        self._bar: Any = None
        if sys.stderr.isatty():
            self._bar = tqdm(total=total, initial=start, desc=what, unit="step", unit_scale=True, smoothing=0.05)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: object, __: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
        elif kind is None and self.done > self._first:
            self._print()

    def skip(self, done: int) -> None:
        """Take in `done` units that were done before, so that they do not count as speed."""
        self.done += done
        self._first += done
        if self._bar is not None:
            self._bar.initial += done
            self._bar.update(done)

    def say(self, line: str) -> None:
        """Print a line of its own, above the bar."""
        if self._bar is not None:
            self._bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)

    def to(self, done: int, note: str = "") -> None:
        """Say that `done` units are done, with a note such as the last score."""
        step, self.done, self._note = done - self.done, done, note or self._note
        if self._bar is not None:
            if note:
                self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(step)
        elif time.monotonic() - self._last > PLAIN_INTERVAL:
            self._print()

    def _print(self) -> None:
        self._last = time.monotonic()
        rate = (self.done - self._first) / max(self._last - self._began, 1e-9)
        left = (self.total - self.done) / rate if rate else float("inf")
        note = f", {self._note}" if self._note else ""
        done = f"{self.done:,}/{self.total:,} steps"
        line = f"{self.what}: {done}, {rate:,.0f} steps/s, {duration(left)} left{note}"
        print(line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Return seconds as a person would say them: `3 h 12 min`, `4 min 10 s`, `12 s`."""
    if seconds == float("inf"):
        return "?"
    seconds = round(seconds)
    if seconds >= 3600:
        return f"{seconds // 3600} h {seconds % 3600 // 60} min"
    if seconds >= 60:
        return f"{seconds // 60} min {seconds % 60} s"
    return f"{seconds} s"
