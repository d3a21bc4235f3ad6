"""The reports in docs/results are what `offbench report` makes of the run files beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

import offbench
from tests import beside_d3rlpy, observations
from tests.made_runs import made_run

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("runs", sorted(RESULTS.glob("*/runs")), ids=lambda path: path.parent.name)
def test_the_committed_tables_are_those_of_the_committed_runs(runs: Path) -> None:
    offbench.report(runs, "again")
    committed = runs.parent / "report" / "tables"
    tables = sorted(path.name for path in committed.iterdir())
    assert "scores.md" in tables
    assert tables == sorted(path.name for path in Path("again/tables").iterdir())
    for name in tables:
        assert Path("again/tables", name).read_bytes() == (committed / name).read_bytes(), name


def test_the_committed_comparison_with_d3rlpy_is_that_of_the_committed_runs() -> None:
    assert beside_d3rlpy.FILE.read_text() == beside_d3rlpy.table()


def test_observations_by_hand(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Three evaluations with three episodes of 500 steps each; the own reference of made runs is 0 to 100."""
    for seed in range(2):
        for algorithm, values in (("td3_bc", (40.0, 60.0 + seed, 50.0)), ("bc", (30.0, 50.0, 70.0))):
            returns = dict(zip((10_000, 20_000, 30_000), values, strict=True))
            made_run(Path("runs"), "x-medium-v0", algorithm, "default", seed, 0, returns=returns)
    monkeypatch.setattr("sys.argv", ["observations", "runs"])
    observations.main()
    name, header, _, *lines = capsys.readouterr().out.splitlines()
    assert (name, header.split()) == ("x-medium-v0", ["step", "td3_bc", "bc"])
    assert [line.split() for line in lines[:2]] == [["10,000", "40.0", "30.0"], ["20,000", "60.5", "50.0"]]
    assert lines[4] == "td3_bc: 50.0 to 60.5 from 20,000 updates on, mean 55.2"
    assert lines[5] == (
        "bc: 50.0 to 70.0 from 20,000 updates on, mean 60.0; "
        "above td3_bc at 1 of 2 evaluations, at all from 30,000 updates on"
    )
    assert lines[6] == (
        "td3_bc: 100% of the last episodes take 500 steps, half of them at most 500; "
        "successive evaluations differ by 15.5"
    )
