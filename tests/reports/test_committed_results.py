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
    """Evaluations of 40 and 60, three episodes of 500 steps each; the own reference of made runs is 0 to 100."""
    for seed in range(2):
        made_run(
            Path("runs"), "x-medium-v0", "td3_bc", "default", seed, 0, returns={10_000: 40.0, 20_000: 60.0 + seed}
        )
    monkeypatch.setattr("sys.argv", ["observations", "runs"])
    observations.main()
    name, header, _, *lines = capsys.readouterr().out.splitlines()
    assert (name, header.split()) == ("x-medium-v0", ["step", "td3_bc"])
    assert [line.split() for line in lines[:2]] == [["10,000", "40.0"], ["20,000", "60.5"]]
    assert lines[3] == (
        "td3_bc: 100% of the last episodes take 500 steps, half of them at most 500; "
        "successive evaluations differ by 20.5"
    )
