"""`offbench list`: what is here, as tables and as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.training.run import Run
from tests.made_runs import made_run


def listed(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    main(["list", *words, "--json"])
    return json.loads(capsys.readouterr().out)


def test_json_has_all_but_the_runs(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    contents = listed(capsys)
    assert list(contents) == ["environments", "levels", "algorithms", "datasets"]
    assert contents["environments"]["hopper"]["env_id"] == "Hopper-v5"
    assert contents["levels"] == ["random", "medium-replay", "medium", "medium-expert", "expert"]
    assert "td3_bc" in contents["algorithms"]
    assert contents["datasets"] == offbench.inventory("datasets")["datasets"]
    assert contents["datasets"][medium]["total_steps"] == 600
    assert list(listed(capsys, "levels")) == ["levels"]


def test_datasets_in_a_namespace_and_behind_a_link(
    medium: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Minari lists them: a link may lead to another disk, and hidden folders are left out."""
    (home / "minari" / "space" / ".hidden").mkdir(parents=True)
    (home / "minari" / medium).rename(home / "elsewhere")
    for link in (medium, "space/linked-v0", "space/.hidden/it-v0"):
        (home / "minari" / link).symlink_to(home / "elsewhere")
    assert list(listed(capsys, "datasets")["datasets"]) == ["space/linked-v0", medium]


def test_runs_have_the_mean_of_their_last_evaluations(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made_run(home / "runs", "hopper-medium-v0", "bdb", "default", 0, 40, settings={"beta": "adaptive"})
    second = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 1, 60, reached=20_000)
    waiting = made_run(home / "runs", "hopper-medium-v0", "bc", "default", 3, 60)
    waiting.evaluations_path.unlink()
    foreign = made_run(home / "runs", "mine-v0", "bc", "default", 0, 60, references=(None, None))
    rows = {(run["dataset"], run["method"]): run for run in listed(capsys, "runs")["runs"]}
    assert len(rows) == 4
    row = rows["hopper-medium-v0", "td3_bc"]
    lines = [line.split(",") for line in second.evaluations_path.read_text().splitlines()[1:]]
    returns = [float(value) for step, _, value, _ in lines]  # 8 evaluations of 3 episodes: all are in the score
    expected = float(np.mean(returns))
    assert row["return"] == row["score"] == pytest.approx(expected)  # the references are 0 and 100
    assert row["d4rl_score"] == pytest.approx((expected + 10) / 2)  # and -10 and 190
    assert (row["seed"], row["step"], row["steps"], row["state"]) == (1, 20_000, 30_000, "unfinished")
    assert Run(Path(row["folder"])).config().seed == 1
    assert rows["hopper-medium-v0", "bdb (adaptive)"]["state"] == "finished"
    assert rows["hopper-medium-v0", "bc"]["step"] == 0
    assert rows["hopper-medium-v0", "bc"]["return"] is None
    assert rows["mine-v0", "bc"]["score"] is rows["mine-v0", "bc"]["d4rl_score"] is None
    main(["list", "runs"])
    table = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["dataset", "method", "seed", "step", "of", "score", "D4RL", "score", "state"] in table
    numbers = [f"{expected:.1f}", f"{(expected + 10) / 2:.1f}"]
    assert ["hopper-medium-v0", "td3_bc", "1", "20,000", "30,000", *numbers, "unfinished"] in table
    assert ["hopper-medium-v0", "bc", "3", "0", "30,000", "-", "-", "unfinished"] in table
    main(["list", "runs", "--runs", str(foreign.folder.parents[2])])
    assert " return " in capsys.readouterr().out  # where no run has a score


def test_where_there_are_no_runs(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert listed(capsys, "runs") == {"runs": []}
    main(["list", "runs"])
    assert "none; start one with `offbench train ALGO --dataset ID`" in capsys.readouterr().out
