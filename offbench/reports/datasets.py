"""The report's datasets: what the runs were trained on, and the shipped cards of the same environments."""

from __future__ import annotations

import base64

from offbench.analysis.results import Results, Task
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, read_json
from offbench.common.tables import Cell, Table
from offbench.common.terminal import warn
from offbench.data import minari_store, transitions
from offbench.envs.recipes import recipes_folder, shipped_recipes
from offbench.reports.markup import Markup, join, tag
from offbench.reports.page import table_html
from offbench.reports.tables import EMPTY

SHOWN = 12  # digits of a content hash, in the cards as here


def dataset_table(results: Results) -> Table:
    """Return the datasets that the runs were trained on, as their config.json names them."""
    rows = []
    for task in results.tasks:
        runs = [run for entry in results.on(task) for run in entry.runs]
        envs = sorted({run.config.env_id for run in runs} - {""})
        references = runs[0].config.references.get("dataset")
        scale = f"{references[0]:,.1f} to {references[1]:,.1f}" if references else "-"
        names = [Cell(task.dataset), Cell(", ".join(envs) or "-")]
        rows.append([*names, *_sizes(task), Cell(scale), Cell(task.content_sha256[:SHOWN])])
    header = ["dataset", "environment", "transitions", "episodes", "mean return", "score 0 to 100", "content"]
    notes = [
        "“content”: the first digits of the SHA-256 over a dataset's arrays, as each run's config.json has it. Sizes "
        "and mean return were read where this report was written; “-”: no dataset of this content was there. “score 0 "
        "to 100”: the returns of the random policy and of the expert that came with the dataset."
    ]
    return Table("datasets", "Datasets that the runs were trained on", header, rows, notes, 2)


def _sizes(task: Task) -> list[Cell]:
    """Return transitions, episodes and mean return of a dataset if it is here with the same content."""
    try:
        recorded = minari_store.read_provenance(minari_store.read_metadata(task.dataset)).content_sha256
        if recorded not in (None, task.content_sha256):
            return [EMPTY] * 3  # recorded again since: not worth a conversion
        data = transitions.load(task.dataset)
    except (OffbenchError, OSError) as error:  # OSError: a name that no file system takes
        if task.dataset in minari_store.local_ids():
            warn(f"the report has no sizes of {task.dataset}: {error}")
        return [EMPTY] * 3
    if data.content_sha256 != task.content_sha256:
        return [EMPTY] * 3
    mean = float(data.returns.mean())
    counts = [Cell(f"{count:,}", count) for count in (len(data), len(data.ends))]
    return [*counts, Cell(f"{mean:,.1f}", mean)]


def cards(results: Results) -> list[Markup]:
    """Return the shipped cards of the environments that occur."""
    markups = (_card(env) for env in dict.fromkeys(task.env_and_level[0] for task in results.tasks))
    return [card for card in markups if card]


def _card(env: str) -> Markup | None:
    """Return an environment's shipped dataset card, None where there is none."""
    if env not in shipped_recipes():
        return None
    folder = recipes_folder() / env
    card, picture = folder / "card.json", folder / "card.png"
    if not card.exists():
        return None
    facts = read_json(card)
    rows = [[Cell(level), *_facts(values)] for level, values in facts["levels"].items()]
    header = ["level", "transitions", "episodes", "mean return", "std", "score", "terminated", "content"]
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    shown = Table(f"card-{env}", f"{env} ({versions})", header, rows)
    parts = [table_html(shown, caption=True, download=False)]
    if picture.exists():
        data = base64.b64encode(picture.read_bytes()).decode()
        alt = f"{env}: learning curve of the behaviour agent, and the histogram of returns of each level"
        parts.append(tag("figure", tag("img", src=f"data:image/png;base64,{data}", alt=alt)))
    return join(*parts)


def _facts(values: JsonObject) -> list[Cell]:
    return [
        *(Cell(f"{values[key]:,}", values[key]) for key in ("transitions", "episodes")),
        *(Cell(f"{values[key]:,.1f}", values[key]) for key in ("return", "std", "score")),
        Cell(f"{100 * values['terminated']:.1f}%", values["terminated"]),
        # the hash of the recording that the statistics describe
        Cell(next(iter(values["content_sha256"].values()))[:SHOWN]),
    ]
