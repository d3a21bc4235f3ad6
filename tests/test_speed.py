"""`make bench`: its sides start, work and answer; its targets are those that are judged."""

from __future__ import annotations

import pytest

from tests.speed.__main__ import environment, line
from tests.speed.rows import side
from tests.speed.side import Side

# d3rlpy's and the recording ones are left to `make bench` itself: they need an environment of their own, and minutes
QUICK = {
    "train": {"algorithm": "td3_bc", "hidden": "16,16", "rows": "1000"},
    "products": {"algorithm": "bdb"},
    "product": {"way": "onednn"},
    "evaluate": {"workers": "1", "episodes": "1"},
    "sb3_evaluate": {"episodes": "1"},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_side_works_for_about_as_long_as_it_is_told(name: str) -> None:
    working = Side(list(side(name, **QUICK[name])), environment())
    try:
        assert working.rate(0.05) > 0
        assert 50 < working.memory < 5000
    finally:
        working.close()


def test_a_row_that_misses_its_target_says_so() -> None:
    found = {"name": "x", "ratio": 0.59, "low": 0.5, "high": 0.7, "ours": 1.0, "theirs": 2.0, "memory": (1.0, 2.0)}
    assert line(found | {"at_least": 0.6, "aim": 0.8})[4] == "**no**"
    assert line(found | {"at_least": 0.59, "aim": 0.8})[4] == "yes"
    assert line(found | {"at_least": None, "aim": None})[4] == ""
