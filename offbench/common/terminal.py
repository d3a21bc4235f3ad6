"""Output for people: tables, hints and errors, in color on a terminal and as plain text in a pipe or a file.

rich is imported only to write to a terminal, so that a short command stays fast. NO_COLOR and TERM=dumb are respected.
"""

from __future__ import annotations

import itertools
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, TextIO

from offbench.common.text import aligned, printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

NARROW, NARROWEST = 28, 12  # widths of a column of names
LABEL = re.compile(r" *([A-Za-z][\w -]*?  +|\w+_sha256 )(?=\S)")  # at the start of a line
GLUE = "\0"  # placeholder for a space where a line must not break


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal."""
    return stream is not None and stream.isatty()


def console(stream: TextIO) -> Console:
    """Return rich's console of a stream. Text of files must pass `printable` first: rich writes escape sequences."""
    from rich.console import Console

    raw = getattr(stream, "raw_stream", stream)
    plain = bool(os.environ.get("NO_COLOR"))  # rich itself would still print bold
    screen = Console(file=raw, color_system=None if plain else "auto", highlight=False, markup=False, emoji=False)
    if screen.width < 1:  # with COLUMNS=0
        screen.width = 80
    return screen


def print_line(line: str, style: str = "") -> None:
    """Print a line to stdout, styled on a terminal."""
    if is_terminal(sys.stdout):
        console(sys.stdout).print(printable(line), style=style or None)
    else:
        print(line, flush=True)


def labeled(label: str, text: str, style: str, *, wrap: bool = True) -> None:
    """Print `label: text` to stderr. On a terminal the label is styled, and lines end between words (with `wrap`)."""
    message = printable(f"{label}: {text}")
    if is_terminal(sys.stderr):
        from rich.text import Text

        screen = console(sys.stderr)
        message = _wrapped(message, screen.width) if wrap else message
        screen.print(Text.assemble((f"{label}:", style), message[len(label) + 1 :]), soft_wrap=True)
    else:
        print(message, file=sys.stderr, flush=True)


def hint(*words: str) -> None:
    """Print the command to run next to stderr, quoted so that it can be pasted."""
    labeled("next", shlex.join(words), "bold green", wrap=False)


def note(text: str) -> None:
    """Print `note: text` to stderr."""
    labeled("note", text, "bold cyan")


def inform(text: str) -> None:
    """Print `offbench: text` to stderr."""
    labeled("offbench", text, "bold cyan")


def warn(text: str) -> None:
    """Print `offbench: warning: text` to stderr."""
    labeled("offbench: warning", text, "bold yellow")


def _wrapped(text: str, width: int) -> str:
    """Return text with lines of at most `width` characters. A `command` stays on one line, for a paste."""
    glued = re.sub("`[^`]*`", lambda command: command[0].replace(" ", GLUE), text)
    lines = textwrap.wrap(glued, width, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace(GLUE, " ")


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of text to stdout, such as `return      mean 1197.1, std 355.1`.

    On a terminal, labels are in color, and the continuation of a long line is indented below its text.
    """
    if not is_terminal(sys.stdout):
        for line in lines:
            print(line, flush=True)
        return
    from rich.text import Text

    screen = console(sys.stdout)
    for line in map(printable, lines):
        label = LABEL.match(line)
        indent = label.end() if label else len(line) - len(line.lstrip()) + 2
        below = " " * indent
        text = Text("\n".join(textwrap.wrap(line, screen.width, subsequent_indent=below, break_on_hyphens=False)))
        if label:
            text.stylize("cyan", 0, label.end())
        elif line.isalpha():
            text.stylize("bold")
        screen.print(text, soft_wrap=True)


def print_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    names: int = 1,
    group: bool = False,
    optional: Sequence[str] = (),
    marked: Collection[tuple[int, int]] = (),
) -> None:
    """Print a table to stdout.

    In a pipe it is aligned text, one line per row with all columns. On a terminal it is as wide as the terminal:
    long names and headers wrap.

    Args:
        names: number of leading columns that are text; the others are aligned to the right.
        group: on a terminal, rows with the same first cell stand below a heading with it.
        optional: columns to leave out on a terminal that is too narrow, the first one first.
        marked: (row, column) of cells in bold.
    """
    if not is_terminal(sys.stdout):
        print("\n".join(aligned(header, rows, names)))
        return
    screen = console(sys.stdout)
    indent = 2 if group else 0
    shown = list(range(1 if group else 0, len(header)))
    widths = [max(len(line[column]) for line in [header, *rows]) for column in range(len(header))]

    def overflow() -> int:
        """Return how many columns of the terminal the table lacks."""
        return sum(widths[column] + 2 for column in shown) - 2 + indent - int(screen.width)

    def narrow(least: Mapping[int, int]) -> None:
        """Narrow the columns in `least` to at least these widths, the widest first, until the table fits."""
        while overflow() > 0 and (wide := [c for c in shown if c in least and widths[c] > least[c]]):
            widths[max(wide, key=widths.__getitem__)] -= 1

    texts, numbers = range(names), range(names, len(header))
    narrow(dict.fromkeys(texts, NARROW))
    for title in optional:
        if overflow() > 0:
            shown = [column for column in shown if header[column] != title]
    narrow({c: max(map(len, [*header[c].split(), *(row[c] for row in rows)]), default=0) for c in numbers})
    narrow(dict.fromkeys(texts, NARROWEST))
    layout = [(column, widths[column], column < names) for column in shown]
    for line in _lines(header, layout):
        screen.print(_indented(line, indent), style="bold", soft_wrap=True)
    for i, row in enumerate(rows):
        if group and (i == 0 or row[0] != rows[i - 1][0]):
            screen.print(printable(row[0]), style="cyan", soft_wrap=True)
        bold = {column for line, column in marked if line == i}
        for line in _lines(row, layout, bold):
            screen.print(_indented(line, indent), soft_wrap=True)


def _indented(line: Text, by: int) -> Text:
    from rich.text import Text

    return Text(" " * by) + line


def _lines(row: Sequence[str], layout: Sequence[tuple[int, int, bool]], bold: Collection[int] = ()) -> list[Text]:
    """Return the lines of a row, with long names wrapped."""
    from rich.text import Text

    wrapped = [textwrap.wrap(printable(row[column]), width) or [""] for column, width, _ in layout]
    lines = []
    for parts in itertools.zip_longest(*wrapped, fillvalue=""):
        line = Text()
        for part, (column, width, left) in zip(parts, layout, strict=True):
            line.append("  " if line else "")
            line.append(f"{part:{'<' if left else '>'}{width}}", "bold" if column in bold else "")
        line.rstrip()
        lines.append(line)
    return lines
