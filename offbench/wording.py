"""Numbers in sentences."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Return `run` for 1, else `runs`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """Return `1 run`, `0 runs` or `1,200 runs`."""
    return f"{number:,} {plural(number, noun)}"
