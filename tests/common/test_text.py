"""Numbers and tables as text."""

from __future__ import annotations

import pytest

from offbench.common.text import no_formula


@pytest.mark.parametrize(
    "cell", ["-1.5", "-1e-05", "-inf", "-287.1 to 10,964.8", "-1.2 ± 3.0 (50,000 of 1,000,000 steps)"]
)
def test_a_negative_number_is_no_formula(cell: str) -> None:
    assert no_formula(cell) == cell
