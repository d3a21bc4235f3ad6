"""Numbers and tables as text."""

from __future__ import annotations

import io

import pytest

from offbench.common.tables import tabular
from offbench.common.terminal import console
from offbench.common.text import no_formula


@pytest.mark.parametrize(
    "cell", ["-1.5", "-1e-05", "-inf", "-287.1 to 10,964.8", "-1.2 ± 3.0 (50,000 of 1,000,000 steps)"]
)
def test_a_negative_number_is_no_formula(cell: str) -> None:
    assert no_formula(cell) == cell


def test_a_row_of_latex_that_begins_with_a_bracket_is_no_argument_of_the_one_before() -> None:
    assert [line for line in tabular(["method"], [["[ours] BDB"]], 1) if "BDB" in line] == [r"{}[ours] BDB \\"]


def test_a_terminal_without_columns_has_eighty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    assert console(io.StringIO()).width == 80
