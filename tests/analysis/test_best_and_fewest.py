"""The best score of a dataset is marked, with those that print the same; a row counts what all of its runs have."""

from __future__ import annotations

from pathlib import Path

import pytest

from offbench.analysis.normalize import score_runs
from offbench.analysis.normalize import score_table as terminal_table
from offbench.analysis.results import read_results
from offbench.reports.tables import score_table
from tests.made_runs import made_run


@pytest.mark.parametrize(
    ("scores", "best"),
    [
        ((50.04, 49.96, 49.0), {0, 1}),
        ((49.96, 50.04, 49.94), {0, 1}),
        ((49.0, 50.04, 49.94), {1}),
        ((-3.0, -2.0, -1.0), {2}),
    ],
)
def test_the_best_scores_are_those_that_print_as_the_highest(scores: tuple[float, ...], best: set[int]) -> None:
    for algorithm, score in zip(("td3_bc", "cql", "bdb"), scores, strict=True):
        made_run(Path("runs"), "hopper-medium-v0", algorithm, "default", 0, 0, steps=1000, returns={1000: score})
    rows = score_runs("runs")
    assert [row["score"] for row in rows] == pytest.approx(scores)
    table = terminal_table(rows, terminal=True)
    column = table["header"].index("score")
    assert table["marked"] == {(row, column) for row in best}
    (cells,) = score_table(read_results("runs")).rows
    assert [cell.best for cell in cells[2:]] == [place in best for place in range(3)]


def test_a_dataset_has_a_best_score_of_its_own() -> None:
    scores = {"hopper-random-v0": (10.0, 20.0), "hopper-medium-v0": (60.0, 40.0)}
    for dataset, pair in scores.items():
        for algorithm, score in zip(("td3_bc", "bdb"), pair, strict=True):
            made_run(Path("runs"), dataset, algorithm, "default", 0, 0, steps=1000, returns={1000: score})
    marked = terminal_table(score_runs("runs"), terminal=True)["marked"]
    assert sorted(row for row, _ in marked) == [1, 2]


def test_a_row_counts_the_steps_and_evaluations_that_all_runs_have() -> None:
    """One run has 12 evaluations, of which 10 are scored; the other has three."""
    for seed, count in enumerate((12, 3)):
        returns = dict.fromkeys(range(1000, 1000 * count + 1, 1000), 50.0)
        made_run(Path("runs"), "hopper-medium-v0", "td3_bc", "default", seed, 0, steps=12_000, returns=returns)
    (entry,) = read_results("runs").entries.values()
    assert (entry.reached, entry.steps, entry.evaluations) == (3000, 12_000, 3)
    (row,) = score_runs("runs")
    assert (row["steps"], row["of_steps"], row["evaluations"]) == (3000, 12_000, 3)
