"""Scores against numbers worked out by hand."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from scipy import stats

import offbench
from offbench.analysis.normalize import FORMATS, notes, render
from offbench.analysis.results import read_results
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.scores import interval, mean_std, normalize, run_return
from offbench.envs.recipes import d4rl_reference_of_env
from offbench.reports.figures import plot_curves
from offbench.training.run import Run, find_runs
from offbench.training.run_config import RunConfig


def test_normalize_by_hand() -> None:
    assert normalize(3234.3, -20.272305, 3234.3) == 100
    assert normalize(-20.272305, -20.272305, 3234.3) == 0
    assert normalize(30.0, 10.0, 50.0) == 50


def test_d4rls_references_are_those_of_its_infos() -> None:
    for env_id, reference in {
        "Hopper-v2": (-20.272305, 3234.3),
        "Hopper-v4": (-20.272305, 3234.3),
        "Hopper-v5": (-20.272305, 3234.3),
        "HalfCheetah-v5": (-280.178953, 12135.0),
        "Walker2d-v5": (1.629008, 4592.3),
        "Ant-v5": (-325.6, 3879.7),
        "InvertedPendulum-v5": None,
        "HopperHard-v0": None,
    }.items():
        name = env_id.partition("-")[0]
        spec = EnvSpec(env_id, f"gymnasium.envs.mujoco.{name.lower()}:{name}Env", max_episode_steps=1000)
        assert d4rl_reference_of_env(spec.to_json()) == reference


def test_the_interval_is_students_t() -> None:
    values = [1.0, 2.0, 4.0, 9.0]
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert interval(values) == pytest.approx((4.0, low, high))
    assert interval([5.0]) == (5.0, 5.0, 5.0)


def test_a_runs_score_is_its_last_ten_evaluations_not_its_best() -> None:
    evaluations = {step: [(1000.0 if step == 1 else float(step), 5)] for step in range(1, 13)}
    assert run_return(evaluations) == np.mean(range(3, 13))
    assert run_return({5: [(1.0, 1), (3.0, 1)], 10: [(4.0, 1), (8.0, 1)]}) == 4.0


def test_spread_over_seeds() -> None:
    assert mean_std([1.0, 2.0, 3.0]) == (2.0, 1.0)
    assert mean_std([7.0]) == (7.0, None)


def write_run(
    seed: int,
    returns: list[float],
    variant: str = "default",
    d4rl: Any = (-10.0, 190.0),
    *,
    runs: str = "runs",
    content: str = "ab" * 32,
    expert: float = 200.0,
    env_spec: str | None = None,
) -> None:
    run = Run(Path(runs) / "x-v0" / "bdb" / variant / f"seed-{seed}")
    config: dict[str, Any] = {
        "format": "offbench-run-1",
        "dataset": "x-v0",
        "algorithm": "bdb",
        "variant": variant,
        "seed": seed,
    }
    references = {"dataset": [0.0, expert], "d4rl": d4rl}
    config |= {"env_spec": env_spec}
    config |= {"settings": {}, "dataset_sha256": content, "eval_every": 100, "eval_episodes": len(returns)}
    run.folder.mkdir(parents=True)
    run.claim(RunConfig(**config, references=references, steps=100))
    if returns:
        run.write_evaluations({100: [(value, 3) for value in returns]})


def test_the_table_of_runs_by_hand() -> None:
    write_run(0, [90.0, 110.0])
    write_run(1, [30.0, 90.0])
    write_run(0, [200.0], "beta=0.5", d4rl=None)
    rows = offbench.normalize("runs")
    assert [row["variant"] for row in rows] == ["default", "beta=0.5"]
    two, one = rows
    assert (one["seeds"], one["score"], one["score_std"], one["d4rl_score"]) == (1, 100.0, None, None)
    assert (two["seeds"], two["steps"], two["evaluations"], two["return"]) == (2, 100, 1, 80.0)
    assert two["score"] == 40.0
    assert two["score_std"] == pytest.approx(np.std([50.0, 30.0], ddof=1))
    assert two["d4rl_score"] == 45.0
    # two seeds, 50 and 30: the mean resamples to 30, 40, 50 with 1/4, 1/2, 1/4
    assert (two["iqm"], two["iqm_low"], two["iqm_high"]) == (40.0, 30.0, 50.0)
    assert (one["iqm"], one["iqm_low"], one["iqm_high"]) == (100.0, None, None)


@pytest.mark.parametrize(
    ("differ", "how"),
    [
        ({"expert": 100.0}, "have different reference scores"),
        ({"d4rl": (-10.0, 200.0)}, "have different reference scores"),
        ({"env_spec": '{"id": "X-v0", "kwargs": {"mass": 2}}'}, "were evaluated in different environments"),
        ({"env_spec": '{"id": "X-v0", "contact_margin": "sum"}'}, "were evaluated in different environments"),
    ],
)
def test_runs_whose_scores_do_not_compare_are_refused(differ: dict[str, Any], how: str) -> None:
    """The same data may have been imported anew, by another version or on another MuJoCo."""
    write_run(0, [90.0], env_spec='{"id": "X-v0"}')
    write_run(1, [90.0], d4rl=None)
    assert len(offbench.normalize("runs")) == 1  # what is unknown may be the same
    write_run(2, [90.0], **({"env_spec": '{"id": "X-v0"}'} | differ))
    with pytest.raises(offbench.OffbenchError, match=f"seed-0 and .*seed-2 .*{how}"):
        offbench.normalize("runs")
    other = Path("runs/x-v0").rename("runs/y-v0")
    for path in other.rglob("config.json"):
        path.write_text(path.read_text().replace("x-v0", "y-v0"))
    write_run(0, [90.0])
    assert len(read_results("runs", datasets=["x-*"]).entries) == 1  # the others are left out
    assert len(offbench.inventory("runs", runs="runs")["runs"]) == 4


def test_numpys_numbers_are_numbers() -> None:
    for returns in (
        np.array([12135.0]),
        np.array([12135.0, 0.0]),
        np.array([12135.0], np.float32),
        [np.float32(12135)],
    ):
        rows = offbench.normalize(env="halfcheetah", returns=returns)
        assert rows[0]["d4rl_score"] == 100
        assert json.loads(render(rows, "json"))[0]["return"] == 12135


def test_what_the_command_line_refuses_is_refused_in_python_too(capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [90.0])
    with pytest.raises(OffbenchError, match="unknown format 'md'"):
        render([], "md")
    assert [render([], style) for style in ("csv", "table", "json")] == ["", "", "[]"]
    for steps in ("100", True, 1.5):
        with pytest.raises(OffbenchError, match="steps must be a whole number from 1, not"):
            offbench.normalize(steps=steps)  # type: ignore[arg-type]
    with pytest.raises(OffbenchError, match="unknown method '1'"):
        offbench.compare("bdb", 1)  # type: ignore[arg-type]
    with pytest.raises(OffbenchError, match="a seed is a whole number"):
        offbench.evaluate("runs", seed=True)
    main(["normalize", "--env", "halfcheetah", "-1e3", "-280.18", "--format", "csv"])
    assert [row["return"] for row in csv.DictReader(io.StringIO(capsys.readouterr().out))] == ["-1000.0", "-280.18"]


def test_returns_of_an_environment() -> None:
    (row,) = offbench.normalize(env="halfcheetah", returns=[12135.0])
    assert row["d4rl_score"] == 100


def test_a_score_that_rounds_to_zero_has_no_sign(capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [-0.01])
    main(["normalize"])
    table = capsys.readouterr().out
    assert "0.0" in table
    assert "-0.0" not in table


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_every_number(style: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [90.0])
    write_run(1, [30.0])
    main(["normalize", "--format", style])
    text = capsys.readouterr().out
    if style == "json":
        assert json.loads(text)[0]["score"] == 30.0
    elif style == "csv":
        assert float(next(csv.DictReader(io.StringIO(text)))["score"]) == 30.0
    else:
        assert "30.0" in text
        assert "21.2" in text  # the standard deviation of 45 and 15
    if style == "latex":
        assert "d4rl\\_score" not in text
        assert text.count("\\\\") == 2
        assert "\\begin{tabular}{llrrrr" in text


@pytest.mark.parametrize("style", FORMATS)
def test_two_contents_of_one_id_are_told_apart(style: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [90.0], runs="runs/old", content="12345678" * 8)
    main(["normalize", "--format", style])
    assert "12345678" not in capsys.readouterr().out  # the id says it all
    write_run(0, [30.0], runs="runs/new", content="9abcdef0" * 8)
    main(["normalize", "--format", style])
    text = capsys.readouterr().out
    assert (text.count("12345678"), text.count("9abcdef0")) == (1, 1)
    if style == "json":
        assert [(row["dataset"], row["content"], row["score"]) for row in json.loads(text)] == [
            ("x-v0", "12345678", 45.0),
            ("x-v0", "9abcdef0", 15.0),
        ]


def test_a_picture_of_two_contents_has_two_panels(home: Path) -> None:
    write_run(0, [90.0], runs="runs/old", content="12345678" * 8)
    write_run(0, [30.0], runs="runs/new", content="9abcdef0" * 8)
    svg = plot_curves("runs", home / "curves.svg").read_text()
    assert "x-v0 (12345678)" in svg
    assert "x-v0 (9abcdef0)" in svg


def test_a_note_of_settings_names_the_dataset_where_they_differ() -> None:
    rows = [
        {"dataset": dataset, "algorithm": algorithm, "variant": variant, "method": algorithm}
        for dataset, algorithm, variant in (
            ("x-v0", "iql", "reward_scale=0.5"),
            ("y-v0", "iql", "reward_scale=0.25"),
            ("x-v0", "cql", "bc_steps=1"),
            ("y-v0", "cql", "bc_steps=1"),
        )
    ]
    assert notes(rows) == [
        "settings of iql on x-v0: reward_scale=0.5",
        "settings of iql on y-v0: reward_scale=0.25",
        "settings of cql: bc_steps=1",
    ]


def test_runs_without_an_evaluation_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [90.0])
    main(["normalize"])
    assert capsys.readouterr().err == ""
    for seed, words in ((1, "note: 1 run without an evaluation yet"), (2, "note: 2 runs without an evaluation yet")):
        write_run(seed, [])
        main(["normalize", "--format", "json"])
        said = capsys.readouterr()
        assert said.err == f"{words}\n"
        assert json.loads(said.out)[0]["seeds"] == 1
    next(run for run in find_runs(Path("runs")) if not run.evaluations()).mark_diverged(5, "actor.flat")
    main(["normalize"])
    notes = "note: 1 run without an evaluation yet\nnote: 1 run diverged before the first evaluation\n"
    assert capsys.readouterr().err == notes
    main(["normalize", "--env", "hopper", "1000"])
    assert capsys.readouterr().err == ""


def test_one_seed_shows_no_spread() -> None:
    write_run(0, [90.0])
    assert "± ?" in render(offbench.normalize("runs"))


def test_unfinished_runs_say_so() -> None:
    write_run(0, [90.0])
    path = Path("runs/x-v0/bdb/default/seed-0/config.json")
    path.write_text(path.read_text().replace('"steps": 100', '"steps": 1000000'))
    assert "100 of 1,000,000" in render(offbench.normalize("runs"))


def test_curves_are_drawn(home: Path) -> None:
    write_run(0, [90.0])
    write_run(1, [30.0])
    assert plot_curves("runs", home / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_damaged_evaluations_are_said() -> None:
    write_run(0, [90.0])
    path = Path("runs/x-v0/bdb/default/seed-0/evaluations.csv")
    for text in (
        "",
        "step,episode\n1,2\n",
        "step,episode,return,length\n5,0,nan,3\n",
        "step,episode,return,length\n5,0\n",
    ):
        path.write_text(text)
        with pytest.raises(offbench.OffbenchError, match="is damaged"):
            offbench.normalize("runs")


def test_a_seed_that_is_there_twice_counts_for_nobody(capsys: pytest.CaptureFixture[str]) -> None:
    write_run(0, [90.0], runs="runs/one")
    write_run(0, [90.0], runs="runs/copy")
    with pytest.raises(SystemExit):
        main(["normalize"])
    assert "are the same run" in capsys.readouterr().err
