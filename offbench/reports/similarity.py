"""The report's similar score (the paper's Table 2): how often a policy's action counts as the dataset's."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

from offbench.analysis.methods import Method
from offbench.analysis.results import Entry, Results
from offbench.common.errors import OffbenchError
from offbench.common.scores import mean_std, plus_minus
from offbench.common.tables import Cell, Table
from offbench.common.terminal import warn
from offbench.common.text import counted, plural
from offbench.evaluation.similarity import Similarity, read_similarity
from offbench.reports.tables import EMPTY, is_papers_grid, published, row_name


def similarity_tables(results: Results) -> list[Table]:
    """Return the similar scores and their details, from the runs' similarity.json; [] if there is none."""
    paper = {(r["env"], r["level"], r["method"]): r["similar_score_percent"] for r in published("similarity")}
    similar = {key: values for key, entry in results.entries.items() if (values := _similar(entry))}
    methods = [method for method in results.methods if any(key[1] == method for key in similar)]
    differ = len({value.tolerance for values in similar.values() for value in values}) > 1
    rows, details = [], []
    for task in results.tasks:
        env, level = task.env_and_level
        cells = []
        for method in methods:
            if (task, method) not in similar:
                cells.append(EMPTY)
                continue
            number = paper.get((env, level, _similar_name(method)))
            values = similar[task, method]
            cells.append(_similar_cell(results.entries[task, method], values, number, differ))
            for group in _by_tolerances(values):
                details.append([*row_name(results, task), *_similar_row(method, group, number)])
        if any(cell is not EMPTY for cell in cells):
            rows.append([*row_name(results, task), *cells])
    if not rows:
        return []
    has_paper_numbers = any(cell.below for row in rows for cell in row[2:])
    notes = [
        "Percent of sampled transitions on which the policy's action counts as the dataset's, mean ± standard "
        "deviation over seeds: |Q1(s, π(s)) - Q1(s, a)| at most the tolerance times |Q1(s, a)|. The paper gives no "
        "formula; this reading of its Table 2 is ours."
        + (" “paper” (on the page only): its printed number, on D4RL's v0 datasets." if has_paper_numbers else "")
    ]
    if differ:
        notes.append(
            "The tolerances differ between runs. Scores with different tolerances are neither comparable nor averaged."
        )
    if any(" step" in cell.more for row in rows for cell in row[2:]):
        notes.append(
            "A cell that names a step is of an earlier checkpoint than its runs' newest; `offbench evaluate RUN "
            "--similarity` computes it again."
        )
    header = ["level", "environment", *[method.label for method in methods]]
    columns = ["level", "environment", "method", "by Q (%)", "by action (%)", "paper (%)", "seeds", "step", "samples"]
    title = "Similar score (the BDB paper's Table 2)" if is_papers_grid(results) else "Similar score"
    return [
        Table("similarity", title, header, rows, notes, 2),
        Table("similarity-details", "Similar score in both readings", [*columns, "tolerances"], details, [], 3),
    ]


def _similar(entry: Entry) -> list[Similarity]:
    """Return the similar scores of the runs of a cell, as far as shown; damaged ones are named on stderr."""
    scores = []
    for run in entry.runs:
        try:
            score = read_similarity(run.files)
        except OffbenchError as error:
            warn(f"left out of the similar scores: {error}")
            continue
        if score is not None and score.step <= run.steps:
            scores.append(score)
    return scores


def _similar_name(method: Method) -> str:
    return "bdb beta=0.00 (td3_bc)" if method.published in ("td3_bc", "bdb beta=0.00") else method.published


def _by_tolerances(values: Sequence[Similarity]) -> list[list[Similarity]]:
    """Return the runs' similar scores in groups of the same tolerances."""

    def tolerances(value: Similarity) -> tuple[float, float]:
        return value.tolerance, value.action_tolerance

    return [list(group) for _, group in itertools.groupby(sorted(values, key=tolerances), tolerances)]


def _similar_cell(entry: Entry, values: Sequence[Similarity], number: str | None, differ: bool) -> Cell:
    """Return the mean by Q, or that there is none because the runs' tolerances or steps differ.

    Args:
        values: the similar scores of the runs of `entry` that have one.
        differ: whether tolerances differ within the table.
    """
    tolerances, steps = (sorted({getattr(value, key) for value in values}) for key in ("tolerance", "step"))
    more = [f"tolerance {' and '.join(f'{t:g}' for t in tolerances)}"] if differ else []
    if steps != sorted({run.reached for run in entry.runs}):
        more.append(f"at {plural(len(steps), 'step')} {' and '.join(f'{step:,}' for step in steps)}")
    if len(values) < len(entry.runs):
        more.append(f"{len(values)} of {counted(len(entry.runs), 'run')}")
    cell = Cell("not averaged", below=f"paper {number}" if number else "", more=", ".join(more))
    if len(tolerances) > 1 or len(steps) > 1:
        return cell
    by_q = mean_std([value.q_similar for value in values])
    return dataclasses.replace(cell, text=plus_minus(by_q), value=by_q[0])


def _similar_row(
    method: Method,
    values: Sequence[Similarity],
    number: str | None,
) -> list[Cell]:
    by_q, by_action = (mean_std([getattr(v, key) for v in values]) for key in ("q_similar", "action_similar"))
    steps, samples = (sorted({getattr(v, key) for v in values}) for key in ("step", "samples"))
    numbers = [Cell(", ".join(f"{n:,}" for n in ns), ns[0]) for ns in (steps, samples)]
    return [
        Cell(method.label),
        Cell(plus_minus(by_q), by_q[0]),
        Cell(plus_minus(by_action), by_action[0]),
        Cell(number, float(number)) if number else EMPTY,
        Cell(str(len(values)), len(values)),
        *numbers,
        Cell(f"Q {values[0].tolerance:g}, action {values[0].action_tolerance:g}"),
    ]
