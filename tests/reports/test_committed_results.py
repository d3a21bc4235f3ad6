"""The reports in docs/results are what `offbench report` makes of the run files beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

import offbench
from tests import beside_d3rlpy

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
