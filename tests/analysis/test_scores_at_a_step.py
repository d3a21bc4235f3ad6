"""`--steps`: the scores that runs had earlier in their training."""

from __future__ import annotations

from pathlib import Path

import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.training.run import Run
from tests.keep_runs import keep
from tests.made_runs import made_run

COMMITTED = Path(__file__).parents[2] / "docs" / "results" / "medium" / "runs" / "hopper-medium-v0"
LONG = {10_000: 10.0, 20_000: 20.0, 30_000: 90.0}


def run(name: str, seed: int, returns: dict[int, float], last: int = 30_000) -> Run:
    return made_run(Path("runs"), "x-medium-v0", name, "default", seed, 0, steps=last, returns=returns)


@pytest.mark.usefixtures("home")
def test_by_hand() -> None:
    run("td3_bc", 0, LONG)
    run("td3_bc", 1, {10_000: 30.0, 20_000: 40.0, 30_000: 0.0})
    (row,) = offbench.normalize(steps=20_000)
    assert row["score"] == pytest.approx(25)  # (10 + 20) / 2 and (30 + 40) / 2
    assert (row["steps"], row["of_steps"], row["window"]) == (20_000, 20_000, "10000 20000")
    assert offbench.normalize(steps=40_000) == offbench.normalize()


def test_committed_runs_score_as_if_they_ended_there(tmp_path: Path) -> None:
    keep(COMMITTED, tmp_path / "cut", steps=50_000)
    assert offbench.normalize(COMMITTED, steps=50_000) == offbench.normalize(tmp_path / "cut")
    longer, shorter = (
        offbench.compare("td3_bc", "bc", runs=runs, steps=steps).row()
        for runs, steps in ((COMMITTED, 50_000), (tmp_path / "cut", None))
    )
    assert longer == shorter
    assert longer != offbench.compare("td3_bc", "bc", runs=COMMITTED).row()


@pytest.mark.usefixtures("home")
def test_runs_of_two_lengths_compare_at_the_shorter_one(capsys: pytest.CaptureFixture[str]) -> None:
    run("td3_bc", 0, LONG)
    run("bc", 0, {10_000: 15.0, 20_000: 16.0}, last=20_000)
    main(["normalize"])
    assert "cannot be compared" in capsys.readouterr().out
    main(["normalize", "--steps", "20000"])
    assert "cannot be compared" not in capsys.readouterr().out
    main(["compare", "td3_bc", "bc", "--steps", "20000", "--json"])
    assert '"difference": -0.5' in capsys.readouterr().out


@pytest.mark.usefixtures("home")
def test_between_two_evaluations_a_run_is_as_at_the_first_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("td3_bc", "bc"):
        for seed in (0, 1):
            run(name, seed, LONG)
    (row, _) = offbench.normalize(steps=25_000)
    assert (row["steps"], row["of_steps"]) == (20_000, 20_000)
    main(["compare", "td3_bc", "bc", "--steps", "25000"])
    assert "did not reach" not in capsys.readouterr().out
    with pytest.raises(OffbenchError, match="steps must be a whole number from 1, not -5"):
        offbench.normalize(steps=-5)


@pytest.mark.usefixtures("home")
def test_runs_evaluated_later_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    run("td3_bc", 0, LONG)
    run("bc", 0, {5_000: 15.0, 10_000: 16.0})
    main(["normalize", "--steps", "9000"])
    printed = capsys.readouterr()
    assert "td3_bc" not in printed.out
    assert "1 run without an evaluation within 9,000 updates" in printed.err
    with pytest.raises(OffbenchError, match="no run below runs has an evaluation within 4,000 updates"):
        offbench.normalize(steps=4_000)
    with pytest.raises(OffbenchError, match="--steps has no effect with --env"):
        offbench.normalize(env="hopper", returns=[1.0], steps=4_000)
