"""Reports of runs whose files are damaged, or hold odd values."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.analysis.results import read_results
from offbench.common.files import write_json
from tests.made_runs import made_grid, made_run
from tests.pages import Page, rows


@pytest.mark.parametrize(
    "damage",
    [
        {"references": None},
        {"references": {"dataset": [0, 0]}},
        {"references": {"d4rl": ["a", "b"]}},
        {"seed": "0"},
        {"dataset": "\ud800"},  # JSON has it, UTF-8 has not
    ],
)
def test_a_damaged_config_is_said(home: Path, damage: dict[str, Any]) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    write_json(run.config_path, json.loads(run.config_path.read_text()) | damage)
    with pytest.raises(offbench.OffbenchError, match=r"config\.json is damaged"):
        offbench.report(home / "runs", home / "out")


@pytest.mark.parametrize("beta", [{"a": 1}, 10**400, "$\\frac$"])
def test_an_odd_beta_is_shown_as_it_is(home: Path, beta: object) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "bdb", "odd=1", 0, 50)
    write_json(run.config_path, json.loads(run.config_path.read_text()) | {"settings": {"beta": beta}})
    (column,) = read_results(home / "runs").methods
    assert column.label == f"bdb (beta={beta!s:.60})"  # its only variant: without the setting
    assert offbench.report(home / "runs", home / "out").exists()


def test_losses_that_are_not_finite_are_drawn_as_gaps(home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "bdb", "default", 0, 50)
    run.write_losses([{"step": 1000.0 * i, "q_abs": q} for i, q in enumerate((1.0, math.inf, 2.0, math.nan, 3.0))])
    assert "critic" in Page(offbench.report(home / "runs", home / "out")).ids


@pytest.mark.parametrize("text", ["[]", '{"q_similar": "much"}', "{"])
def test_damaged_similarity_is_left_out(home: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    made_grid(home / "runs", seeds=2, levels=1)
    (home / "runs/hopper-random-v0/td3_bc/default/seed-0/similarity.json").write_text(text)
    offbench.report(home / "runs", home / "out")
    said = capsys.readouterr().err
    assert said.count("left out of the similar scores") == 1
    assert "td3_bc/default/seed-0/similarity.json is damaged" in said
    details = rows(home / "out" / "tables" / "similarity-details.csv")
    assert {row["method"]: row["seeds"] for row in details if row["method"] in ("td3_bc", "cql")} == {
        "td3_bc": "1",
        "cql": "2",
    }


def test_a_run_with_damaged_losses_is_left_out(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in range(2):
        run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", seed, 0)
    run.losses_path.write_text("step,q_abs\n1000,many\n")
    offbench.report(home / "runs", home / "out")
    assert "left out: " in (said := capsys.readouterr().err)
    assert f"{run.losses_path} is damaged" in said
    ((row),) = rows(home / "out" / "tables" / "scores.csv")
    assert row["td3_bc (30,000 steps)"].endswith("± ?")
