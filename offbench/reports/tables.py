"""The report's tables: scores beside the paper's numbers, and the statistics over tasks."""

from __future__ import annotations

import csv
import dataclasses
import importlib.resources
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TypeAlias

from offbench.analysis.compare import comparable, differences, favored, pair_runs
from offbench.analysis.evaluated_run import window_text
from offbench.analysis.methods import Method, unnamed_settings
from offbench.analysis.results import (
    REFERENCES,
    SHORT_HASH,
    Entry,
    Results,
    Task,
    differing_settings_notes,
    mixed_code,
)
from offbench.analysis.statistics import Estimate, Scores, improvement, iqm, paired
from offbench.common.scores import SCORED_EVALUATIONS, mean_std, plus_minus
from offbench.common.tables import Cell, Table
from offbench.common.text import counted, from_to
from offbench.training.run_config import RunConfig

PAPER = "BDB paper, Table 1"
PAPER_METHODS = {"td3_bc", "cql", *(f"bdb beta={beta}" for beta in ("0.25", "0.50", "0.75", "adaptive"))}
EMPTY = Cell("-")
MARKS = {"unfinished": " †", "diverged": " ‡"}
MARK_NOTES = {
    "unfinished": "† training is not finished: the number is of the steps done so far and may still change.",
    "diverged": "‡ a run became NaN or infinite and stopped: the number is of its evaluations before that.",
}
Aggregates: TypeAlias = Mapping[Method, tuple[Estimate, Scores]]  # a method's IQM, and the scores behind it
FEW_SEEDS = "A task with a single seed has no interval; with few seeds it covers less than 95% (docs/statistics.md)."
DIFFERENT_DATA = (
    "The datasets are not the same: the published numbers are of D4RL's v0 and v2 files, recorded in older "
    "environments by other agents and normalized by D4RL's constants; ours are of the datasets named here. Read them "
    "side by side, not as a reproduction to the decimal."
)


def published(name: str) -> list[dict[str, str]]:
    """Return the rows of a shipped table of published numbers: `scores` or `similarity`."""
    path = importlib.resources.files("offbench.reports") / "published" / f"{name}.csv"
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def is_papers_grid(results: Results) -> bool:
    """Return whether these are the BDB paper's methods, all of them, on datasets of its tables."""
    rows = [row for row in published("scores") if row["source"] == PAPER]
    methods = {method.published for method in results.methods}
    cells = {(row["env"], row["level"]) for row in rows}
    return methods >= PAPER_METHODS and all(task.env_and_level in cells for task in results.tasks)


def score_table(results: Results) -> Table:
    """Return the scores in the layout of the paper's Table 1: a row per dataset, a column per method."""
    paper = {
        (row["env"], row["level"], row["method"]): float(row["normalized_score"])
        for row in published("scores")
        if row["source"] == PAPER
    }
    steps = {method: column_steps(results.of(method)) for method in results.methods}
    seeds, mixed = {len(entry.runs) for entry in results.entries.values()}, mixed_code(results.entries.values())
    rows = []
    for i, task in enumerate(results.tasks):
        env, level = task.env_and_level
        cells, ranked = [], results.comparable(task)
        for j, method in enumerate(results.methods):
            entry = results.entries.get((task, method))
            if entry is None:
                cells.append(EMPTY)
                continue
            more = [] if len(seeds) == 1 else [counted(len(entry.runs), "seed")]
            more += [] if steps[method] else [column_steps([entry])]
            more += [] if ranked else [window_text(entry.runs)]
            number = paper.get((env, level, method.published))
            below = "" if number is None else f"paper {number:g}"
            code = " §" if (task, method.algorithm) in mixed else ""
            cells.append(
                dataclasses.replace(score_cell(entry, ", ".join(more), code), below=below, detail=cell_id(i, j))
            )
        rows.append([*row_name(results, task, scored=True), *(_best(cells) if ranked else cells)])
    has_paper_numbers = any(cell.below for row in rows for cell in row[2:])
    return Table(
        "scores",
        "Scores (the BDB paper's Table 1)" if is_papers_grid(results) else "Scores",
        ["level", "environment", *[method.label for method in results.methods]],
        rows,
        _score_notes(results, seeds, has_paper_numbers),
        heads=2,
        small=["", "", *[steps[method] or "steps differ" for method in results.methods]],
    )


def row_name(results: Results, task: Task, *, scored: bool = False) -> list[Cell]:
    """Return level and environment as a row's name, with dataset or content where the name is ambiguous.

    Args:
        scored: name what the row's scores are normalized by, too, if rows differ in it.
    """
    env, level = task.env_and_level
    namesakes = {other.dataset for other in results.tasks if other.env_and_level == task.env_and_level}
    apart = task.name if len(namesakes) > 1 else task.content_sha256[:SHORT_HASH] if task.ambiguous else ""
    several = scored and len({other.reference for other in results.tasks}) > 1
    more = [apart, REFERENCES[task.reference] if several else ""]
    below = task.dataset if apart != task.name else ""
    return [Cell(level or "-"), Cell(env, below=below, more=", ".join(filter(None, more)))]


def cell_id(task: int, method: int) -> str:
    """Return the id of the dialog with a cell's provenance."""
    return f"cell-{task}-{method}"


def column_steps(entries: Sequence[Entry]) -> str:
    """Return the number of steps of a column's cells, empty if they differ."""
    reached = {(entry.reached, entry.steps) for entry in entries}
    if len(reached) > 1:
        return ""
    ((done, of),) = reached
    return f"{done:,} steps" if done >= of else f"{done:,} of {of:,} steps"


def score_cell(entry: Entry, more: str, code: str = "") -> Cell:
    """Return mean and deviation of an entry's scores, marked if training is not finished or diverged."""
    score = mean_std(entry.scores)
    text = plus_minus(score) + marks(entry.states) + code
    return Cell(text if entry.task.reference else f"return {text}", score[0], more=more)


def marks(states: Collection[str]) -> str:
    """Return the marks of unfinished and diverged runs that follow a number."""
    return "".join(mark for state, mark in MARKS.items() if state in states)


def mark_notes(entries: Iterable[Entry]) -> list[str]:
    """Return a note for each mark that the numbers of these entries have."""
    states = set[str]().union(*(entry.states for entry in entries))
    return [note for state, note in MARK_NOTES.items() if state in states]


def _best(cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells with the highest mean marked, and those that print the same mean."""
    means = [cell.value for cell in cells if cell.value is not None]
    top = f"{max(means):.1f}" if len(means) > 1 else None
    same = [cell.value is not None and f"{cell.value:.1f}" == top for cell in cells]
    return [dataclasses.replace(cell, best=best) for cell, best in zip(cells, same, strict=True)]


def _score_notes(results: Results, seeds: set[int], has_paper_numbers: bool) -> list[str]:
    entries = list(results.entries.values())
    last = from_to({entry.evaluations for entry in entries})
    over = counted(min(seeds), "seed") if len(seeds) == 1 else "the seeds that each cell names"
    single = " “± ?”: a single seed has no standard deviation." if 1 in seeds else ""
    notes = [
        f"Mean ± standard deviation over {over}.{single} A seed's score is the mean of its last "
        f"{SCORED_EVALUATIONS} evaluations, never its best ({last} of them here). {scale(results)} The best mean of a "
        "row is in bold; `offbench compare` tests whether a difference is more than chance.",
    ]
    if not all(results.comparable(task) for task in results.tasks):
        notes.append(
            "In a row whose cells name their evaluations, the scores are of evaluations at different steps: they "
            "cannot be compared, and none is in bold."
        )
    notes += settings_notes(results.methods)
    if has_paper_numbers:
        notes.append(f"“paper” (on the page only): {PAPER} (its settings, 5 seeds, 1M steps). {DIFFERENT_DATA}")
    notes[1:1] = mark_notes(entries)
    if mixed_code(entries):
        notes.insert(
            1, "§ the algorithm's runs in this row were trained by different code, as their config.json says."
        )
    notes += [f"{text[0].upper()}{text[1:]}." for text in differing_settings_notes(entries)]
    if several := _environments_with_several_references(entries):
        notes.append(
            f"The datasets of {', '.join(several)} were recorded with different references: their scores are on "
            "different scales (the table of datasets has them)."
        )
    if any(task.ambiguous for task in results.tasks):
        notes.append(
            "A dataset named twice was recorded again with different content: the first digits of the content's hash, "
            "in brackets, tell them apart."
        )
    return notes


def settings_notes(methods: Sequence[Method]) -> list[str]:
    """Return a note with the settings that the names of the methods leave out; [] if there are none."""
    left_out = unnamed_settings(methods)
    return [f"Settings that differ from the defaults: {'; '.join(left_out)}."] if left_out else []


def _environments_with_several_references(entries: Sequence[Entry]) -> list[str]:
    """Return the environments whose datasets have more than one pair of references."""
    scales: dict[str, set[tuple[float, ...]]] = {}
    for entry in entries:
        for run in entry.runs:
            if entry.task.reference == "dataset":
                scales.setdefault(entry.task.env_and_level[0], set()).add(run.config.references["dataset"] or ())
    return sorted(env for env, pairs in scales.items() if len(pairs) > 1)


def scale(results: Results) -> str:
    """Return what a score of these results means, in a sentence or two."""
    references = {task.reference for task in results.tasks}
    texts = {
        "dataset": "Scores are normalized by each dataset's own reference: 0 is the random policy, 100 the expert.",
        "d4rl": "Scores are normalized by D4RL's constants, measured in older environments: 0 is their random policy, "
        "100 their expert.",
        None: "Datasets without a reference have no score: their rows are raw returns.",
    }
    if len(references) == 1:
        return texts[references.pop()]
    return " ".join([text for key, text in texts.items() if key in references]) + " Each row says which."


def published_table(results: Results) -> Table | None:
    """Return our scores by both references beside every published number; None if nothing is published."""
    numbers: dict[tuple[str, str, str], dict[tuple[str, str], str]] = {}
    for row in published("scores"):
        spread = f" ± {row['std_as_printed']}" if row["std_as_printed"] else ""
        source = (f"{row['source']}, {row['dataset_version']}", row["protocol"])
        key = (row["env"], row["level"], row["method"])
        numbers.setdefault(key, {})[source] = f"{float(row['normalized_score']):g}{spread}"
    entries = results.entries.values()
    pairs = [(e, numbers[p]) for e in entries if (p := (*e.task.env_and_level, e.method.published)) in numbers]
    sources = list(dict.fromkeys(source for _, published_scores in pairs for source in published_scores))
    if not pairs:
        return None
    rows = []
    for entry, published_scores in pairs:
        ours = [entry.mean_std(reference) for reference in ("dataset", "d4rl")]
        cells = [Cell(plus_minus(pair) + marks(entry.states), pair[0]) if pair else EMPTY for pair in ours]
        cells += [
            Cell(text, float(text.split()[0])) if (text := published_scores.get(source)) else EMPTY
            for source in sources
        ]
        rows.append([*row_name(results, entry.task), Cell(entry.method.label, more=column_steps([entry])), *cells])
    header = ["level", "environment", "method", "ours", "ours", *[source for source, _ in sources]]
    small = ["", "", "", "own reference", "D4RL's constants", *[protocol for _, protocol in sources]]
    notes = [
        DIFFERENT_DATA,
        "The deviations of published scores are those of their sources, and so are the settings.",
        *settings_notes(results.methods),
        *mark_notes(entry for entry, _ in pairs),
    ]
    return Table("beside", "Our scores and published scores", header, rows, notes, 3, small)


def iqms(results: Results) -> Aggregates:
    """Return each method's IQM over the tasks that it has and that have a reference."""
    scores = {method: results.scores(method) for method in results.methods}
    return {method: (iqm(by_task), by_task) for method, by_task in scores.items() if by_task}


def iqm_table(results: Results, aggregates: Aggregates) -> Table:
    """Return the IQM of every method with its interval."""
    rows = []
    for method, (estimate, scores) in aggregates.items():
        runs = sum(len(values) for values in scores.values())
        numbers = [Cell("-" if end is None else f"{end:.1f}", end) for end in (estimate.low, estimate.high)]
        counts = [Cell(f"{count}", count) for count in (len(scores), runs)]
        states = set[str]().union(*(entry.states for entry in results.of(method)))
        rows.append(
            [Cell(method.label), Cell(f"{estimate.value:.1f}{marks(states)}", estimate.value), *numbers, *counts]
        )
    notes = [
        "Interquartile mean of the normalized scores of all runs of all tasks (the mean without the lowest and "
        "highest quarter), and its 95% interval by stratified bootstrap: seeds are resampled within each "
        f"task (Agarwal et al. 2021). {FEW_SEEDS}",
    ]
    if len({tuple(scores) for _, scores in aggregates.values()}) > 1:
        notes.append("The methods were not run on the same tasks, so their IQMs cannot be compared.")
    if not all(results.comparable(task) for task in results.tasks):
        notes.append(
            "On some tasks the scores are of evaluations at different steps (the table of scores says which): the "
            "IQMs cannot be compared."
        )
    if len({task.reference for task in results.tasks if task.reference}) > 1:
        notes.append("The tasks' scores are normalized by different references (the table of scores says which).")
    notes += mark_notes(entry for method in aggregates for entry in results.of(method))
    header = ["method", "IQM", "95% low", "95% high", "tasks", "runs"]
    return Table("iqm", "Interquartile mean over tasks", header, rows, notes)


def improvement_table(results: Results, aggregates: Aggregates) -> Table:
    """Return the probability that a run of the row's method beats one of the column's, over their common tasks."""
    methods = list(aggregates)
    chances: dict[tuple[Method, Method], Estimate] = {}
    better: set[tuple[Method, Method]] = set()
    for i, a in enumerate(methods):
        for b in methods[i + 1 :]:
            if set(aggregates[a][1]) & set(aggregates[b][1]):
                chances[a, b] = estimate = improvement(aggregates[a][1], aggregates[b][1])
                ends = (None if end is None else 1 - end for end in (estimate.high, estimate.low))
                chances[b, a] = Estimate(1 - estimate.value, *ends)
                sign = _favored(results, a, b)
                better |= {(a, b)} if sign > 0 else {(b, a)} if sign < 0 else set()
    rows = [[Cell(a.label), *[_chance(chances.get((a, b)), (a, b) in better) for b in methods]] for a in methods]
    notes = [
        "Probability in percent that a run of the row's method scores above one of the column's, averaged over the "
        f"tasks that both have, with its 95% interval by stratified bootstrap. 50 is a draw. {FEW_SEEDS} An interval "
        "above 50 is therefore no evidence by itself. Bold: `offbench compare` finds the row's method better, as the "
        "interval of the paired difference and the sign-flip test agree. Each pair is tested by itself, so some of "
        "many equal pairs are bold by chance. A pair with evaluations at different steps is not tested.",
    ]
    title = "Probability of improvement"
    return Table("improvement", title, ["row above column", *[method.label for method in methods]], rows, notes)


def _favored(results: Results, a: Method, b: Method) -> int:
    """Return 1 if `compare` finds A better on the tasks that have scores, -1 for B, 0 for no evidence."""
    groups = ([entry for entry in results.of(method) if entry.task.reference] for method in (a, b))
    both = pair_runs(*groups)
    return favored(paired(differences(both))) if both and comparable(both) else 0


def _chance(estimate: Estimate | None, better: bool) -> Cell:
    if estimate is None:
        return EMPTY
    in_percent = estimate.percent()
    text = f"{in_percent.value:.0f}"
    if in_percent.low is not None:
        text += f" [{in_percent.low:.0f}, {in_percent.high:.0f}]"
    return Cell(text, in_percent.value, best=better)


def seed_table(results: Results) -> Table:
    """Return every run with its score and how far it is."""
    rows = []
    for entry in results.entries.values():
        for run in entry.runs:
            score, ret = run.score(entry.task.reference), run.score(None)
            rows.append(
                [
                    Cell(entry.task.name),
                    Cell(entry.method.label),
                    Cell(str(run.seed), run.seed),
                    Cell(f"{score:.2f}", score) if entry.task.reference else EMPTY,
                    Cell(f"{ret:.2f}", ret),
                    Cell(REFERENCES[entry.task.reference]),
                    Cell(str(len(run.window)), len(run.window)),
                    Cell(f"{run.reached:,}", run.reached),
                    Cell(f"{run.steps:,}", run.steps),
                    Cell(run.state),
                ]
            )
    for waiting in results.unevaluated:
        config = waiting.config()
        texts = [_waiting_name(results, config), f"{config.algorithm} {config.variant}".removesuffix(" default")]
        seed, steps = Cell(str(config.seed), config.seed), Cell(f"{config.steps:,}", config.steps)
        numbers = [seed, *[EMPTY] * 3, *[Cell("0", 0)] * 2, steps]
        rows.append([*map(Cell, texts), *numbers, Cell("diverged" if waiting.diverged else "not evaluated yet")])
    header = ["dataset", "method", "seed", "score", "return", "reference", "evaluations", "step", "of", "state"]
    return Table("seeds", "Every run", header, rows, [], 3)


def _waiting_name(results: Results, config: RunConfig) -> str:
    """Return a dataset's id, with its content's first digits where the id alone is ambiguous."""
    contents = {task.content_sha256 for task in results.tasks if task.dataset == config.dataset}
    ambiguous = bool(contents) and contents != {config.dataset_sha256}
    return Task(config.dataset, config.dataset_sha256, None, ambiguous).name
