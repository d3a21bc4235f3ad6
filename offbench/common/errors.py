"""The one error that users see: a line that says what is wrong and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

NEAR = 0.76  # of two names' likeness: more than iql and cql, less than hoper and hopper
SHOW_TRACEBACK = "OFFBENCH_TRACEBACK=1 shows the traceback"


class OffbenchError(Exception):
    """A problem the user can mend. The CLI prints its text as one line and exits with code 2."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that `name` is a slip of the pen or a part of; None if none is that near."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=NEAR)
    parts = [one for one in names if len(name) >= 3 and name in one]
    return next(iter(near + parts), None)


def unknown(what: str, name: str, known: Iterable[str]) -> OffbenchError:
    """Return the error for a `name` that is not among the `known` ones, with a near one suggested."""
    names = sorted(known)
    near = nearest(name, names)
    hint = f"did you mean {near!r}?" if near else f"known: {', '.join(names) or 'none'}"
    return OffbenchError(f"unknown {what} {name!r}: {hint}")
