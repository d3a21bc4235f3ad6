"""The report's tables: the paper's Tables 1 and 2 with our numbers, and the statistics over tasks."""

from __future__ import annotations

import csv
import dataclasses
import importlib.resources
from collections.abc import Mapping, Sequence

from offbench.reports.layout import Cell, Table
from offbench.results import REFERENCES, Entry, Method, Results
from offbench.scores import LAST, mean_std
from offbench.statistics import Estimate, Scores, improvement, iqm

PAPER = "BDB paper, Table 1"
NONE = Cell("-")
DIFFERENT_DATA = (
    "The datasets are not the same: the published numbers are of D4RL's v0 and v2 files, recorded in older "
    "environments by other agents and normalised by D4RL's constants; ours are of the datasets named here. Read them "
    "side by side, not as a reproduction to the decimal."
)


def published(name: str) -> list[dict[str, str]]:
    """Return the rows of a shipped table of published numbers: `scores` or `similarity`."""
    path = importlib.resources.files("offbench.reports") / "published" / f"{name}.csv"
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def plus_minus(found: tuple[float, float | None], digits: int = 1) -> str:
    """Return `mean ± std`; one seed has no spread, and the text says so."""
    mean, std = found
    return f"{mean:.{digits}f} ± " + ("?" if std is None else f"{std:.{digits}f}")


def score_table(results: Results) -> Table:
    """Return Table 1 in the paper's layout: a row a dataset, a column a method."""
    paper = {
        (row["env"], row["level"], row["method"]): float(row["normalized_score"])
        for row in published("scores")
        if row["source"] == PAPER
    }
    steps = {method: column_steps(results.of(method)) for method in results.methods}
    seeds = {len(entry.runs) for entry in results.entries.values()}
    rows = []
    for i, task in enumerate(results.tasks):
        env, level = task.place
        cells = []
        for j, method in enumerate(results.methods):
            entry = results.entries.get((task, method))
            if entry is None:
                cells.append(NONE)
                continue
            more = [] if len(seeds) == 1 else [_seeds(len(entry.runs))]
            more += [] if steps[method] else [column_steps([entry])]
            number = paper.get((env, level, method.published))
            below = "" if number is None else f"paper {number:g}"
            cells.append(_score_cell(entry, below, cell_id(i, j), ", ".join(more)))
        below_row = "" if len({t.reference for t in results.tasks}) == 1 else REFERENCES[task.reference]
        rows.append(
            [Cell(level or "-"), Cell(env, below=" · ".join(filter(None, [task.name, below_row]))), *_best(cells)]
        )
    return Table(
        "scores",
        "Table 1: normalised scores",
        ["level", "environment", *[method.label for method in results.methods]],
        rows,
        _score_notes(results, seeds),
        heads=2,
        small=["", "", *[steps[method] or "steps differ" for method in results.methods]],
    )


def cell_id(task: int, method: int) -> str:
    """Return the id of the box with a cell's provenance."""
    return f"cell-{task}-{method}"


def column_steps(entries: Sequence[Entry]) -> str:
    """Return the number of steps of a column's cells, empty if they differ."""
    reached = {(entry.reached, entry.steps) for entry in entries}
    if len(reached) > 1:
        return ""
    ((done, of),) = reached
    return f"{done:,} steps" if done >= of else f"{done:,} of {of:,} steps"


def _score_cell(entry: Entry, below: str, detail: str, more: str) -> Cell:
    found = mean_std(entry.scores)
    marks = [mark for state, mark in (("unfinished", " †"), ("diverged", " ‡")) if state in entry.states]
    text = plus_minus(found) + "".join(marks)
    return Cell(text if entry.task.reference else f"return {text}", found[0], below, detail=detail, more=more)


def _best(cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells with the highest mean marked, and those that print the same mean."""
    known = [cell.value for cell in cells if cell.value is not None]
    top = f"{max(known):.1f}" if len(known) > 1 else None
    same = [cell.value is not None and f"{cell.value:.1f}" == top for cell in cells]
    return [dataclasses.replace(cell, best=best) for cell, best in zip(cells, same, strict=True)]


def _seeds(count: int) -> str:
    return f"{count} seed" if count == 1 else f"{count} seeds"


def _score_notes(results: Results, seeds: set[int]) -> list[str]:
    entries = list(results.entries.values())
    behind = sorted({entry.evaluations for entry in entries})
    last = f"{behind[0]}" if len(behind) == 1 else f"{behind[0]} to {behind[-1]}"
    over = _seeds(seeds.copy().pop()) if len(seeds) == 1 else "the seeds that each cell names"
    notes = [
        f"Mean ± standard deviation over {over} (? where one seed has none). A seed's score is the mean of its last "
        f"{LAST} evaluations, never its best ({last} of them here). {scale(results)} Best mean of a row in bold.",
        f"“paper”: {PAPER} (5 seeds, 1M steps). {DIFFERENT_DATA}",
    ]
    states = set().union(*(entry.states for entry in entries))
    if "diverged" in states:
        notes.insert(1, "‡ a run became NaN or infinite and stopped: the number is of its evaluations before that.")
    if "unfinished" in states:
        notes.insert(1, "† training is not finished: the number is of the steps done so far and may still change.")
    if any(task.twin for task in results.tasks):
        notes.append(
            "A dataset named twice was recorded twice with different content; its first digits tell them apart."
        )
    return notes


def scale(results: Results) -> str:
    """Return what a score of these results means, in a sentence or two."""
    known = {task.reference for task in results.tasks}
    words = {
        "dataset": "Scores are normalised by each dataset's own reference: 0 is the random policy, 100 the expert.",
        "d4rl": "Scores are normalised by D4RL's constants, measured in older environments: 0 is their random policy, "
        "100 their expert.",
        None: "Datasets without a reference have no score: their rows are raw returns.",
    }
    if len(known) == 1:
        return words[known.pop()]
    return " ".join([text for key, text in words.items() if key in known]) + " Each row says which."


def beside_table(results: Results) -> Table | None:
    """Return our scores by both references beside every published number; None if nothing is published."""
    numbers: dict[tuple[str, str, str], dict[tuple[str, str], str]] = {}
    for row in published("scores"):
        spread = f" ± {row['std_as_printed']}" if row["std_as_printed"] else ""
        source = (f"{row['source']}, {row['dataset_version']}", row["protocol"])
        place = (row["env"], row["level"], row["method"])
        numbers.setdefault(place, {})[source] = f"{float(row['normalized_score']):g}{spread}"
    known = [(e, numbers[p]) for e in _in_order(results) if (p := (*e.task.place, e.method.published)) in numbers]
    sources = list(dict.fromkeys(source for _, found in known for source in found))
    if not known:
        return None
    rows = []
    for entry, found in known:
        ours = [entry.mean_std(reference) for reference in ("dataset", "d4rl")]
        cells = [Cell(plus_minus(pair), pair[0]) if pair else NONE for pair in ours]
        cells += [Cell(text, float(text.split()[0])) if (text := found.get(source)) else NONE for source in sources]
        env, level = entry.task.place
        rows.append([Cell(level), Cell(env), Cell(entry.method.label), *cells])
    header = ["level", "environment", "method", "ours", "ours", *[source for source, _ in sources]]
    small = ["", "", "", "own reference", "D4RL's constants", *[protocol for _, protocol in sources]]
    notes = [DIFFERENT_DATA, "Deviations of published numbers are as printed there."]
    return Table("beside", "Ours beside published numbers", header, rows, notes, 3, small)


def iqms(results: Results) -> dict[Method, tuple[Estimate, Scores]]:
    """Return each method's IQM over the tasks that it has and that have a reference."""
    scores = {method: results.scores(method) for method in results.methods}
    return {method: (iqm(found), found) for method, found in scores.items() if found}


def iqm_table(results: Results, found: Mapping[Method, tuple[Estimate, Scores]]) -> Table:
    """Return the IQM of every method with its interval."""
    rows = []
    for method, (estimate, scores) in found.items():
        runs = sum(len(values) for values in scores.values())
        numbers = [Cell("-" if end is None else f"{end:.1f}", end) for end in (estimate.low, estimate.high)]
        counts = [Cell(f"{count}", count) for count in (len(scores), runs)]
        rows.append([Cell(method.label), Cell(f"{estimate.value:.1f}", estimate.value), *numbers, *counts])
    notes = [
        "Interquartile mean of the normalised scores of all runs of all tasks (the mean without the lowest and "
        "highest quarter), and its 95% interval by stratified bootstrap: seeds are resampled within each "
        "task (Agarwal et al. 2021). No interval where a task has a single seed; "
        "with few seeds it covers less than 95% (docs/statistics.md).",
    ]
    if len({tuple(scores) for _, scores in found.values()}) > 1:
        notes.append("The methods were not run on the same tasks: their IQMs do not compare one with another.")
    if len({entry.reached for entry in results.entries.values()}) > 1:
        notes.append("Not all runs have trained for the same number of steps: Table 1 says how many.")
    header = ["method", "IQM", "95% low", "95% high", "tasks", "runs"]
    return Table("iqm", "Interquartile mean over tasks", header, rows, notes)


def improvement_table(found: Mapping[Method, tuple[Estimate, Scores]]) -> Table:
    """Return the probability that a run of the row's method beats one of the column's, over their common tasks."""
    methods = list(found)
    known: dict[tuple[Method, Method], Estimate] = {}
    for i, a in enumerate(methods):
        for b in methods[i + 1 :]:
            if set(found[a][1]) & set(found[b][1]):
                known[a, b] = estimate = improvement(found[a][1], found[b][1])
                ends = (None if end is None else 1 - end for end in (estimate.high, estimate.low))
                known[b, a] = Estimate(1 - estimate.value, *ends)
    rows = [[Cell(a.label), *[_chance(known.get((a, b))) for b in methods]] for a in methods]
    notes = [
        "Probability in percent that a run of the row's method scores above one of the column's, averaged over the "
        "tasks that both have, with its 95% interval by stratified bootstrap. 50 is a draw; bold: the interval lies "
        "above 50.",
    ]
    title = "Probability of improvement"
    return Table("improvement", title, ["row above column", *[method.label for method in methods]], rows, notes)


def _chance(estimate: Estimate | None) -> Cell:
    if estimate is None:
        return NONE
    in_percent = estimate.percent()
    text = f"{in_percent.value:.0f}"
    if in_percent.low is not None:
        text += f" [{in_percent.low:.0f}, {in_percent.high:.0f}]"
    return Cell(text, in_percent.value, best=in_percent.low is not None and in_percent.low > 50)


def seed_table(results: Results) -> Table:
    """Return every run with its score and how far it is."""
    rows = []
    for entry in _in_order(results):
        for trained in entry.runs:
            score, ret = trained.score(entry.task.reference), trained.score(None)
            rows.append(
                [
                    Cell(entry.task.name),
                    Cell(entry.method.label),
                    Cell(str(trained.seed), trained.seed),
                    Cell(f"{score:.2f}", score) if entry.task.reference else NONE,
                    Cell(f"{ret:.2f}", ret),
                    Cell(REFERENCES[entry.task.reference]),
                    Cell(str(min(len(trained.evaluations), LAST)), min(len(trained.evaluations), LAST)),
                    Cell(f"{trained.reached:,}", trained.reached),
                    Cell(f"{trained.steps:,}", trained.steps),
                    Cell(trained.state),
                ]
            )
    for run in results.waiting:
        config = run.config()
        words = [str(config["dataset"]), f"{config['algorithm']} {config['variant']}".removesuffix(" default")]
        numbers = [
            Cell(str(config["seed"])),
            NONE,
            NONE,
            NONE,
            Cell("0", 0),
            Cell("0", 0),
            Cell(f"{config['steps']:,}"),
        ]
        rows.append([*map(Cell, words), *numbers, Cell("diverged" if run.diverged else "not evaluated yet")])
    header = ["dataset", "method", "seed", "score", "return", "reference", "evaluations", "step", "of", "state"]
    return Table("seeds", "Every run", header, rows, [], 3)


def _in_order(results: Results) -> list[Entry]:
    keys = ((task, method) for task in results.tasks for method in results.methods)
    return [results.entries[key] for key in keys if key in results.entries]
