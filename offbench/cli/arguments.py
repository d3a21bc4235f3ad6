"""Types of command-line arguments: what is typed becomes a value, or a refusal that says what was meant."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from offbench.common.errors import OffbenchError, nearest


class Parser(argparse.ArgumentParser):
    """An argument parser whose refusals are one line and exit code 2.

    Attributes:
        asked: the command whose `--help` a refusal names, where it is not the parser's own.
    """

    asked = ""

    def error(self, message: str) -> NoReturn:
        """Raise the refusal as the error that `main` prints."""
        raise OffbenchError(f"{message} (see `{self.asked or self.prog} --help`)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what a command does not know here, where its flags are known, and before what it lacks is said."""
        if self._subparsers is None:
            for word in args:
                self._check_flag(word.partition("=")[0])
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return found, rest

    def _check_flag(self, flag: str) -> None:
        known = [name for name in self._option_string_actions if name.startswith("--")]
        if not flag.startswith("--") or any(name.startswith(flag) for name in known):  # argparse takes abbreviations
            return
        near = nearest(flag[2:], [name[2:] for name in known])
        hint = f": did you mean --{near}?" if near else ""
        self.error(f"unrecognized arguments: {flag}{hint}")


def trust(parser: Parser) -> None:
    """Add --trust, which `main` takes."""
    parser.add_argument(
        "--trust", action="store_true", help="import and run the environment that a file names, whatever its code"
    )


def whole(text: str) -> int:
    """Return a whole number from 1 (1e6 and 1_000_000 are understood)."""
    return _whole(text, 1)


def auto(text: str) -> int | str:
    """Return "auto" or a whole number from 1."""
    return text if text == "auto" else whole(text)


def natural(text: str) -> int:
    """Return a whole number from 0."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = float(text)
        if value != int(value) or value < least:
            raise ValueError
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}") from None
    return int(value)


def share(text: str) -> tuple[int, int]:
    """Return (i, n) of `i/n`."""
    first, slash, last = text.partition("/")
    if not slash:
        raise argparse.ArgumentTypeError(f"{text!r} is no share like 0/4")
    return natural(first), whole(last)


def number(text: str) -> float:
    """Return a number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def seed_list(text: str) -> list[int]:
    """Return the seeds of `3`, `0,1,2` or `0:5` (the end is left out, as in Python)."""
    first, colon, last = text.partition(":")
    try:
        found = list(range(natural(first), natural(last))) if colon else [natural(part) for part in text.split(",")]
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; seeds are 3, 0,1,2 or 0:4 (0 to 3)") from None
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} holds no seed")
    return found
