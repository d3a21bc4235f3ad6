"""Which rungs become medium, expert and the fractions, on ladders made up for the purpose."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import offbench
from offbench.agents.build_ladder import RungEvaluator
from offbench.agents.ladder import Ladder, LadderInfo, Replay, Rung, folder_of, read_ladder
from offbench.agents.training_folder import TrainingFolder, read_rungs
from offbench.common.errors import OffbenchError
from offbench.data.levels import Part, parse_level, parse_mix, shares
from offbench.envs.recipes import load_recipe
from offbench.rollouts.rollouts import EpisodeStats


def evaluator(
    returns: list[float], within: dict[int, float] | None = None, spread: float = 5.0
) -> tuple[RungEvaluator, list[int]]:
    """Rungs at steps 10, 20, ... of known return; screening says the same with an interval of +- spread.

    Args:
        returns: of the rungs.
        within: returns of policies within segments, by step; screening says the same.

    Returns:
        The evaluator, and the steps that it measures, as it does.
    """
    rows: list[dict[str, float]] = [
        {"step": 10 * (i + 1), "stochastic_return": value, "stochastic_high": value + spread}
        for i, value in enumerate(returns)
    ]
    true = {int(row["step"]): row["stochastic_return"] for row in rows} | (within or {})
    rungs = RungEvaluator(SimpleNamespace(), rows, sorted(true), SimpleNamespace())  # type: ignore[arg-type]
    measured: list[int] = []

    def measure(step: int) -> float:
        if step not in rungs.measured:
            measured.append(step)
        rungs.measured[step] = {"return": true[step]}
        return true[step]

    rungs.measure = measure  # type: ignore[method-assign]
    rungs.screen = true.__getitem__  # type: ignore[method-assign]
    rungs._save = lambda *_: None  # type: ignore[method-assign]
    return rungs, measured


def test_medium_is_the_first_rung_in_its_band() -> None:
    rungs, _ = evaluator([0, 10, 50, 40, 36, 100])
    assert rungs.medium(100 / 3, 45, 60) == 40


def test_without_a_rung_in_the_band_medium_is_the_nearest() -> None:
    assert evaluator([0, 20, 70, 100])[0].medium(100 / 3, 45, 40) == 20
    assert evaluator([0, 1, 50, 100])[0].medium(100 / 3, 45, 40) == 30


def test_medium_comes_before_the_expert() -> None:
    assert evaluator([0, 20, 100, 40])[0].medium(100 / 3, 45, 30) == 20


def test_rungs_that_cannot_be_medium_are_not_measured() -> None:
    rungs, measured = evaluator([0, 0, 0, 40, 100])
    rungs.medium(100 / 3, 45, 50)
    assert measured == [40]


def test_where_the_return_leaps_over_the_band_medium_is_a_policy_within_the_segment() -> None:
    """The most promising as screened, as long as they measure well."""
    within = dict(zip(range(21, 30), [11.0, 90, 13, 15, 70, 40, 60, 20, 90], strict=True))
    rungs, measured = evaluator([0, 10, 95, 40, 100], within)
    assert rungs.medium(100 / 3, 45, 50) == 26
    assert measured == [30, 26]
    rungs, measured = evaluator([0, 10, 95, 40, 100], within)
    rungs.screen = {**within, 28: 39.0}.__getitem__  # type: ignore[method-assign]
    assert rungs.medium(100 / 3, 45, 50) == 26
    assert measured == [30, 28, 26]


def test_without_a_policy_in_the_band_within_the_segment_the_search_continues() -> None:
    rungs, _ = evaluator([0, 10, 95, 40, 100], {25: 70.0})
    assert rungs.medium(100 / 3, 45, 50) == 40
    rungs, _ = evaluator([0, 10, 95, 98, 100], {25: 55.0})
    assert rungs.medium(100 / 3, 45, 50) == 25, "nearer to the band than any rung"


def test_a_return_that_the_rungs_leap_over_is_found_within_a_segment() -> None:
    """Both where the return rises and where it falls."""
    within = {22: 30.0, 25: 50.0, 27: 61.0}
    rungs, _ = evaluator([0, 10, 95, 98], within)
    assert rungs.nearest(60, close=2.5) == 27
    rungs, _ = evaluator([0, 98, 10, 5], within | {22: 70.0, 25: 50.0, 27: 61.0})
    assert rungs.nearest(50, close=2.5) == 25
    rungs, _ = evaluator([70, 80, 90], {2: 5.0, 4: 12.0, 7: 50.0})
    assert rungs.nearest(10, close=2.5) == 4, "before the first rung"


def test_policies_within_segments_are_left_alone_where_a_rung_fits() -> None:
    rungs, measured = evaluator([0, 10, 59, 98, 100], {15: 40.0, 35: 60.0})
    assert rungs.nearest(60, close=2.5) == 30
    assert not rungs.screened_within
    assert measured == [30]


def test_a_return_that_no_policy_has_gets_the_nearest() -> None:
    rungs, _ = evaluator([0, 10, 95, 98], {22: 12.0, 25: 45.0, 27: 80.0})
    assert rungs.nearest(60, close=2.5) == 25


def test_the_nearest_of_some_rungs_is_not_one_after_them() -> None:
    rungs, _ = evaluator([0, 10, 95, 33, 100], {25: 70.0, 33: 31.0})
    rungs.measure(33)
    assert rungs.nearest(33, 1, among=[10, 20]) == 20


def test_the_expert_is_the_best_of_the_late_rungs() -> None:
    assert evaluator([500, 10, 20, 90, 80])[0].expert() == 40


def test_the_nearest_rung_is_nearest_as_measured_not_as_screened() -> None:
    """Screening promised 50 at step 20 and 30; measured, they return 90 and 10, and 48 is the better choice."""
    rungs, measured = evaluator([0, 90, 10, 48, 100])
    for step, lucky in ((20, 50.0), (30, 51.0), (40, 46.0)):
        rungs.screened[step]["stochastic_return"] = lucky
    assert rungs.nearest(50, close=5) == 40
    assert set(measured) == {20, 30, 40}


def test_looking_for_the_nearest_rung_ends() -> None:
    rungs, measured = evaluator([100.0] * 20)
    for row in rungs.screened.values():
        row["stochastic_return"] = 50.0
    rungs.nearest(50, close=5)
    assert len(measured) == 6


def test_the_nearest_rung_of_a_ladder() -> None:
    references = {"random": {"return": 10.0}, "expert": {"return": 110.0}}
    info = LadderInfo(env_id="", env_kwargs={}, references=references, levels={}, medium_replay=Replay(0, ""))
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
    folder = home / "ladder"
    shutil.copytree(Path(tiny[1]) / "tiny" / "seed-0" / "ladder", folder)
    assert read_ladder(folder) is not None
    path = folder / ("ladder.json" if fault == "json" else "ladder.csv")
    text = path.read_text()
    damaged: dict[str, Any] = {"csv": text[: len(text) // 2], "json": "{", "role": text.replace("medium", "mdium")}
    path.write_text(damaged[fault])
    with pytest.raises(OffbenchError, match="damaged"):
        read_ladder(folder)


@pytest.mark.parametrize("out", ["tiny/seed-0", "tiny", ".", "tiny/seed-0/policies"])
def test_a_ladder_does_not_replace_its_training(tiny: tuple[str, str], out: str) -> None:
    with pytest.raises(OffbenchError, match=r"is a folder of the training itself .*; give another one for the ladder"):
        offbench.behaviour(tiny[0], behaviour_dir=tiny[1], out=Path(tiny[1]) / out)


def test_a_damaged_training_is_said(tiny: tuple[str, str], home: Path) -> None:
    shutil.copytree(tiny[1], home / "behaviour")
    folder = home / "behaviour" / "tiny" / "seed-0"
    for name, old, new, message in (
        ("rungs.csv", "stochastic_return", "return", "it has no column stochastic_return"),
        ("training.json", '"versions": {', '"versions": 3, "others": {', "versions is not an object"),
    ):
        text = (folder / name).read_text()
        (folder / name).write_text(text.replace(old, new))
        with pytest.raises(OffbenchError, match=rf"{name} is damaged \({message}\); delete"):
            offbench.behaviour(tiny[0], out=home / "out")
        (folder / name).write_text(text)


def test_no_ladder_is_no_error(home: Path) -> None:
    assert read_ladder(home) is None


def test_a_build_that_was_interrupted_measures_nothing_again(tiny: tuple[str, str], home: Path) -> None:
    """With another number of episodes, or another simulator, everything is measured again."""
    recipe = load_recipe(tiny[0])
    source = TrainingFolder(recipe, 0, folder_of(recipe, 0, Path(tiny[1])))
    folder = TrainingFolder(recipe, 0, home / "training")
    shutil.copytree(source.path, folder.path, ignore=shutil.ignore_patterns("ladder"))
    rows = read_rungs(folder.rungs)
    (folder.path / "measured.json").unlink()

    class PlayedError(Exception):
        pass

    class Counting:
        """Answers the first two evaluations (a policy is measured by two), and is interrupted at the third."""

        calls = 0

        def evaluate(self, *_: Any) -> list[EpisodeStats]:
            self.calls += 1
            if self.calls > 2:
                raise PlayedError
            return [EpisodeStats(30.0 + i, 9) for i in range(8)]

    def evaluator_of(folder: TrainingFolder) -> RungEvaluator:
        return RungEvaluator(folder, rows, folder.policy_steps(), Counting())  # type: ignore[arg-type]

    first = evaluator_of(folder)
    with pytest.raises(PlayedError):
        first.expert()
    again = evaluator_of(folder)
    again.resume()
    assert not again.measured, "what was measured must not change what is chosen"
    (step,) = first.measured
    assert again.measure(step) == 33.5
    assert again.measured == first.measured
    assert again.rollouts.calls == 0  # type: ignore[attr-defined]
    more = replace(recipe, measure=replace(recipe.measure, rung_episodes=9))
    other = evaluator_of(replace(folder, recipe=more))
    other.resume()
    other.measure(step)
    assert other.rollouts.calls == 2  # type: ignore[attr-defined]
    (folder.path / "measured.json").write_text("{")
    with pytest.raises(OffbenchError, match=r"measured\.json is damaged"):
        again.resume()
