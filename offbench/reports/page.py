"""The report's page: one HTML file with everything in it, to be opened without a network."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from offbench.analysis.results import REFERENCES, Entry, Results
from offbench.common.scores import run_return
from offbench.common.tables import Cell, Table
from offbench.reports.figures import Figure, LineStyle
from offbench.reports.markup import Markup, breakable, join, prose, tag
from offbench.reports.tables import cell_id
from offbench.training.run import Run
from offbench.training.run_config import Session


@dataclass(frozen=True)
class Section:
    """A part of the page: heading, an introduction (on the screen, not in print) and content."""

    name: str
    title: str
    content: Sequence[Markup]
    intro: str = ""


GENERATOR = tag("meta", name="generator", content="offbench")  # identifies an older report, which may be replaced


def page(title: str, lead: Markup, sections: Sequence[Section], dialogs: Sequence[Markup]) -> bytes:
    """Return the whole page. Nothing but its own script may run, and nothing may be fetched."""
    style, script = (_asset(name) for name in ("report.css", "report.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        GENERATOR,
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Markup(style)),
    )
    links = [tag("a", section.title, href=f"#{section.name}") for section in sections]
    body = [
        tag("header", tag("h1", title), lead, tag("nav", *links, aria_label="Contents")),
        tag("main", *map(_section, sections)),
        *dialogs,
        tag("script", Markup(script)),
    ]
    return ("<!DOCTYPE html>\n" + tag("html", head, "\n", tag("body", *body), lang="en") + "\n").encode(
        errors="backslashreplace"
    )


def _asset(name: str) -> str:
    return (importlib.resources.files("offbench.reports") / "assets" / name).read_text(encoding="utf-8")


def _section(section: Section) -> Markup:
    intro = [tag("p", section.intro, class_="screen")] if section.intro else []
    return tag("section", tag("h2", section.title), *intro, *section.content, "\n", id=section.name)


def table_html(data: Table, *, caption: bool = False, download: bool = True) -> Markup:
    """Return a table that sorts by a click on a column's header, with its title shown and links to its files."""
    small = data.small or [""] * len(data.header)
    head = []
    for i, (text, below) in enumerate(zip(data.header, small, strict=True)):
        more = [tag("small", breakable(below))] if below else []
        head.append(
            tag(
                "th",
                tag("button", breakable(text), type="button"),
                *more,
                scope="col",
                class_="name" if i < data.heads else "number",
            )
        )
    rows = [tag("tr", *[_cell(data, i, cell) for i, cell in enumerate(row)]) for row in data.rows]
    heading = [tag("h4", data.title)] if caption else []
    title = tag("caption", data.title, class_="unseen")
    files = [
        tag("a", ending.upper(), href=f"tables/{data.name}.{ending}", download=True) for ending in ("csv", "md", "tex")
    ]
    return join(
        *heading,
        tag(
            "div",
            tag("table", title, tag("thead", tag("tr", *head)), tag("tbody", *rows)),
            class_="wide",
            tabindex=0,
            role="region",
            aria_label=data.title,
        ),
        *[tag("p", prose(note), class_="note") for note in data.notes],
        *([tag("p", "This table: ", *files, class_="files")] if download else []),
    )


def _cell(data: Table, column: int, cell: Cell) -> Markup:
    text: Markup = breakable(cell.text)
    if cell.best:
        text = tag("b", text)
    if cell.detail:
        text = tag("button", text, type="button", data_box=cell.detail, aria_haspopup="dialog")
    for small in filter(None, (cell.more, cell.below)):
        text = join(text, tag("small", breakable(small)))
    value = None if cell.value is None else repr(float(cell.value))
    if column < data.heads:
        return tag("th", text, scope="row", class_="name", data_value=value)
    return tag("td", text, class_="number best" if cell.best else "number", data_value=value)


def figures_html(group: Sequence[Figure]) -> Markup:
    """Return figures in a grid below one legend of all their lines."""
    styles = dict.fromkeys(style for figure in group for style in figure.legend)
    parts = []
    for figure in group:
        files = [
            tag("a", ending.upper(), href=f"figures/{figure.name}.{ending}", download=True)
            for ending in ("png", "svg")
        ]
        picture = tag("div", Markup(figure.inline), role="img", aria_label=figure.alt)
        parts.append(tag("figure", picture, tag("figcaption", figure.caption, " ", *files)))
    legend = [tag("ul", *[_legend_item(style) for style in styles], class_="legend")] if styles else []
    return join(*legend, tag("div", *parts, class_="figures"))


def _legend_item(style: LineStyle) -> Markup:
    dashes = "" if style.dashes == "-" else " ".join(f"{2 * part:g}" for part in style.dashes[1])
    stroke = tag("line", x1=1, y1=5, x2=31, y2=5, stroke=style.color, stroke_width=3, stroke_dasharray=dashes or None)
    return tag("li", tag("svg", stroke, viewBox="0 0 32 10", aria_hidden="true"), breakable(style.label))


def dialogs_html(results: Results) -> list[Markup]:
    """Return a dialog for every cell of the score table with the provenance of its number."""
    markup = []
    for i, task in enumerate(results.tasks):
        for j, method in enumerate(results.methods):
            entry = results.entries.get((task, method))
            if entry is not None:
                markup.append(_dialog(results, entry, cell_id(i, j)))
    return markup


def _dialog(results: Results, entry: Entry, name: str) -> Markup:
    task, first = entry.task, entry.runs[0].config
    references = [f"{REFERENCES[key]}: {pair[0]:g} to {pair[1]:g}" for key, pair in first.references.items() if pair]
    sessions = [session for run in entry.runs for session in run.config.history]
    facts = {
        "dataset": f"{task.dataset}, content {task.content_sha256}",
        "references": "; ".join(references) or "none",
        "evaluation": _distinct_lines(
            [f"every {t.config.eval_every:,} updates, {t.config.eval_episodes} episodes" for t in entry.runs]
        ),
        "commands": _distinct_lines([run.config.command or "from Python" for run in entry.runs]),
        "versions": _distinct_lines([_key_values(session.versions) for session in sessions]),
        "hardware": _distinct_lines([_hardware(session) for session in sessions]),
        "settings": _distinct_lines([_key_values(t.config.settings) or "none" for t in entry.runs]),
    }
    title = f"{entry.method.label} on {task.name}"
    terms = [part for key, text in facts.items() for part in (tag("dt", key), tag("dd", breakable(text)))]
    close = tag("button", "Close", type="button", class_="close")
    return tag(
        "dialog",
        tag("h3", breakable(title), id=f"{name}-title"),
        _seeds(results, entry),
        tag("dl", *terms),
        close,
        id=name,
        aria_labelledby=f"{name}-title",
    )


def _seeds(results: Results, entry: Entry) -> Markup:
    header = ["seed", "score", "return", "evaluations", "step", "folder"]
    rows = []
    for run in entry.runs:
        score = run.score(entry.task.reference)
        step = f"{run.reached:,}" if run.reached >= run.steps else f"{run.reached:,} of {run.steps:,}"
        cells = [
            str(run.seed),
            f"{score:.2f}" if entry.task.reference else "-",
            f"{run_return(run.evaluations):z.1f}",
            str(len(run.window)),
            step,
        ]
        folder = tag("td", breakable(relative(results, run.files)), class_="name")
        rows.append(tag("tr", *[tag("td", cell, class_="number") for cell in cells], folder))
    head = tag("thead", tag("tr", *[tag("th", text, scope="col") for text in header]))
    return tag("div", tag("table", head, tag("tbody", *rows), class_="plain"), class_="wide", tabindex=0)


def relative(results: Results, run: Run) -> str:
    """Return a run's folder as seen from the folder of all runs, so that a page does not name its machine."""
    root = next(root for root in results.roots if run.folder.is_relative_to(root))
    inside = run.folder.relative_to(root)
    return (inside if len(results.roots) == 1 else _short_names(results.roots)[root] / inside).as_posix()


def _short_names(roots: Sequence[Path]) -> dict[Path, Path]:
    """Return the last parts of each folder, as many as tell the folders apart."""
    parts = [root.resolve().parts for root in roots]
    for count in range(1, max(map(len, parts)) + 1):
        names = [Path(*path[-count:]) for path in parts]
        if len(set(names)) == len(set(parts)):
            break
    return dict(zip(roots, names, strict=True))


def _key_values(values: Mapping[str, object]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _hardware(session: Session) -> str:
    return f"{session.device or 'unknown device'}, {session.precision}; {_key_values(session.hardware)}"


def _distinct_lines(texts: Sequence[str]) -> str:
    return "\n".join(dict.fromkeys(texts))
