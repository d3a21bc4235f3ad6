"""Damage in the files of a run, and files of another run in its place."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from safetensors import safe_open
from safetensors.torch import save_file

import offbench
from offbench.analysis import normalize
from offbench.analysis.normalize import render
from offbench.common import checkpoints
from offbench.common.errors import DamagedError, OffbenchError
from offbench.evaluation.similarity import read_similarity, similarity
from offbench.training.run import Run, find_runs
from tests.commands import refusal
from tests.made_runs import ROWS, made_run, small_run


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (ROWS + "200,0,99999.0,5\n", "duplicated"),
        (ROWS + "-7,0,1.0,5\n", "-7"),
        (ROWS + "9" * 400 + ",0,1.0,5\n", "999"),
        (ROWS + "300,0,1.0,5\n300,1,1.0,5\n", "step 300"),
        (ROWS.replace("200,1,4.0,5\n", "200,1,4.0,5,6\n"), "cells"),
        (ROWS.replace("200,1,4.0,5\n", ""), "step 200 has 1"),
        (ROWS.replace("100,0,1.0,5\n", ""), "step 100"),
        (ROWS.replace("4.0", "1e308"), "1e+308"),
        (ROWS.replace("4.0", "nan"), "nan"),
        (ROWS.replace("4.0", "1_000"), "1_000"),
        (ROWS.replace("4.0", "٤"), "٤"),
        (ROWS.replace("4.0", " 4"), "' 4'"),
    ],
)
def test_rows_that_do_not_fit_their_key_are_damage(
    tmp_path: Path, rows: str, names: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A damaged run alone is refused; beside a sound one it is named and left out."""
    small_run(tmp_path / "seed-1", rows)
    assert names in refusal(["normalize", "--runs", str(tmp_path)], capsys)
    small_run(tmp_path / "seed-0")
    (row,) = normalize.score_runs(tmp_path)
    assert row["seeds"] == 1
    assert row["score"] == pytest.approx(25.0)  # mean of 1, 2, 3, 4 between 0 and 10
    said = capsys.readouterr().err
    assert str(tmp_path / "seed-1" / "evaluations.csv") in said
    assert names in said


@pytest.mark.parametrize("references", [[0, 5e-324], [0, 1e-300], [-1e308, 1e308], [1.0, 1.0]])
def test_references_beyond_reason_are_damage(
    tmp_path: Path, references: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    small_run(tmp_path / "seed-0", references=references)
    assert "references" in refusal(["normalize", "--runs", str(tmp_path)], capsys)


def test_an_earlier_runs_precision_is_read_from_its_tf32(tmp_path: Path) -> None:
    run = small_run(tmp_path / "seed-0")
    written = json.loads(run.config_path.read_text())
    run.config_path.write_text(json.dumps(written | {"tf32": True, "sessions": [{"step": 100, "tf32": False}]}))
    assert [session.precision for session in run.config().history] == ["tf32", "float32"]


@pytest.mark.parametrize(
    "change",
    [
        {"sessions": [3]},
        {"sessions": {}},
        {"sessions": None},
        {"env_spec": "{"},
        {"steps": 10**15},
        {"format": "offbench-run-2"},
        {"label": "a\nhopper-medium-v0  fake  999.9"},
        {"variant": "alpha=2\n\\input{x}"},
        {"dataset": "a\u2028b"},
    ],
)
def test_a_config_of_other_types_is_damage(
    tmp_path: Path, change: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    run = small_run(tmp_path / "seed-0")
    run.config_path.write_text(json.dumps(json.loads(run.config_path.read_text()) | change))
    line = refusal(["normalize", "--runs", str(tmp_path)], capsys)
    assert str(run.config_path) in line
    assert "delete the run" in line


def test_a_run_with_an_unreadable_config_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_run(tmp_path / "seed-0")
    (small_run(tmp_path / "seed-1").folder / "config.json").write_text("{")
    assert len(find_runs(tmp_path)) == 2
    assert normalize.score_runs(tmp_path)[0]["seeds"] == 1
    assert "seed-1/config.json" in capsys.readouterr().err


SMALL: dict[str, Any] = {"eval_every": 50, "eval_episodes": 1, "workers": 1, "hidden": (8, 8), "batch_size": 16}


def test_the_checkpoint_of_other_settings_is_noticed(medium: str) -> None:
    (one,) = offbench.train("td3_bc", medium, steps=100, alpha=2.0, **SMALL)
    (other,) = offbench.train("td3_bc", medium, steps=100, alpha=3.0, **SMALL)
    for path in other.glob("checkpoint-*"):
        shutil.copy(path, one)
    with pytest.raises(OffbenchError, match=r"is of another run: its alpha is 3\.0, not 2\.0"):
        offbench.train("td3_bc", medium, steps=150, alpha=2.0, **SMALL)


def test_the_files_of_another_seed_are_noticed(medium: str) -> None:
    one, other = offbench.train("td3_bc", medium, seeds=[0, 1], steps=100, **SMALL)
    policy = (one / "policy.safetensors").read_bytes()
    shutil.copy(other / "policy.safetensors", one)
    with pytest.raises(OffbenchError, match="is of another run: its seed is 1"):
        offbench.evaluate(one, episodes=1, workers=1)
    with pytest.raises(OffbenchError, match="is of another run: its seed is 1"):
        offbench.load_policy(one)
    (one / "policy.safetensors").write_bytes(policy)
    for path in other.glob("checkpoint-*"):
        shutil.copy(path, one)
    evaluations = (one / "evaluations.csv").read_bytes()
    with pytest.raises(OffbenchError, match=r"the checkpoint in .* is of another run: its seed is 1, not 0"):
        offbench.train("td3_bc", medium, seeds=0, steps=150, **SMALL)
    assert (one / "evaluations.csv").read_bytes() == evaluations


@pytest.mark.parametrize(
    ("steps", "fault"),
    [
        ([100, 300], "the evaluation of step 200 is missing"),
        ([200], "the evaluation of step 100 is missing"),
        ([100, 150, 200], "an evaluation of step 150"),
        ([0, 100], "step 0 of a run"),
    ],
)
def test_evaluations_at_other_steps_than_they_are_due_are_damage(tmp_path: Path, steps: list[int], fault: str) -> None:
    run = small_run(tmp_path / "seed-0")
    config = json.loads(run.config_path.read_text()) | {"steps": 400, "eval_every": 100}
    run.config_path.write_text(json.dumps(config))
    two = [(1.0, 5), (2.0, 5)]
    run.write_evaluations(dict.fromkeys(steps, two))
    with pytest.raises(DamagedError, match=fault):
        offbench.normalize(tmp_path)
    run.write_evaluations(dict.fromkeys((100, 200, 250), two))  # as at the end of a run of 250 steps that goes on
    assert list(run.evaluations()) == [100, 200, 250]


@pytest.mark.parametrize(
    "rows", ["nan,1\n", "1e999,1\n", "-5,1\n", "200,1\n100,1\n", "100,1\n100,2\n", "1e300,1\n", ",1\n"]
)
def test_rows_of_losses_at_impossible_steps_are_damage(tmp_path: Path, rows: str) -> None:
    run = small_run(tmp_path / "seed-0")
    run.losses_path.write_text("step,q_abs\n" + rows)
    with pytest.raises(DamagedError, match=r"losses\.csv"):
        run.losses()


@pytest.mark.parametrize("change", [{"q_similar": 1e308}, {"action_similar": -50}, {"samples": -1}, {"tolerance": -1}])
def test_a_similar_score_out_of_range_is_damage(change: dict[str, float], tmp_path: Path) -> None:
    run = small_run(tmp_path / "seed-0")
    sound = {
        "step": 1,
        "samples": 5,
        "q_similar": 99.0,
        "tolerance": 0.05,
        "action_similar": 9.0,
        "action_tolerance": 0.1,
    }
    (run.folder / "similarity.json").write_text(json.dumps(sound))
    assert read_similarity(run) is not None
    (run.folder / "similarity.json").write_text(json.dumps(sound | change))
    with pytest.raises(DamagedError, match="out of range"):
        read_similarity(run)


def forge(path: Path, **changes: object) -> None:
    """Change a checkpoint's state, with a hash that matches."""
    with safe_open(path, framework="pt") as file:
        state = json.loads(file.metadata()["offbench"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del state["sha256"]
    state |= changes
    state["sha256"] = checkpoints._sha256(tensors, state)
    save_file(tensors, path, {"offbench": json.dumps(state)})


@pytest.mark.parametrize(
    "change",
    [
        *({"origin": value} for value in ([], "text", [["a", "b"]], 5)),
        *({"unlogged": value} for value in (5, "abc", [1], [["a", 1]], {"a": 1}, None, [["a", "x", 1]])),
        *({"unlogged": [["q_abs", *value]]} for value in ((1.0, "x"), ([], 2), (1.0, 0), (1.0, True))),
    ],
)
def test_a_forged_state_of_a_checkpoint_is_damage(
    change: dict[str, Any], medium: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=100, **SMALL)
    before = (folder / "evaluations.csv").read_bytes()
    forge(checkpoints.path_of(folder, 100), **change)
    offbench.train("td3_bc", medium, steps=150, **SMALL)  # from the checkpoint before it
    assert "checkpoint-000000100.safetensors is damaged" in capsys.readouterr().err
    assert (folder / "evaluations.csv").read_bytes().startswith(before)


def test_settings_that_are_not_the_checkpoints_make_no_network(medium: str) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=50, **SMALL)
    path = Run(folder).config_path
    config = json.loads(path.read_text())
    config["settings"]["hidden"] = [200_000, 200_000]  # 300 GB
    path.write_text(json.dumps(config))
    with pytest.raises(OffbenchError, match=r"its hidden is \[8, 8\], not \[200000, 200000\]"):
        similarity(folder)


def test_a_beta_of_several_lines_is_one_line(home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    config = json.loads(run.config_path.read_text())
    config["settings"]["beta"] = "x\n| forged | 99.9 |" + "y" * 10**5
    run.config_path.write_text(json.dumps(config))
    lines = render(offbench.normalize(home / "runs")).splitlines()
    assert not [line for line in lines if line.startswith("| forged")]
    assert max(map(len, lines)) < 400


@pytest.mark.parametrize("values", [(1e308, -1e308), (1e308, 1e308), (1e16, 1.0)])
def test_losses_of_any_size_are_drawn(values: tuple[float, float], home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    run.write_losses([{"step": 1000.0 * (i + 1), "q_abs": value} for i, value in enumerate(values)])
    assert offbench.report(home / "runs", home / "out").exists()
