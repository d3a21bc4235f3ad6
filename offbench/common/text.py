"""Numbers in sentences, and text of files where it is shown."""

from __future__ import annotations

import re
from typing import Any


def plural(number: int, noun: str) -> str:
    """Return `run` for 1, else `runs`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """Return `1 run`, `0 runs` or `1,200 runs`."""
    return f"{number:,} {plural(number, noun)}"


# control characters but tab and line feed, and those that turn the direction of text
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    r"""Return text of a file as a terminal may show it: escape sequences are spelled out, as in `\x1b[2J`."""
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def no_formula(cell: Any) -> Any:
    """Return a CSV cell that no spreadsheet takes for a formula: such text gets an apostrophe in front."""
    if not (isinstance(cell, str) and cell[1:] and cell[0] in "=+-@\t\r"):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
