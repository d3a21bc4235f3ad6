"""`report`: a folder of runs as one page to read, and its tables and figures as files.

    index.html   everything, self-contained
    tables/      the same tables: CSV, Markdown, LaTeX
    figures/     the same figures: PNG, SVG

The same runs and local datasets give the same bytes.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from offbench.analysis.results import Folders, Results, read_results
from offbench.common.errors import OffbenchError
from offbench.common.files import read_bytes, read_errors, write_together
from offbench.common.tables import Table, files
from offbench.common.text import counted, from_to, plural
from offbench.reports import figures, tables
from offbench.reports.datasets import cards, dataset_table
from offbench.reports.figures import Figure
from offbench.reports.markup import Markup, join, tag
from offbench.reports.page import GENERATOR, Section, dialogs_html, figures_html, page, relative, table_html
from offbench.reports.similarity import similarity_tables
from offbench.reports.sweep import best_table
from offbench.reports.tables import is_papers_grid, scale

PAGE = "index.html"
LINKS = re.compile(r'href="((?:tables|figures)/[\w.-]+\.\w+)"')  # of the page to its tables and figures
TITLE = "Offline RL benchmark"
STATES = {"unfinished": ("is unfinished", "are unfinished"), "diverged": ("diverged", "diverged")}


def report(
    runs: Folders = "runs",
    out: str | Path = "report",
    *,
    title: str | None = None,
    steps: int | None = None,
    datasets: str | Sequence[str] | None = None,
    methods: str | Sequence[str] | None = None,
) -> Path:
    """Write the report of the runs below one or more folders.

    Args:
        runs: the folder of the run directories, or several; one run is enough, unfinished ones are marked.
        out: the report's folder; an older report in it is replaced.
        title: title of the page.
        steps: show the runs as they were after so many updates; shorter ones as they are.
        datasets: only these, by id or by a pattern such as `hopper-*`.
        methods: only these, by their names in tables.

    Returns:
        The page.

    Raises:
        OffbenchError: no evaluated runs, no such dataset or method, a damaged run, or the folder cannot be written.
    """
    folder = Path(out)
    if folder.suffix.lower() in (".html", ".htm", ".pdf"):
        raise OffbenchError(f"a report is a folder with an {PAGE} in it: give --out {folder.with_suffix('')}")
    results = read_results(runs, steps=steps, datasets=datasets or (), methods=methods or ())
    before = _earlier_files(folder)
    aggregates = tables.iqms(results)
    tables_by_name, figure_groups = _tables(results, aggregates), _figures(results, aggregates)
    written = {f"tables/{one.name}.{end}": data for one in tables_by_name.values() for end, data in files(one).items()}
    for figure in (figure for group in figure_groups.values() for figure in group):
        written |= {f"figures/{figure.name}.png": figure.png, f"figures/{figure.name}.svg": figure.svg}
    content = page(
        title or TITLE, _lead(results), list(_sections(results, tables_by_name, figure_groups)), dialogs_html(results)
    )
    written[PAGE] = content  # written last, so that all its links exist
    write_together({folder / name: data for name, data in written.items()})
    for path in before - {folder / name for name in written}:
        path.unlink(missing_ok=True)
    return folder / PAGE


def _earlier_files(folder: Path) -> set[Path]:
    """Return the files that the page of an older report links to.

    Raises:
        OffbenchError: the folder holds another program's page.
    """
    if folder.exists() and not folder.is_dir():
        raise OffbenchError(f"{folder} is a file; give another --out")
    path = folder / PAGE
    try:
        with read_errors(str(path), "is not a report of offbench", "give another --out"):
            text = read_bytes(path).decode(errors="replace")
            if GENERATOR not in text:
                raise ValueError("it lacks the generator tag of offbench")
    except FileNotFoundError:
        return set()
    return {folder / name for name in LINKS.findall(text)}


def _tables(results: Results, aggregates: tables.Aggregates) -> dict[str, Table]:
    all_tables = [
        *(tables.score_table(results), tables.seed_table(results), dataset_table(results), best_table(results)),
        *(*similarity_tables(results), tables.published_table(results)),
        tables.iqm_table(results, aggregates) if aggregates else None,
        tables.improvement_table(results, aggregates) if len(aggregates) > 1 else None,
    ]
    return {one.name: one for one in all_tables if one}


def _figures(results: Results, aggregates: tables.Aggregates) -> dict[str, list[Figure]]:
    """Return all figures by what they show."""
    styles = figures.line_styles(results.methods)
    rows = [results.on(task) for task in results.tasks]
    stems = _stems([entries[0].task.name for entries in rows])
    groups: dict[str, list[Figure]] = {"curves": [], "finals": [], "beta": [], "q": [], "iqm": []}
    for entries, stem in zip(rows, stems, strict=True):
        groups["curves"].append(figures.curve_figure(entries, styles, f"curves-{stem}"))
        groups["finals"].append(figures.final_figure(entries, styles, f"finals-{stem}"))
        for group, column, label in (("beta", "beta", "β"), ("q", "q_abs", "mean |Q1(s, a)|")):
            if figure := figures.loss_figure(entries, styles, f"{group}-{stem}", column, label):
                groups[group].append(figure)
    if aggregates:
        groups["iqm"] = [figures.iqm_figure(aggregates, styles), figures.profile_figure(aggregates, styles)]
    if len(results.tasks) > 1 and aggregates and (over_all := figures.iqm_curve_figure(results, styles)):
        groups["curves"].append(over_all)
    return groups


def _stems(names: Sequence[str]) -> list[str]:
    """Return a file's stem for each name: safe characters only, each stem once."""
    stems: list[str] = []
    for name in names:
        stem = re.sub(r"[^a-z0-9.-]+", "-", name.lower()).strip("-.") or "task"
        numbered = (f"{stem}-{number}" for number in itertools.count(len(stems)))
        stems.append(stem if stem not in stems else next(name for name in numbered if name not in stems))
    return stems


def _lead(results: Results) -> Markup:
    entries = list(results.entries.values())
    runs = [run for entry in entries for run in entry.runs]
    seeds = {len(entry.runs) for entry in entries}
    states = Counter(run.state for run in runs)
    counts = [
        (f"{len(runs)}", plural(len(runs), "run")),
        (f"{len(results.tasks)}", plural(len(results.tasks), "dataset")),
        (f"{len(results.methods)}", plural(len(results.methods), "method")),
        (from_to(seeds), f"{plural(max(seeds), 'seed')} per cell"),
        (f"{sum(run.reached for run in runs):,}", "updates trained"),
    ]
    tiles = [tag("li", tag("b", value), tag("span", name)) for value, name in counts]
    counted_states = [
        f"{count} of {len(runs)} runs {STATES[name][count > 1]}." for name in STATES if (count := states[name])
    ]
    state = " ".join(counted_states) or "All runs are finished."
    if results.unevaluated:
        state += (
            f" {len(results.unevaluated)} more {'has' if len(results.unevaluated) == 1 else 'have'} no evaluation yet."
        )
    text = f"{scale(results)} {state}"
    return join(tag("p", text, class_="lead"), tag("ul", *tiles, class_="tiles"))


def _sections(
    results: Results, tables_by_name: Mapping[str, Table], figure_groups: Mapping[str, Sequence[Figure]]
) -> Iterator[Section]:
    text = "Click a number to see where it comes from: seeds, commands, versions, hardware. Click a header to sort."
    yield Section("scores", tables_by_name["scores"].title, [table_html(tables_by_name["scores"])], text)
    if "best" in tables_by_name:
        yield Section("best", tables_by_name["best"].title, [table_html(tables_by_name["best"])])
    if "iqm" in tables_by_name:
        parts = [figures_html(figure_groups["iqm"]), table_html(tables_by_name["iqm"])]
        yield Section("aggregate", "Across datasets", parts)
    if "improvement" in tables_by_name:
        yield Section("improvement", "Probability of improvement", [table_html(tables_by_name["improvement"])])
    text = "The BDB paper's Figure 4 shows the same for its datasets." if is_papers_grid(results) else ""
    yield Section("curves", "Learning curves", [figures_html(figure_groups["curves"])], text)
    yield Section("finals", "Final scores, seed by seed", [figures_html(figure_groups["finals"])])
    if "beside" in tables_by_name:
        yield Section("beside", "Published scores", [table_html(tables_by_name["beside"])])
    if "similarity" in tables_by_name:
        more = tag("details", tag("summary", "Both readings"), table_html(tables_by_name["similarity-details"]))
        yield Section(
            "similarity", tables_by_name["similarity"].title, [table_html(tables_by_name["similarity"]), more]
        )
    if figure_groups["beta"]:
        text = "BDB's weight of the discriminator against cloning: 0 is TD3+BC, 1 the discriminator alone."
        yield Section("beta", "Beta over training", [figures_html(figure_groups["beta"])], text)
    if figure_groups["q"]:
        text = "Mean |Q1| on the dataset's own actions. A diverging critic shows here before it shows in the score."
        yield Section("critic", "Critic over training", [figures_html(figure_groups["q"])], text)
    yield Section("datasets", "Datasets", [table_html(tables_by_name["datasets"]), *_shipped(results)])
    summary = f"Show {counted(len(tables_by_name['seeds'].rows), 'run')}"
    every = tag("details", tag("summary", summary), table_html(tables_by_name["seeds"]))
    yield Section("runs", "Every run", [every, _waiting(results)])


def _shipped(results: Results) -> list[Markup]:
    shown = cards(results)
    text = "The complete datasets of the shipped recipes. The runs were trained on the datasets listed above."
    return [tag("h3", "Shipped cards, for reference"), tag("p", text, class_="note"), *shown] if shown else []


def _waiting(results: Results) -> Markup:
    if not results.unevaluated:
        return join()
    names = [tag("li", relative(results, run)) for run in results.unevaluated]
    return join(tag("p", "Runs without an evaluation, and so without a score:"), tag("ul", *names))
