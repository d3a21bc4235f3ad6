"""Progress of long work: a bar with rate and time left on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from tqdm import tqdm

PLAIN_INTERVAL = 30.0  # seconds between two plain lines


BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}, {rate_fmt}{postfix}]"  # the time left is ours, in the postfix


class Progress:
    """Counts steps towards a total. Writes to stderr, so that stdout stays for results.

    Where steps differ in cost, their work (in seconds, or any other unit) is counted beside them, for the time left.
    """

    def __init__(self, total: int, what: str, start: int = 0, work: float | None = None) -> None:
        self.total, self.what, self.done = total, what, start
        self._work: float = total if work is None else work
        self._worked: float = start
        self._first_work: float = start
        self._first, self._note = start, ""
        self._began = self._last = time.monotonic()
        self._bar: Any = None
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=total, initial=start, desc=what, unit="step", unit_scale=True, smoothing=0.05, bar_format=BAR
            )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: object, __: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
        elif kind is None and self.done > self._first:
            self._print()

    def skip(self, done: int, work: float | None = None) -> None:
        """Take in `done` units that were done before, so that they do not count as speed."""
        self.done += done
        self._first += done
        self._worked += done if work is None else work
        self._first_work += done if work is None else work
        if self._bar is not None:
            self._bar.initial += done
            self._bar.update(done)

    def say(self, line: str) -> None:
        """Print a line of its own, above the bar."""
        if self._bar is not None:
            self._bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)

    def to(self, done: int, note: str = "", work: float | None = None) -> None:
        """Say that `done` units are done, with a note such as the last score."""
        step, self.done, self._note = done - self.done, done, note or self._note
        self._worked = done if work is None else work
        if self._bar is not None:
            self._bar.set_postfix_str(self._rest(), refresh=False)
            self._bar.update(step)
        elif time.monotonic() - self._last > PLAIN_INTERVAL:
            self._print()

    def _rest(self) -> str:
        worked = self._worked - self._first_work
        left = (self._work - self._worked) * (time.monotonic() - self._began) / worked if worked else float("inf")
        return f"{duration(left)} left" + (f", {self._note}" if self._note else "")

    def _print(self) -> None:
        self._last = time.monotonic()
        rate = (self.done - self._first) / max(self._last - self._began, 1e-9)
        line = f"{self.what}: {self.done:,}/{self.total:,} steps, {rate:,.0f} steps/s, {self._rest()}"
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
