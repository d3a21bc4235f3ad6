"""Numbers and tables as text, and safe output of text from files."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

MAX_INT = 2**63 - 1  # whole numbers in files
MAX_SEEDS = 100_000  # seeds of one command; a larger count is a typing error and would fill the memory


def whole_number(text: str) -> int:
    """Return the whole number in a text, written in digits or as 1e6.

    Raises:
        ValueError: the text is not a whole number.
    """
    try:
        return int(text)  # exact also beyond 2**53
    except ValueError:
        number = float(text)
        if not number.is_integer():
            raise
        return int(number)


def plural(number: int, noun: str) -> str:
    """Return `run` for 1, else `runs`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """Return `1 run`, `0 runs` or `1,200 runs`."""
    return f"{number:,} {plural(number, noun)}"


def from_to(numbers: Collection[int]) -> str:
    """Return the least and the largest of some numbers: `3 to 1,200`, or `3` if all are the same."""
    low, high = min(numbers), max(numbers)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], names: int = 1) -> list[str]:
    """Return a table as lines of text, a rule below its header; the columns after the first `names` align right."""
    widths = [max(len(line[column]) for line in [header, *rows]) for column in range(len(header))]
    return [
        "  ".join(
            f"{cell:{'<' if i < names else '>'}{width}}"
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in [header, ["-" * width for width in widths], *rows]
    ]


def compact(number: int) -> str:
    """Return a number of steps in few characters: `1M`, `300k`, `12.5k`, `700`."""
    for unit, size in (("M", 1_000_000), ("k", 1_000)):
        if abs(number) >= size and number % (size // 10) == 0:
            return f"{number / size:g}{unit}"
    return f"{number:,}"


def without_steps(heading: str) -> str:
    """Return a method's name from a column's heading: `td3_bc` from `td3_bc (300,000 steps)`."""
    return re.sub(r" \(([\d,]+( of [\d,]+)? steps|steps differ)\)$", "", " ".join(heading.split()))


# control characters except tab and line feed; characters that reverse text, break lines or are invisible
_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff\U000e0000-\U000e007f]"
)


def printable(text: str) -> str:
    r"""Return text that is safe to print: control characters are escaped, as in `\x1b[2J`."""
    return _CONTROLS.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


_NUMBERS = re.compile(r"[+-]?[\d.,]+(e[+-]?\d+)?(( ± | to )-?[\d.,]+)?( \([\w,. ]+\))?|-inf")


def no_formula(cell: object) -> object:
    """Return a CSV cell that no spreadsheet takes for a formula: such text gets an apostrophe in front.

    Control characters are escaped as by `printable`.
    """
    if not isinstance(cell, str):
        return cell
    cell = printable(cell)
    if not (cell[1:] and (cell[0] == "\t" or cell.lstrip()[:1] in tuple("=+-@"))):
        return cell
    return cell if _NUMBERS.fullmatch(cell) else f"'{cell}"
