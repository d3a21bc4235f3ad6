"""Progress of long operations: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Self

from offbench.common.terminal import console, is_terminal
from offbench.common.text import printable

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.progress import Progress as Bar

PLAIN_INTERVAL = 30.0  # seconds between two plain lines without a new note
REFRESH_INTERVAL = 0.1  # seconds between two updates of the bar
NARROWEST_BAR = 18  # columns of the bar, its percents and the space around them


class Progress:
    """Shows on stderr how many of a total number of steps are done; stdout is for results.

    If steps differ in cost, the time left is estimated from their work, in seconds or any other unit. Without a
    terminal, a line is printed for every new note (such as the score of an evaluation), and every half minute.
    """

    def __init__(self, total: int, what: str, work: float | None = None) -> None:
        what = printable(what)
        self.total, self.what, self.done = total, what, 0
        self._work: float = total if work is None else work
        self._worked = self._first_work = 0.0
        self._first, self._note, self._printed = 0, "", -1
        self._began = self._last = time.monotonic()
        self._bar: Bar | None = None
        if is_terminal(sys.stderr):
            self._bar = bar = _bar()
            self._task = bar.add_task(what, total=total, completed=0, details=self._details(bar), note="")

    def __enter__(self) -> Self:
        if self._bar is not None:
            try:
                self._bar.start()
            except BaseException:  # Ctrl-C: without this, the cursor would stay hidden
                self._bar.stop()
                raise
        return self

    def __exit__(self, exception_type: type[BaseException] | None, _: object, __: TracebackType | None) -> None:
        if self._bar is not None:
            self._update(self._bar)
            self._bar.stop()
        elif exception_type is None and self.done > self._first and self._printed != self.done:
            self._print()

    def skip(self, done: int, work: float) -> None:
        """Add `done` steps, and their work, that an earlier session has done; they do not count for the rate."""
        self.done += done
        self._first += done
        self._worked += work
        self._first_work += work

    def print_line(self, line: str) -> None:
        """Print a line of its own, above the bar."""
        if self._bar is not None:
            self._bar.console.print(line)
        else:
            print(line, file=sys.stderr, flush=True)

    def to(self, done: int, note: str = "", work: float | None = None) -> None:
        """Set the number of completed steps and their work, and a note such as the last score."""
        is_new = note not in ("", self._note)
        self.done, self._note = done, note or self._note
        self._worked = done if work is None else work
        waited = time.monotonic() - self._last
        if self._bar is not None:
            if waited >= REFRESH_INTERVAL:
                self._update(self._bar)
        elif is_new or waited > PLAIN_INTERVAL:
            self._print()

    def _update(self, bar: Bar) -> None:
        self._last = time.monotonic()
        details = self._details(bar)
        room = max(bar.console.width - len(details) - NARROWEST_BAR, 4)
        title = self.what if len(self.what) <= room else f"{self.what[: room - 3]}..."
        bar.update(self._task, description=title, completed=self.done, details=details, note=self._note, refresh=True)

    def _rate(self) -> float:
        return (self.done - self._first) / max(time.monotonic() - self._began, 1e-9)

    def _left(self) -> str:
        worked = self._worked - self._first_work
        left = (self._work - self._worked) * (time.monotonic() - self._began) / worked if worked else float("inf")
        return f"{duration(left)} left"

    def _details(self, bar: Bar) -> str:
        """Return the text beside the bar. A narrow terminal leaves out the rate."""
        done, rate, left = f"{self.done:,}/{self.total:,}", f"{self._rate():,.0f} steps/s", self._left()
        details = f"{done}, {rate}, {left}"
        room = bar.console.width - len(self.what) - NARROWEST_BAR
        return details if len(details) <= room else f"{done}, {left}"

    def _print(self) -> None:
        self._last, self._printed = time.monotonic(), self.done
        parts = [f"{self.what}: {self.done:,}/{self.total:,} steps", f"{self._rate():,.0f} steps/s", self._left()]
        print(", ".join(filter(None, [*parts, self._note])), file=sys.stderr, flush=True)


def _bar() -> Bar:
    """Return rich's bar for one task: title, bar, percent and details, and the task's note on a line below."""
    from rich import progress
    from rich.text import Text

    class NoteBar(progress.Progress):
        def get_renderables(self) -> Iterator[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            for task in self.tasks:
                if task.fields["note"]:
                    yield Text(f"  {task.fields['note']}", style="dim", no_wrap=True, overflow="ellipsis")

    columns = [
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(bar_width=None),
        progress.TaskProgressColumn(),
        progress.TextColumn("{task.fields[details]}", style="dim", markup=False),
    ]
    return NoteBar(*columns, console=console(sys.stderr), auto_refresh=False, expand=True)


def duration(seconds: float) -> str:
    """Return a duration as text: `3 h 12 min`, `4 min 10 s`, `12 s`."""
    if seconds == float("inf"):
        return "?"
    seconds = round(seconds)
    if seconds >= 3600:
        return f"{seconds // 3600} h {seconds % 3600 // 60} min"
    if seconds >= 60:
        return f"{seconds // 60} min {seconds % 60} s"
    return f"{seconds} s"
