"""The parser of the command line, and the types of its arguments."""

from __future__ import annotations

import argparse
import itertools
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from offbench.common.errors import OffbenchError, nearest
from offbench.common.terminal import is_terminal
from offbench.common.text import MAX_INT, MAX_SEEDS, whole_number

HELP_COLUMN = 28  # where the help of an argument begins, at the latest, on a terminal of 80 columns


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and exit code 2, and whose help is colored on a terminal.

    Attributes:
        help_command: the command whose `--help` an error names, where it is not the parser's own.
    """

    help_command = ""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(formatter_class=_Formatter, allow_abbrev=False, **kwargs)
        self._positionals.title = "arguments"
        self.color = False  # Python 3.14 would color the help, too
        self._negative_number_matcher = re.compile(r"-\.?\d[\d_.]*(e[+-]?\d+)?$", re.IGNORECASE)  # also -1e3

    def error(self, message: str) -> NoReturn:
        """Raise the error that `main` prints."""
        raise OffbenchError(f"{message} (see `{self.help_command or self.prog} --help`)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Report unknown flags before missing arguments, by the parser that has the flags."""
        if self._subparsers is None:
            for word in itertools.takewhile(lambda word: word != "--", args):
                self._check_flag(word.partition("=")[0])
        parsed, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return parsed, rest

    def _check_flag(self, flag: str) -> None:
        flags = [name for name in self._option_string_actions if name.startswith("--")]
        if not flag.startswith("--") or flag in flags:
            return
        near = nearest(flag[2:], [name[2:] for name in flags])
        hint = f": did you mean --{near}?" if near else ""
        self.error(f"unrecognized arguments: {flag}{hint}")

    def print_help(self, file: Any = None) -> None:
        """Print the help, headings and flags in color on a terminal; rich is not imported, to keep --help fast."""
        text, stream = self.format_help(), file or sys.stdout
        if is_terminal(stream) and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb":
            text = re.sub(r"(?m)^(usage:|\S[^:\n]*:$)", "\033[1;32m\\1\033[0m", text)
            text = re.sub(r"(?m)^(  )(-[\w-]+(?:, --[\w-]+)?|[a-z][\w-]+(?=  ))", "\\1\033[1;36m\\2\033[0m", text)
            stream = getattr(stream, "raw_stream", stream)
        stream.write(text)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str, **kwargs: Any) -> None:
        super().__init__(prog, max_help_position=max(HELP_COLUMN, shutil.get_terminal_size().columns // 3), **kwargs)

    def add_usage(
        self, usage: str | None, actions: Iterable[argparse.Action], groups: Any, prefix: str | None = None
    ) -> None:
        """Show only required arguments in the usage line; the options are listed below it."""
        if usage is None:
            needed = sorted(
                (a for a in actions if not a.option_strings or a.required), key=lambda a: bool(a.option_strings)
            )
            parts = [" ".join([*a.option_strings, self._format_args(a, a.dest)]) for a in needed]
            usage = " ".join([self._prog, *parts, "[options]"])
        super().add_usage(usage, actions, groups, prefix)

    def _format_args(self, action: argparse.Action, default_metavar: str) -> str:
        """Return `X ...` for several values, where argparse has `X [X ...]`."""
        if action.nargs == "+":
            return f"{action.metavar or default_metavar} ..."
        return super()._format_args(action, default_metavar)

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        if action.type in (positive_int, non_negative_int):
            return "N"
        return "X" if action.type is number else super()._get_default_metavar_for_optional(action)


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        add_arguments: adds its arguments to a parser, given also the command line after the command.
        examples: command lines without `offbench`.
    """

    help: str
    add_arguments: Callable[[Parser, list[str]], None]
    examples: Sequence[str]

    def epilog(self) -> str:
        """Return the examples as the end of the help."""
        lines = "\n".join(f"  offbench {example}" for example in self.examples)
        return f"example{'s' if len(self.examples) > 1 else ''}:\n{lines}"


def complete_with(action: argparse.Action, words: Callable[[], Iterable[str]]) -> None:
    """Set the words that shell completion offers for an argument; `words` is called when they are needed."""
    action.completer = lambda **_: list(words())  # type: ignore[attr-defined]


def local_datasets() -> list[str]:
    """Return the ids of the local datasets, for completion."""
    from offbench.data import minari_store

    return minari_store.local_ids()


def recipes() -> list[str]:
    """Return the names of the shipped recipes, for completion."""
    from offbench.envs.recipes import shipped_recipes

    return shipped_recipes()


def levels() -> list[str]:
    """Return the names of the levels, for completion."""
    from offbench.data.levels import LEVELS

    return list(LEVELS)


def methods() -> list[str]:
    """Return the names of the methods with runs below ./runs, for completion."""
    from offbench.analysis.results import read_results

    return [method.label for method in read_results("runs").methods]


def add_trust_flag(parser: Parser) -> None:
    """Add --trust, which `main` handles."""
    parser.add_argument(
        "--trust", action="store_true", help="trust the files: import and run any environment that they name"
    )


def positive_int(text: str) -> int:
    """Return a whole number from 1 (1e6 and 1_000_000 are understood)."""
    return _whole(text, 1)


def auto(text: str) -> int | str:
    """Return "auto" or a whole number from 1."""
    return text if text == "auto" else positive_int(text)


def non_negative_int(text: str) -> int:
    """Return a whole number from 0."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = whole_number(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")
    if value > MAX_INT:
        raise argparse.ArgumentTypeError(f"{text!r:.60} is too large a number")
    return value


def shard(text: str) -> tuple[int, int]:
    """Return (i, n) of `I/N`."""
    first, slash, last = text.partition("/")
    if not slash:
        raise argparse.ArgumentTypeError(f"{text!r} is not a part I/N such as 0/4")
    if non_negative_int(first) >= positive_int(last):
        raise argparse.ArgumentTypeError(f"a part is I/N with I from 0 to N-1, not {text}")
    return non_negative_int(first), positive_int(last)


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
        seeds = (
            range(non_negative_int(first), non_negative_int(last))
            if colon
            else [non_negative_int(part) for part in text.split(",")]
        )
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; seeds are 3, 0,1,2 or 0:4 (0 to 3)") from None
    if not seeds:
        raise argparse.ArgumentTypeError(f"{text!r} contains no seeds")
    if len(seeds) > MAX_SEEDS:
        raise argparse.ArgumentTypeError(f"{text!r} has more than {MAX_SEEDS:,} seeds")
    return list(seeds)
