"""The report of made-up runs: every part is there, every name is text, and the same runs give the same bytes."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from matplotlib import rc_context

import offbench
from offbench.analysis.methods import EXTENSION_SETTINGS, Method
from offbench.analysis.results import Task, read_results
from offbench.cli.main import main
from offbench.common.files import write_json
from offbench.common.settings import fields
from offbench.evaluation.similarity import similarity
from offbench.reports.tables import published
from offbench.training.former_settings import MOVED
from offbench.training.registry import load_algorithm
from tests.made_runs import METHODS, made_grid, made_run
from tests.pages import Page, rows

# settings of a user's matplotlibrc
USERS_STYLE = {"axes.facecolor": "black", "lines.linewidth": 9, "savefig.bbox": "tight", "figure.dpi": 30}


def test_a_whole_grid(home: Path) -> None:
    made_grid(home / "runs", seeds=3, levels=2)
    page = Page(offbench.report(home / "runs", home / "out"))
    for section in (
        "scores",
        "aggregate",
        "improvement",
        "curves",
        "finals",
        "beside",
        "similarity",
        "beta",
        "critic",
    ):
        assert section in page.ids
    assert len(page.ids) == len(set(page.ids))
    links = [a["href"] or "" for name, a in page.elements if name == "a"]
    inside = [link for link in links if not link.startswith("#")]
    assert inside
    assert all((home / "out" / link).is_file() for link in inside)
    assert {link[1:] for link in links if link.startswith("#")} <= set(page.ids)
    boxes = [a["data-box"] for name, a in page.elements if name == "button" and "data-box" in a]
    assert len(boxes) == len(set(boxes)) == 2 * len(METHODS)
    assert set(boxes) <= set(page.ids)
    assert "The datasets are not the same" in page.text
    assert "over 3 seeds" in page.text
    stems = {path.stem for path in (home / "out" / "figures").iterdir()}
    assert {"iqm", "profiles", "curves-iqm", "curves-hopper-random-v0", "beta-hopper-random-v0"} <= stems
    for stem in stems:
        assert (home / "out" / "figures" / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in (home / "out" / "figures" / f"{stem}.svg").read_bytes()


def test_the_score_table_by_hand(home: Path) -> None:
    for seed, value in enumerate((40.0, 50.0, 90.0)):
        made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", seed, 0, returns={30_000: value})
    adaptive, returns = {"beta": "adaptive"}, {30_000: 70.0}
    made_run(home / "runs", "hopper-medium-v0", "bdb", "default", 0, 0, settings=adaptive, returns=returns)
    offbench.report(home / "runs", home / "out")
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert row["level"] == "medium"
    assert row["environment"] == "hopper"
    assert (
        row["td3_bc (30,000 steps)"] == "60.0 ± 26.5 (3 seeds)"
    )  # deviation of 40, 50, 90: sqrt((400 + 100 + 900) / 2)
    assert row["bdb (adaptive) (30,000 steps)"] == "70.0 ± ? (1 seed)"
    latex = (home / "out" / "tables" / "scores.tex").read_text()
    assert r"60.0 $\pm$ 26.5 (3 seeds) & \textbf{70.0 $\pm$ ? (1 seed)}" in latex
    assert "**70.0 ± ? (1 seed)**" in (home / "out" / "tables" / "scores.md").read_text()
    # D4RL's reference of the made runs is -10 to 190: a return of 70 is 100 * 80 / 200
    beside = {row["method"]: row for row in rows(home / "out" / "tables" / "beside.csv")}
    assert beside["bdb (adaptive) (30,000 steps)"]["ours (D4RL's constants)"] == "40.0 ± ?"
    paper = "BDB paper, Table 1, v0 (5 seeds, mean of last 10 evaluations, 1M steps)"
    assert beside["bdb (adaptive) (30,000 steps)"][paper] == "100.16 ± 0.02"
    page = (home / "out" / "index.html").read_text()
    assert "paper 100.16" in page
    assert ">3 seeds<" in page
    assert ">1 seed<" in page


def test_scores_of_different_evaluations_are_not_ranked(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One run is scored over four evaluations, the other over its first alone; bold would say which is better."""
    for dataset, steps in {"hopper-medium-v0": (500,), "hopper-expert-v0": (500, 1000, 1500, 2000)}.items():
        for seed in range(6):
            rising = {step: 10.0 + step / 100 for step in (500, 1000, 1500, 2000)}
            made_run(home / "runs", dataset, "td3_bc", "default", seed, 0, returns=rising)
            made_run(home / "runs", dataset, "bc", "default", seed, 0, returns=dict.fromkeys(steps, 90.0))
    offbench.report(home / "runs", home / "out")
    medium, expert = [line for line in (home / "out/tables/scores.md").read_text().splitlines() if "hopper" in line]
    assert "**" not in medium
    assert "4 evaluations, steps 500 to 2,000" in medium
    assert "1 evaluation, step 500" in medium
    assert "**90.0 ± 0.0" in expert
    assert "evaluations" not in expert
    # six seeds on two datasets would be evidence
    assert "**" not in (home / "out/tables/improvement.md").read_text().partition("Probability in percent")[0]
    found = offbench.compare("bc", "td3_bc")
    assert "different steps" in found.verdict
    assert not found.row()["comparable"]
    main(["normalize"])
    (note,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note")]
    assert "hopper-medium-v0" in note
    assert "hopper-expert-v0" not in note
    main(["normalize", "--format", "json"])
    windows = {(row["dataset"], row["algorithm"]): row["window"] for row in json.loads(capsys.readouterr().out)}
    assert windows["hopper-medium-v0", "bc"] == "500"
    assert windows["hopper-medium-v0", "td3_bc"] == "500 1000 1500 2000"


def test_tasks_and_methods_in_the_papers_order(home: Path) -> None:
    for dataset in ("walker2d-medium-v0", "hopper-expert-v0", "hopper-medium-v0", "hopper-random-v0", "a-random-v0"):
        made_run(home / "runs", dataset, "bc", "default", 0, 50)
    for algorithm, variant, settings, _ in METHODS:
        made_run(home / "runs", "hopper-medium-v0", algorithm, variant, 0, 50, settings=settings)
    results = read_results(home / "runs")
    levels = ["hopper-random-v0", "a-random-v0", "hopper-medium-v0", "walker2d-medium-v0", "hopper-expert-v0"]
    assert [task.dataset for task in results.tasks] == levels
    labels = ["td3_bc", "cql", "bdb (beta=0.25)", "bdb (beta=0.5)", "bdb (beta=0.75)", "bdb (adaptive)", "bc"]
    assert [method.label for method in results.methods] == labels


@pytest.mark.parametrize(
    ("dataset", "place"),
    [
        ("hopper-medium-replay-v0", ("hopper", "medium-replay")),
        ("hopper-medium-expert-v0", ("hopper", "medium-expert")),
        ("mujoco/walker2d/medium-expert-v0", ("walker2d", "medium-expert")),
        ("inverted-pendulum-medium-v3", ("inverted-pendulum", "medium")),
        ("hopper-60percent-v0", ("hopper", "60percent")),
        ("hopper-12p5percent-v0", ("hopper", "12p5percent")),
        ("mujoco/hopper/expert-v0", ("hopper", "expert")),
        ("my-data-v0", ("my-data", "")),
    ],
)
def test_environment_and_level_of_a_dataset(dataset: str, place: tuple[str, str]) -> None:
    assert Task(dataset, "", None).env_and_level == place


def test_the_published_numbers_are_found_by_method() -> None:
    assert Method("bdb", "beta=0.5", "0.50").published == "bdb beta=0.50"
    known = {row["method"] for row in published("scores")}
    assert Method("bdb", "beta_max=0.5", "adaptive").published == ""  # no paper has it
    options = fields(load_algorithm("bdb_plus").Config)
    extensions = {name for name, field in options.items() if field.metadata["help"].startswith("ours")}
    assert extensions == MOVED.keys() < EXTENSION_SETTINGS
    assert {"td3_bc", "cql", "bdb beta=0.50", "bdb beta=adaptive"} <= known
    assert Method("bdb", "hidden=8x8", "adaptive").label == "bdb (adaptive, hidden=8x8)"


def test_one_run_of_one_seed(home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    page = Page(offbench.report(run.folder, home / "out"))  # the run's own folder will do
    assert "scores" in page.ids
    assert "improvement" not in page.ids
    assert "± ?" in page.text
    ((row),) = rows(home / "out" / "tables" / "iqm.csv")
    assert (row["95% low"], row["tasks"], row["runs"]) == ("-", "1", "1")


def test_runs_without_references_show_returns(home: Path) -> None:
    made_run(home / "runs", "my-data-v0", "td3_bc", "default", 0, 1234, references=(None, None), noise=0.01)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "raw return" in page.text
    assert "aggregate" not in page.ids  # returns are not averaged over tasks
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert row["td3_bc (30,000 steps)"].startswith("return 1")


def test_only_d4rls_reference_is_named(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, references=(None, [0.0, 100.0]))
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "normalized by D4RL's constants" in page.text


def test_an_iqm_over_several_references_is_marked(home: Path) -> None:
    for dataset, references in {"hopper-medium-v0": ([0, 100], None), "walker2d-medium-v0": (None, [0, 100])}.items():
        made_run(home / "runs", dataset, "td3_bc", "default", 0, 50, references=references)
    assert "normalized by different references" in Page(offbench.report(home / "runs", home / "out")).text


def test_the_picture_of_a_long_training_has_its_last_step(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, steps=600_000)
    text = offbench.report(home / "runs", home / "out").read_text()
    assert re.search(r"over training on hopper-medium-v0\. At the end: td3_bc [\d.]+ at 600,000", text)


def test_unfinished_and_unbegun_runs_are_marked(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, reached=10_000)
    made_run(home / "runs", "hopper-medium-v0", "cql", "default", 0, 50, reached=0)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "10,000 of 30,000 steps" in page.text
    assert "not finished" in page.text
    assert "hopper-medium-v0/cql/default/seed-0" in page.text
    states = {row["method"]: row["state"] for row in rows(home / "out" / "tables" / "seeds.csv")}
    assert states == {"td3_bc": "unfinished", "cql": "not evaluated yet"}
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 1, 50, reached=0)
    offbench.report(home / "runs", home / "out", methods=["td3_bc"])
    states = {(row["method"], row["seed"]): row["state"] for row in rows(home / "out" / "tables" / "seeds.csv")}
    assert states == {("td3_bc", "0"): "unfinished", ("td3_bc", "1"): "not evaluated yet"}


def test_a_diverged_run_is_marked(home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, reached=10_000)
    run.mark_diverged(12_000, "critic.0")
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "1 of 1 runs diverged." in page.text
    assert "became NaN or infinite" in page.text
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert row["td3_bc (10,000 of 30,000 steps)"].endswith("± ? ‡")
    ((row),) = rows(home / "out" / "tables" / "seeds.csv")
    assert row["state"] == "diverged"


def test_a_dataset_recorded_twice_is_two_rows(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 1, 50)
    config = json.loads(run.config_path.read_text())
    write_json(run.config_path, config | {"dataset_sha256": "abcd1234ef"})
    offbench.report(home / "runs", home / "out")
    kinds = {kind: (home / "out" / "tables" / f"scores.{kind}").read_text() for kind in ("csv", "md", "tex")}
    contents = ["00000000", "abcd1234"]
    names = [row["environment"] for row in rows(home / "out" / "tables" / "scores.csv")]
    assert names == [f"hopper ({content})" for content in contents]
    for text in kinds.values():
        assert all(text.count(f"hopper ({content})") == 1 for content in contents)
    beside = rows(home / "out" / "tables" / "beside.csv")
    assert [row["environment"] for row in beside] == names
    page = (home / "out" / "index.html").read_text()
    assert "hopper-medium-v0 (abcd1234)" in page
    assert "the first digits of the content's hash" in kinds["md"]
    made_run(home / "runs", "hopper-medium-v0", "cql", "default", 1, 50, reached=0)
    offbench.report(home / "runs", home / "out")
    assert rows(home / "out" / "tables" / "seeds.csv")[-1]["dataset"] == "hopper-medium-v0 (00000000)"


def test_two_ids_of_one_level_are_told_apart(home: Path) -> None:
    for dataset in ("hopper-medium-v0", "hopper-medium-v1", "hopper-random-v0"):
        made_run(home / "runs", dataset, "td3_bc", "default", 0, 50)
    offbench.report(home / "runs", home / "out")
    names = [row["environment"] for row in rows(home / "out" / "tables" / "scores.csv")]
    assert names == ["hopper", "hopper (hopper-medium-v0)", "hopper (hopper-medium-v1)"]


def test_a_run_that_is_there_twice_is_refused(home: Path) -> None:
    made_run(home / "runs" / "a", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    shutil.copytree(home / "runs" / "a", home / "runs" / "b")
    with pytest.raises(offbench.OffbenchError, match="are the same run"):
        offbench.report(home / "runs", home / "out")
    assert not (home / "out").exists()


def test_a_real_training(medium: str, home: Path) -> None:
    """Whatever the training writes is understood: settings, losses, evaluations, the similar score."""
    sizes = {"steps": 40, "eval_every": 20, "eval_episodes": 2, "hidden": (8,), "batch_size": 8, "workers": 1}
    folders = offbench.train("bdb", medium, seeds=range(2), beta=[0.25, "adaptive"], **sizes)
    folders += offbench.train("td3_bc", medium, **sizes)
    for folder in folders:
        similarity(folder, samples=256)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert {"scores", "improvement", "similarity", "beta", "critic"} <= set(page.ids)
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert (row["level"], row["environment"]) == ("medium", "tiny")
    assert any(name.startswith("bdb (adaptive) (") for name in row)
    (found,) = [
        r for r in rows(home / "out" / "tables" / "similarity-details.csv") if r["method"].startswith("td3_bc")
    ]
    written = json.loads((folders[-1] / "similarity.json").read_text())
    assert found["by Q (%)"] == f"{written['q_similar']:.1f} ± ?"
    assert "tolerances differ" not in (home / "out" / "tables" / "similarity.md").read_text()
    similarity(folders[0], samples=256, tolerance=5.0)  # a mean of unequal tolerances says nothing
    offbench.report(home / "runs", home / "out")
    ((row),) = rows(home / "out" / "tables" / "similarity.csv")
    assert row["bdb (beta=0.25)"] == "not averaged (tolerance 0.05 and 5)"
    assert row["td3_bc"] == f"{written['q_similar']:.1f} ± ? (tolerance 0.05)"
    assert "tolerances differ" in (home / "out" / "tables" / "similarity.md").read_text()
    details = [r for r in rows(home / "out" / "tables" / "similarity-details.csv") if "0.25" in r["method"]]
    assert [r["seeds"] for r in details] == ["1", "1"]


@pytest.mark.parametrize("seeds", [2, 6])
def test_bold_improvement_is_compares_verdict(home: Path, seeds: int) -> None:
    for algorithm, value in (("td3_bc", 90.0), ("cql", 10.0)):
        for seed in range(seeds):
            made_run(home / "runs", "hopper-medium-v0", algorithm, "default", seed, 0, returns={30_000: value + seed})
    offbench.report(home / "runs", home / "out")
    evidence = "no evidence" not in offbench.compare("td3_bc", "cql").verdict
    assert evidence == (seeds == 6)  # two seeds of one dataset have p = 1/2, six 1/32
    lines = (home / "out" / "tables" / "improvement.md").read_text().splitlines()
    certain = r"100 \[100, 100\]"
    assert f"| td3\\_bc | - | {f'**{certain}**' if evidence else certain} |" in lines
    assert r"| cql | 0 \[0, 0\] | - |" in lines
    assert "with few seeds it covers less than 95%" in "".join(lines)


def test_the_paper_is_named_where_its_numbers_are(home: Path) -> None:
    made_run(home / "runs", "inverted-pendulum-medium-v0", "td3_bc", "default", 0, 50)
    page = Page(offbench.report(home / "runs", home / "out"))
    markdown = (home / "out" / "tables" / "scores.md").read_text()
    assert markdown.startswith("## Scores\n")
    assert "“paper”" not in page.text + markdown
    assert "a single seed has no standard deviation" in markdown
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "“paper” (on the page only): BDB paper, Table 1" in page.text
    assert "Learning curves" in page.text
    assert not [word for word in ("Table 1: ", "Table 2: ", "Figure 4: ") if word in page.text]


def test_one_is_singular(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, reached=10_000)
    made_run(home / "runs", "hopper-medium-v0", "cql", "default", 0, 50, reached=0)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "1run1dataset1method1seed per cell" in page.text  # the tiles, one after another
    assert "1 of 1 runs is unfinished. 1 more has no evaluation yet." in page.text


def test_a_file_where_the_report_should_be(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    (home / "taken").touch()
    with pytest.raises(SystemExit) as stopped:
        main(["report", "--out", "taken"])
    assert stopped.value.code == 2
    assert "taken is a file" in capsys.readouterr().err


def test_the_same_runs_give_the_same_bytes(home: Path) -> None:
    made_grid(home / "runs", seeds=2, levels=2)
    shutil.copytree(home / "runs", home / "elsewhere")
    for runs, out, style in (("runs", "one", {}), ("elsewhere", "two", USERS_STYLE)):
        with rc_context(style):
            main(["report", "--runs", runs, "--out", out])
    first, second = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (home / "one", home / "two")
    )
    assert first == second


def test_an_older_report_is_replaced_whole(home: Path) -> None:
    made_grid(home / "runs", seeds=1, levels=1)
    other = made_run(home / "runs", "my-data-v0", "td3_bc", "default", 0, 50)
    offbench.report(home / "runs", home / "out")
    mine = {"notes.txt", "tables/mine.csv", "figures/mine.png"}
    for name in mine:
        (home / "out" / name).write_text("mine")
    assert (home / "out" / "figures" / "curves-my-data-v0.png").exists()
    shutil.rmtree(other.folder)
    offbench.report(home / "runs", home / "out")
    offbench.report(home / "runs", home / "fresh")
    names = [{str(p.relative_to(home / out)) for p in (home / out).rglob("*")} for out in ("out", "fresh")]
    assert names[0] - names[1] == mine
    assert names[1] <= names[0]


def test_another_page_is_not_replaced(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    (home / "out").mkdir()
    (home / "out" / "index.html").write_text("my home page")
    with pytest.raises(offbench.OffbenchError, match="is not a report of offbench"):
        offbench.report(home / "runs", home / "out")
    assert (home / "out" / "index.html").read_text() == "my home page"
