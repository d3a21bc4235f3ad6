"""Which runs a report shows: several folders, some datasets and methods; and what it says of a sweep."""

from __future__ import annotations

from pathlib import Path

import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.files import write_json
from offbench.reports.report import _stems
from tests.made_runs import METHODS, made_grid, made_run
from tests.pages import Page, rows

pytestmark = pytest.mark.usefixtures("undrawn")


def scored(
    root: Path, algorithm: str, variant: str, value: float, seeds: int = 2, dataset: str = "x-medium-v0"
) -> None:
    """Write runs whose every return, and so every score, is `value`."""
    for seed in range(seeds):
        made_run(root, dataset, algorithm, variant, seed, 0, returns={30_000: value + seed})


def test_a_title_some_datasets_and_some_methods(home: Path) -> None:
    for dataset in ("x-medium-v0", "x-expert-v0", "y-medium-v0"):
        for algorithm in ("td3_bc", "cql"):
            scored(home / "runs", algorithm, "default", 50, dataset=dataset)
        scored(home / "runs", "bdb", "beta=0.5", 50, dataset=dataset)
    words = ["--datasets", "x-*", "--methods", "td3_bc", "bdb (beta=0.5)", "--title", "Only <x>"]
    main(["report", "--out", "out", *words])
    page = Page(home / "out" / "index.html")
    assert "Only <x>" in page.text
    table = rows(home / "out" / "tables" / "scores.csv")
    assert [row["level"] for row in table] == ["medium", "expert"]
    assert list(table[0])[2:] == ["td3_bc (30,000 steps)", "bdb (beta=0.5) (30,000 steps)"]
    assert "cql" not in page.text
    offbench.report("runs", "one", datasets="x-*", methods="td3_bc")  # one text is one name
    table = rows(home / "one" / "tables" / "scores.csv")
    assert [row["level"] for row in table] == ["medium", "expert"]
    assert list(table[0])[2:] == ["td3_bc (30,000 steps)"]
    with pytest.raises(OffbenchError, match="unknown dataset 'z-\\*': available: x-expert-v0"):
        offbench.report("runs", "out", datasets=["z-*"])
    with pytest.raises(OffbenchError, match="bc has no evaluated runs here"):
        offbench.report("runs", "out", methods=["bc"])


def test_several_folders_are_one_report(home: Path) -> None:
    scored(home / "mine", "td3_bc", "default", 50)
    scored(home / "theirs", "cql", "default", 60)
    page = Page(offbench.report(["mine", "theirs", "mine"], "out"))
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert [row[f"{name} (30,000 steps)"] for name in ("td3_bc", "cql")] == ["50.5 ± 0.7", "60.5 ± 0.7"]
    assert "mine/x-medium-v0/td3_bc/default/seed-0" in page.text
    assert "theirs/x-medium-v0/cql/default/seed-1" in page.text


def test_folders_of_one_name_are_told_apart(home: Path) -> None:
    scored(home / "x" / "runs", "td3_bc", "default", 50)
    scored(home / "y" / "runs", "cql", "default", 60)
    page = Page(offbench.report(["x/runs", "y/runs", "x/runs"], "out"))
    assert "x/runs/x-medium-v0/td3_bc/default/seed-0" in page.text
    assert "y/runs/x-medium-v0/cql/default/seed-1" in page.text
    assert str(home) not in page.text


def test_the_best_variant_of_a_sweep(home: Path) -> None:
    for variant, value in {"alpha=1": 40.0, "alpha=2": 70.0, "alpha=3": 50.0}.items():
        scored(home / "runs", "td3_bc", variant, value)
    scored(home / "runs", "cql", "default", 60)
    page = Page(offbench.report("runs", "out"))
    ((row),) = rows(home / "out" / "tables" / "best.csv")
    assert row["td3_bc"] == "70.5 ± 0.7 (td3_bc (alpha=2), best of 3)"
    assert "cql" not in row
    assert "optimistic" in page.text
    # scores of evaluations at other steps are not ranked
    made_run(home / "runs", "x-medium-v0", "td3_bc", "alpha=4", 0, 0, returns={10_000: 99.0})
    offbench.report("runs", "out")
    assert not (home / "out" / "tables" / "best.csv").exists()


def test_every_table_says_the_scale_and_the_state_of_its_numbers(home: Path) -> None:
    """A row names its reference in each format, returns are called so, and † marks unfinished runs."""
    for dataset, references in {"x-medium-v0": (None, None), "hopper-medium-v0": ([0.0, 100.0], None)}.items():
        for alpha, value in ((1, 40.0), (2, 70.0)):
            variant = f"alpha={alpha}"
            made_run(home / "runs", dataset, "td3_bc", variant, 0, 0, returns={15_000: value}, references=references)
    offbench.report("runs", "out")
    tables = home / "out" / "tables"
    scores = {
        row["environment"]: row["td3_bc (alpha=2) (15,000 of 30,000 steps)"] for row in rows(tables / "scores.csv")
    }
    assert scores == {
        "hopper (own reference)": "70.0 ± ? †",
        "x (no reference: raw return)": "return 70.0 ± ? †",
    }
    best = {row["environment"]: row["td3_bc"] for row in rows(tables / "best.csv")}
    assert best == {
        "hopper (own reference)": "70.0 ± ? † (td3_bc (alpha=2), best of 2)",
        "x (no reference: raw return)": "return 70.0 ± ? † (td3_bc (alpha=2), best of 2)",
    }
    beside = {row["method"]: row["ours (own reference)"] for row in rows(tables / "beside.csv")}
    assert beside["td3_bc (alpha=2) (15,000 of 30,000 steps)"] == "70.0 ± ? †"
    iqms = {row["method"]: row["IQM"] for row in rows(tables / "iqm.csv")}
    assert iqms == {"td3_bc (alpha=1)": "40.0 †", "td3_bc (alpha=2)": "70.0 †"}
    for name in ("scores", "best", "beside", "iqm"):
        assert "† training is not finished" in (tables / f"{name}.md").read_text()


def test_a_similar_score_of_an_earlier_step_or_of_some_runs_says_so(home: Path) -> None:
    found = {"step": 10_000, "samples": 2560, "tolerance": 0.05, "action_tolerance": 0.1, "action_similar": 50.0}
    for seed in range(2):
        run = made_run(home / "runs", "x-medium-v0", "td3_bc", "default", seed, 0, returns={30_000: 50.0})
    path = run.folder / "similarity.json"
    for step, cell in ((30_000, "95.0 ± ? (1 of 2 runs)"), (10_000, "95.0 ± ? (at step 10,000, 1 of 2 runs)")):
        write_json(path, found | {"q_similar": 95.0, "step": step})
        offbench.report("runs", "out")
        ((row),) = rows(home / "out" / "tables" / "similarity.csv")
        assert row["td3_bc"] == cell
    write_json(run.folder.with_name("seed-0") / "similarity.json", found | {"q_similar": 97.0, "step": 30_000})
    offbench.report("runs", "out")
    ((row),) = rows(home / "out" / "tables" / "similarity.csv")
    assert row["td3_bc"] == "not averaged (at steps 10,000 and 30,000)"


def test_a_report_of_an_earlier_step_shows_nothing_later(home: Path) -> None:
    longer, shorter = {10_000: 10.0, 20_000: 20.0, 30_000: 90.0}, {10_000: 15.0, 20_000: 16.0}
    run = made_run(home / "runs", "x-medium-v0", "td3_bc", "default", 0, 0, returns=longer)
    made_run(home / "runs", "x-medium-v0", "bc", "default", 0, 0, steps=20_000, returns=shorter)
    run.mark_diverged(30_500, "critic")
    found = {"step": 30_000, "samples": 2560, "q_similar": 92.5, "action_similar": 50.0}
    write_json(run.folder / "similarity.json", found | {"tolerance": 0.05, "action_tolerance": 0.1})
    assert "92.5" in offbench.report(out="whole").read_text()
    main(["report", "--out", "out", "--steps", "20000"])
    page = Page(home / "out" / "index.html")
    assert "All runs are finished." in page.text
    assert "92.5" not in page.text
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert [row[f"{name} (20,000 steps)"] for name in ("td3_bc", "bc")] == ["15.0 ± ?", "15.5 ± ?"]


def test_the_papers_names_are_for_the_papers_grid(home: Path) -> None:
    made_grid(home / "runs", seeds=2, levels=1)
    page = Page(offbench.report("runs", "out"))
    assert "Scores (the BDB paper's Table 1)" in page.text
    assert "Similar score (the BDB paper's Table 2)" in page.text
    labels = ["td3_bc", "cql", "bdb (beta=0.25)", "bdb (beta=0.5)"]
    page = Page(offbench.report("runs", "out", methods=labels))
    assert len(labels) < len(METHODS)
    assert "paper's Table" not in page.text
    assert "paper's Figure" not in page.text
    assert "“paper” (on the page only): BDB paper, Table 1" in page.text  # its numbers stay


def test_settings_that_names_leave_out_are_said(home: Path) -> None:
    scored(home / "runs", "cql", "bc_steps=120,eval_samples=10", 50)
    page = Page(offbench.report("runs", "out"))
    assert "Settings that differ from the defaults: cql: bc_steps=120, eval_samples=10." in page.text


def test_file_names_of_datasets_are_distinct() -> None:
    assert _stems(["x/2", "x-2", "X", "x 2", "x-2-1"]) == ["x-2", "x-2-1", "x", "x-2-3", "x-2-1-4"]
