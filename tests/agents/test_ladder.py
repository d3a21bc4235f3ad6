"""Which rungs become medium, expert and the fractions, on ladders made up for the purpose."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from offbench.agents.build_ladder import Surveyor
from offbench.agents.ladder import Ladder, Rung, read_ladder
from offbench.common.errors import OffbenchError
from offbench.data.levels import Part, parse_level, parse_mix, shares


def surveyor(returns: list[float], spread: float = 5.0) -> Surveyor:
    """Rungs whose measured return is known; screening says the same with an interval of +- spread."""
    rows: list[dict[str, float]] = [
        {"step": 10 * (i + 1), "stochastic_return": value, "stochastic_high": value + spread}
        for i, value in enumerate(returns)
    ]
    found = Surveyor(SimpleNamespace(), rows, SimpleNamespace())  # type: ignore[arg-type]

    def measure(step: int) -> float:
        found.measured[step] = {"return": returns[step // 10 - 1]}
        return returns[step // 10 - 1]

    found.measure = measure  # type: ignore[method-assign]
    return found


def test_medium_is_the_first_rung_in_its_band() -> None:
    assert surveyor([0, 10, 50, 40, 36, 100]).medium(100 / 3, 45, 60) == 40


def test_without_a_rung_in_the_band_medium_is_the_nearest() -> None:
    assert surveyor([0, 20, 70, 100]).medium(100 / 3, 45, 40) == 20
    assert surveyor([0, 1, 50, 100]).medium(100 / 3, 45, 40) == 30


def test_medium_comes_before_the_expert() -> None:
    assert surveyor([0, 20, 100, 40]).medium(100 / 3, 45, 30) == 20


def test_rungs_that_cannot_be_medium_are_not_measured() -> None:
    found = surveyor([0, 0, 0, 40, 100])
    found.medium(100 / 3, 45, 50)
    assert set(found.measured) == {40}


def test_the_expert_is_the_best_of_the_late_rungs() -> None:
    assert surveyor([500, 10, 20, 90, 80]).expert() == 40


def test_the_nearest_rung_is_nearest_as_measured_not_as_screened() -> None:
    """Screening promised 50 at step 20 and 30; measured, they return 90 and 10, and 48 is the better choice."""
    found = surveyor([0, 90, 10, 48, 100])
    for step, lucky in ((20, 50.0), (30, 51.0), (40, 46.0)):
        found.screened[step]["stochastic_return"] = lucky
    assert found.nearest(50, close=5) == 40
    assert set(found.measured) == {20, 30, 40}


def test_looking_for_the_nearest_rung_ends() -> None:
    found = surveyor([100.0] * 20)
    for row in found.screened.values():
        row["stochastic_return"] = 50.0
    found.nearest(50, close=5)
    assert len(found.measured) == 6


def test_the_nearest_rung_of_a_ladder() -> None:
    info = {"references": {"random": {"return": 10.0}, "expert": {"return": 110.0}}}
    rungs = tuple(Rung(i, "", "", ret, ret, ret, 9) for i, ret in enumerate([20.0, 60.0, 75.0, 110.0]))
    ladder = Ladder(Path(), info, rungs)
    assert ladder.nearest(0.6).ret == 75.0
    assert ladder.nearest(0.55).ret == 60.0
    assert ladder.fraction(rungs[3]) == 1


def test_levels_and_mixes() -> None:
    assert parse_level("medium-expert") == ("medium-expert", (Part("medium"), Part("expert")))
    assert parse_level("0.6") == ("60percent", (Part("0.6"),))
    assert parse_level("0.125")[0] == "12p5percent"
    name, parts = parse_mix("random:0.25,medium-replay:0.25,0.6:0.5")
    assert name == "random25-medium-replay25-60percent50"
    assert parts == (Part("uniform", 0.25), Part("replay", 0.25), Part("0.6", 0.5))


def test_shares_add_up() -> None:
    assert shares((Part("a"), Part("b")), 2_000_000) == [1_000_000, 1_000_000]
    assert shares((Part("a", 1 / 3), Part("b", 1 / 3), Part("c", 1 / 3)), 100) == [33, 34, 33]


@pytest.mark.parametrize("fault", ["csv", "json", "role"])
def test_a_damaged_ladder_is_said(tiny: tuple[str, str], home: Path, fault: str) -> None:
    import shutil

    folder = home / "ladder"
    shutil.copytree(Path(tiny[1]) / "tiny" / "seed-0" / "ladder", folder)
    assert read_ladder(folder) is not None
    path = folder / ("ladder.json" if fault == "json" else "ladder.csv")
    text = path.read_text()
    damaged: dict[str, Any] = {"csv": text[: len(text) // 2], "json": "{", "role": text.replace("medium", "mdium")}
    path.write_text(damaged[fault])
    with pytest.raises(OffbenchError, match="damaged"):
        read_ladder(folder)


def test_no_ladder_is_no_error(home: Path) -> None:
    assert read_ladder(home) is None
