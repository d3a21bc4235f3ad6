"""Seeds and other whole numbers that users give."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import offbench
from offbench.cli.arguments import seed_list
from offbench.common.errors import OffbenchError
from offbench.common.seeds import check_seed
from offbench.common.text import whole_number


@pytest.mark.parametrize(
    ("text", "number"), [("9007199254740993", 2**53 + 1), ("1e6", 1_000_000), ("2.0", 2), ("-3", -3), (" 7", 7)]
)
def test_whole_numbers_are_read_exactly(text: str, number: int) -> None:
    assert whole_number(text) == number


@pytest.mark.parametrize("text", ["1.5", "x", "", "inf", "nan", "1e400", "0x10"])
def test_other_text_is_no_whole_number(text: str) -> None:
    with pytest.raises(ValueError, match=r"invalid literal|could not convert"):
        whole_number(text)


def test_a_seed_beyond_what_a_float_holds_stays_as_it_is() -> None:
    assert seed_list("9007199254740993,9007199254740992") == [2**53 + 1, 2**53]


@pytest.mark.parametrize("seed", [0, 5, 2**63 - 1, np.int64(3), np.uint8(200)])
def test_seeds_are_whole_numbers(seed: int) -> None:
    assert check_seed(seed) == int(seed)
    assert type(check_seed(seed)) is int


CALLS: dict[str, Callable[[object], object]] = {
    "collect": lambda seed: offbench.collect("inverted-pendulum", "random", steps=100, seed=seed),
    "train": lambda seed: offbench.train("bc", "no-such-v0", seeds=[seed]),
    "train one": lambda seed: offbench.train("bc", "no-such-v0", seeds=seed),
    "evaluate": lambda seed: offbench.evaluate("no-run", seed=seed),
    "video": lambda seed: offbench.video("no-run", seed=seed),
    "behaviour": lambda seed: offbench.behaviour("inverted-pendulum", seed=seed),
}


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, np.uint64(2**63)])
@pytest.mark.parametrize("call", CALLS)
def test_other_seeds_are_refused_before_anything_is_written(call: str, seed: object, home: Path) -> None:
    before = sorted(home.rglob("*"))
    with pytest.raises(OffbenchError, match="a seed is a whole number from 0"):
        CALLS[call](seed)
    assert sorted(home.rglob("*")) == before
