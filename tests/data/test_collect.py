"""Which policy a level is recorded from, when that is refused, and what a dataset says of itself."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

import offbench
from offbench.agents.ladder import Ladder, folder_of
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.minari_reader import open_minari
from offbench.envs.recipes import load_recipe
from offbench.tools.inventory import inventory, sections


def metadata_of(dataset_id: str) -> dict[str, Any]:
    return minari_store.read_metadata(dataset_id)


@pytest.fixture
def ladder_at(tiny: tuple[str, str], home: Path) -> Callable[[dict[str, float]], tuple[str, Path]]:
    """Make a ladder of the tiny agent whose table says that its rungs have these fractions of the expert."""

    def make(fractions: dict[str, float]) -> tuple[str, Path]:
        recipe, behaviour_dir = tiny
        behaviour = home / "edited"
        source = folder_of(load_recipe(recipe), 0, Path(behaviour_dir)) / "ladder"
        folder = folder_of(load_recipe(recipe), 0, behaviour) / "ladder"
        shutil.copytree(source, folder, dirs_exist_ok=True)
        references = json.loads((folder / "ladder.json").read_text())["references"]
        low, high = (references[name]["return"] for name in ("random", "expert"))
        policy = next((folder / "policies").iterdir()).name
        lines = ["step,role,policy,return,low,high,episodes"]
        for step, (role, fraction) in enumerate(fractions.items(), 1):
            value = low + fraction * (high - low)
            name = role if role in ("medium", "expert") else ""
            lines.append(f"{step * 100},{name},{policy},{value},{value},{value},8")
        (folder / "ladder.csv").write_text("\n".join(lines) + "\n")
        return recipe, behaviour

    return make


def test_a_fraction_that_no_policy_is_near_is_refused_with_the_nearest(
    ladder_at: Callable[[dict[str, float]], tuple[str, Path]], capfd: pytest.CaptureFixture[str]
) -> None:
    recipe, folder = ladder_at({"medium": 0.36, "a": 0.72, "expert": 1.0})
    with pytest.raises(
        OffbenchError, match=r"no policy within 0.05 of 0.6 of the expert.*: 0.36 and 0.72; .*--accept"
    ):
        offbench.collect(recipe, "0.6", steps=200, behaviour_dir=folder, workers=1)
    assert not minari_store.exists("tiny-60percent-v0")
    with pytest.raises(
        OffbenchError, match=r"no policy within 0.05 of 0.1 of the expert's return; the nearest: 0.36;"
    ):
        offbench.collect(recipe, mix="random:0.5,0.1:0.5", steps=200, behaviour_dir=folder, workers=1)
    with pytest.raises(SystemExit) as stopped:
        main(["collect", recipe, "--level", "0.6", "--steps", "200", "--behaviour-dir", str(folder)])
    assert stopped.value.code == 2
    capfd.readouterr()
    words = ["collect", recipe, "--level", "0.6", "--steps", "200", "--behaviour-dir", str(folder), "--workers", "1"]
    main([*words, "--accept"])
    assert "the policy nearest 0.6 is the one of step 200" in capfd.readouterr().err
    recorded = metadata_of("tiny-60percent-v0")
    assert "at 0.72 of the expert's return" in recorded["description"]
    assert recorded["offbench"]["parts"][0]["fraction"] == 0.72


def test_the_fractions_that_are_named_are_recorded(
    ladder_at: Callable[[dict[str, float]], tuple[str, Path]],
) -> None:
    recipe, folder = ladder_at({"medium": 0.36, "a": 0.72, "expert": 1.0})
    for level, fraction in (("0.36", 0.36), (0.72, 0.72), ("0.75", 0.72)):
        name = offbench.collect(Path(recipe), level, steps=200, behaviour_dir=folder, workers=1)
        assert metadata_of(name)["offbench"]["parts"][0]["fraction"] == fraction


@pytest.mark.parametrize(("fraction", "refused"), [(0.14, True), (0.25, False), (0.65, True)])
def test_a_medium_far_from_its_definition_is_refused(
    ladder_at: Callable[[dict[str, float]], tuple[str, Path]],
    capfd: pytest.CaptureFixture[str],
    fraction: float,
    refused: bool,
) -> None:
    """Levels that are made of the medium policy, or of the training up to it; random and expert are not."""
    recipe, folder = ladder_at({"medium": fraction, "expert": 1.0})
    kwargs: dict[str, Any] = {"steps": 200, "behaviour_dir": folder, "workers": 1}
    for level in ("medium", "medium-replay", "medium-expert"):
        if refused:
            with pytest.raises(
                OffbenchError, match=rf"medium of tiny is at {fraction} of .*, far from 0.33; .*--accept"
            ):
                offbench.collect(recipe, level, **kwargs)
        offbench.collect(recipe, level, accept=refused, **kwargs)
        assert f"at {fraction} of the expert's return" in metadata_of(f"tiny-{level}-v0")["description"]
        assert "no policy of the training is at 0.33 to 0.45" in capfd.readouterr().err
    for level in ("random", "expert"):
        offbench.collect(recipe, level, **kwargs)


def test_a_short_recording_says_that_it_is(tiny: tuple[str, str]) -> None:
    """The recipe's levels have 600 transitions, medium-expert twice as many."""
    recipe, behaviour_dir = tiny
    kwargs: dict[str, Any] = {"behaviour_dir": behaviour_dir, "workers": 1}
    offbench.collect(recipe, "medium", steps=500, **kwargs)
    offbench.collect(recipe, "expert", **kwargs)
    offbench.collect(recipe, "medium-expert", steps=600, **kwargs)
    offbench.collect(recipe, "medium-replay", **kwargs)
    short = {name: data["short_of"] for name, data in inventory()["datasets"].items()}
    assert short == {
        "tiny-medium-v0": 600,
        "tiny-expert-v0": None,
        "tiny-medium-expert-v0": 1200,
        "tiny-medium-replay-v0": None,
    }
    assert "A short recording: 500 of 600 transitions." in metadata_of("tiny-medium-v0")["description"]
    assert metadata_of("tiny-medium-v0")["offbench"]["full_size"] == 600
    assert "short" not in metadata_of("tiny-expert-v0")["description"]
    ((_, _, rows),) = sections(inventory("datasets"))
    assert ["tiny-medium-v0", "500 of 600"] in [row[:2] for row in rows]


def test_random_actions_need_no_agent(tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its content and its reference are those of a recording after the training; the expert's is not known yet."""
    recipe, behaviour_dir = tiny
    monkeypatch.setitem(sys.modules, "offbench.agents.sac", None)  # importing it fails
    offbench.collect(recipe, "random", workers=1)
    offbench.collect(recipe, mix="random:1", dataset_id="mixed-v0", workers=1)
    assert not (home / "behaviour").exists()
    before = metadata_of("tiny-random-v0")
    assert "ref_max_score" not in before
    assert set(before["offbench"]["references"]) == {"random"}
    assert offbench.verify("tiny-random-v0", workers=1).ok
    assert offbench.load("tiny-random-v0").references is None
    offbench.collect(recipe, "random", dataset_id="after-v0", behaviour_dir=behaviour_dir, workers=1)
    after = metadata_of("after-v0")
    assert after["offbench"]["content_sha256"] == before["offbench"]["content_sha256"]
    assert after["ref_min_score"] == before["ref_min_score"]
    assert after["offbench"]["references"]["random"] == before["offbench"]["references"]["random"]
    assert np.isclose(after["ref_max_score"], after["offbench"]["references"]["expert"]["return"])
    assert metadata_of("mixed-v0")["offbench"]["content_sha256"] == before["offbench"]["content_sha256"]


def test_a_dataset_that_minari_has_changed_does_not_count_as_recorded(tiny: tuple[str, str]) -> None:
    offbench.collect(tiny[0], "random", steps=100, workers=1)
    data = open_minari("tiny-random-v0")
    (found,) = data.sample_episodes(1)
    flags = {"terminations": found.terminations, "truncations": found.truncations}
    arrays = {"observations": found.observations, "actions": found.actions, "rewards": found.rewards}
    data.update_dataset_from_buffer([EpisodeBuffer(id=None, infos={}, **arrays, **flags)])
    with pytest.raises(OffbenchError, match="record it again with --overwrite, or download it again"):
        offbench.load("tiny-random-v0")
    with pytest.raises(OffbenchError, match=r"exists already .* use --overwrite to replace it"):
        offbench.collect(tiny[0], "random", steps=100, workers=1)
    offbench.collect(tiny[0], "random", steps=100, overwrite=True, workers=1)
    assert len(offbench.load("tiny-random-v0")) == 100


def test_no_dataset_is_recorded_inside_another(home: Path, tiny: tuple[str, str]) -> None:
    offbench.collect(tiny[0], "random", dataset_id="a-v0", workers=1)
    with pytest.raises(OffbenchError, match="a-v0/b-v0 would share a folder with a-v0; choose another id"):
        offbench.collect(tiny[0], "random", dataset_id="a-v0/b-v0", workers=1)
    shutil.copytree(home / "minari" / "a-v0", home / "minari" / "a-v0" / "b-v0")
    with pytest.raises(OffbenchError, match="a-v0 would share a folder with a-v0/b-v0"):
        offbench.collect(tiny[0], "random", dataset_id="a-v0", overwrite=True, workers=1)
    assert minari_store.exists("a-v0/b-v0")


def test_a_recipe_that_measures_otherwise_than_its_agent_was_is_noted(
    home: Path, tiny: tuple[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    recipe = home / "tiny.toml"
    recipe.write_text("replay_envs = 1\n" + Path(tiny[0]).read_text())
    offbench.collect(recipe, "medium", behaviour_dir=tiny[1], workers=1)
    assert "measured with other settings than the recipe's (replay_envs)" in capfd.readouterr().err


def training(*_: object, **__: object) -> None:
    """Stand in for a training."""
    raise OffbenchError("training")


def test_agents_of_other_seeds_are_named(
    home: Path, tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(tiny[1], home / "behaviour")
    (home / "behaviour" / "tiny" / "seed-0").rename(home / "behaviour" / "tiny" / "seed-3")
    monkeypatch.setattr("offbench.agents.behaviour.behaviour", training)
    with pytest.raises(OffbenchError, match="training"):
        offbench.collect(tiny[0], "medium", workers=1)
    assert "no behaviour agent of seed 0 (there is seed-3" in capfd.readouterr().err


def test_random_is_recorded_once(tiny: tuple[str, str], capfd: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        offbench.collect(tiny[0], "random", workers=1)
    assert "is recorded already" in capfd.readouterr().err


def test_another_spelling_of_a_level_is_the_same_dataset(
    tiny: tuple[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    for level in ("random:0.5,medium:0.5", "random:0.50, medium:0.5"):
        offbench.collect(tiny[0], mix=level, behaviour_dir=tiny[1], workers=1)
    assert "is recorded already" in capfd.readouterr().err


def test_retrain_trains_for_random_too(tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its expert reference is the agent's."""
    monkeypatch.setattr("offbench.agents.behaviour.behaviour", training)
    with pytest.raises(OffbenchError, match="training"):
        offbench.collect("inverted-pendulum", "random", retrain=True, workers=1)


def test_a_shipped_agent_is_said_where_another_folder_is_named(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    offbench.collect("inverted-pendulum", "medium", steps=200, behaviour_dir=home / "mine", workers=1)
    assert "using the behaviour agent shipped with offbench, not one in" in capfd.readouterr().err


def test_neighbors_of_a_fraction(ladder_at: Callable[[dict[str, float]], tuple[str, Path]]) -> None:
    from offbench.agents.ladder import read_ladder

    recipe, folder = ladder_at({"a": 0.9, "medium": 0.36, "b": 0.1, "expert": 1.0})
    ladder = read_ladder(folder_of(load_recipe(recipe), 0, folder) / "ladder")
    assert isinstance(ladder, Ladder)
    for fraction, expected in ((0.5, [0.36, 0.9]), (0.05, [0.1]), (1.2, [1.0])):
        assert [round(ladder.fraction(rung), 6) for rung in ladder.neighbors(fraction)] == expected
