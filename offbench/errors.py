"""The one error that users see: a line that says what is wrong and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class OffbenchError(Exception):
    """A problem the user can mend. The CLI prints its text as one line and exits with code 2."""


def unknown(what: str, name: str, known: Iterable[str]) -> OffbenchError:
    """Return the error for a `name` that is not among the `known` ones, with the nearest suggested."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names) or 'none'}"
    return OffbenchError(f"unknown {what} {name!r}: {hint}")
