"""Tables that can be written as CSV, Markdown and LaTeX, and as HTML by offbench.reports.page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from offbench.common.files import csv_bytes
from offbench.common.text import no_formula, printable

SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "β": r"$\beta$",
    "†": r"$\dagger$",
    "‡": r"$\ddagger$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    **{character: "\\" + character for character in "&%$#_{}"},
}


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: the text shown.
        value: the sort key, if it is not the text.
        more: further text (steps, seeds): in brackets after `text`, in small print in HTML.
        below: a second line in small print (HTML only).
        best: whether to highlight it, for example as the best of its row.
        detail: the id of the dialog that a click opens (HTML only).
    """

    text: str
    value: float | None = None
    below: str = ""
    best: bool = False
    detail: str = ""
    more: str = ""

    @property
    def full(self) -> str:
        """The text, followed by `more` in brackets."""
        return f"{self.text} ({self.more})" if self.more else self.text


@dataclass(frozen=True)
class Table:
    """A table with its title and the notes below it.

    Attributes:
        name: the stem of its files and its id in the page.
        heads: number of leading columns that name the row.
        small: a second line of each column's header (HTML; in the other formats it follows the first in brackets).
    """

    name: str
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()
    heads: int = 1
    small: Sequence[str] = ()

    def columns(self) -> list[str]:
        """Return each column's whole header on one line."""
        below = self.small or [""] * len(self.header)
        return [f"{text} ({more})" if more else text for text, more in zip(self.header, below, strict=True)]

    def csv(self) -> bytes:
        """Return the table as CSV, text as shown."""
        header = [str(no_formula(text)) for text in self.columns()]
        return csv_bytes(header, [[no_formula(cell.full) for cell in row] for row in self.rows])

    def markdown(self) -> str:
        """Return title, table and notes as Markdown; the best in bold."""
        cells = [[f"**{plain(c.full)}**" if c.best else plain(c.full) for c in row] for row in self.rows]
        lines = markdown([plain(text) for text in self.columns()], cells)
        notes = [line for note in self.notes for line in ("", plain(note))]
        return "\n".join([f"## {plain(self.title)}", "", *lines, *notes]) + "\n"

    def latex(self) -> str:
        """Return the table as LaTeX (booktabs), the notes as comments; the best in bold."""
        body = [[f"\\textbf{{{latex(c.full)}}}" if c.best else latex(c.full) for c in row] for row in self.rows]
        notes = [f"% {printable(' '.join(note.split()))}" for note in (self.title, *self.notes)]
        return "\n".join([*notes, *tabular([latex(text) for text in self.columns()], body, self.heads)]) + "\n"


def files(table: Table) -> Mapping[str, bytes]:
    """Return the contents of a table's files by their extensions."""
    return {"csv": table.csv(), "md": table.markdown().encode(), "tex": table.latex().encode()}


def latex(text: str) -> str:
    """Return text with everything escaped that LaTeX would take for a command."""
    return "".join(SPECIAL.get(character, character) for character in printable(text))


def tabular(header: Sequence[str], cells: Sequence[Sequence[str]], names: int) -> list[str]:
    """Return the lines of a LaTeX table (booktabs) of escaped text; columns after the first `names` align right."""
    lines = [" & ".join(line) + r" \\" for line in [header, *cells]]
    # after a row, LaTeX would take [...] for an argument
    head, *body = ["{}" + line if line.startswith("[") else line for line in lines]
    spec = "l" * names + "r" * (len(header) - names)
    top = [f"\\begin{{tabular}}{{{spec}}}", r"\toprule", head, r"\midrule"]
    return [*top, *body, r"\bottomrule", r"\end{tabular}"]


def plain(text: str) -> str:
    """Return text with Markdown's special characters escaped."""
    escaped = "".join("\\" + c if c in "\\`*_[]|#" else c for c in printable(text))
    return html.escape(escaped, quote=False).replace("\n", " ")


def markdown(header: Sequence[str], cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return ["| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *cells]]
