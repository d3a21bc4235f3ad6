"""Dataset cards: what they claim is what `collect` records, bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import offbench
from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.common.files import read_json
from offbench.common.provenance import versions
from offbench.data.card import card, compare_with_card
from offbench.data.levels import LEVELS
from offbench.envs.recipes import load_recipe, shipped_recipes

CARDS = [name for name in shipped_recipes() if (load_recipe(name).folder or Path()).joinpath("card.json").exists()]


def shipped(name: str) -> Path:
    folder = load_recipe(name).folder
    assert folder is not None
    return folder


def test_every_shipped_ladder_has_a_card() -> None:
    shipped_ladders = [name for name in shipped_recipes() if (shipped(name) / "behaviour" / "ladder.json").exists()]
    assert shipped_ladders == CARDS


@pytest.mark.parametrize("name", CARDS)
def test_levels_are_in_order(name: str) -> None:
    levels = read_json(shipped(name) / "card.json")["levels"]
    assert levels.keys() == LEVELS.keys()
    means = [levels[level]["return"] for level in LEVELS]
    assert means == sorted(means)
    assert len(set(means)) == len(means)


@pytest.mark.parametrize("name", ["ant", "inverted-pendulum"])
def test_a_ladder_with_policies_within_segments_is_dense(name: str) -> None:
    """The others were trained before policies were kept within segments."""
    ladder = read_ladder(shipped(name) / "behaviour")
    assert ladder is not None
    assert 1 / 3 <= ladder.fraction(ladder.role("medium")) <= 0.45
    for tenth in range(1, 11):
        assert abs(ladder.fraction(ladder.nearest(tenth / 10)) - tenth / 10) <= 0.05


@pytest.mark.parametrize("name", CARDS)
def test_the_readme_says_what_the_card_says(name: str) -> None:
    text, known = (shipped(name) / "README.md").read_text(), read_json(shipped(name) / "card.json")
    for level, facts in known["levels"].items():
        assert f"| {level} | {facts['transitions']:,} | {facts['episodes']:,} | {facts['return']:,.1f} |" in text
        for version, content in facts["content_sha256"].items():
            assert f"| {level} | {version} | `{content}` |" in text
    assert (shipped(name) / "card.png").stat().st_size < 300_000


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CARDS if name != "inverted-pendulum"])
def test_a_shipped_replay_has_the_cards_content(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """The other levels take minutes: `offbench collect` itself says for each whether it is the card's."""
    offbench.collect(name, "medium-replay")
    assert "content equal to the dataset card's, bit for bit" in capfd.readouterr().err


@pytest.mark.slow
def test_a_card_is_made_from_the_five_levels(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Recorded and written anew it is the shipped one, content hashes included, but for the picture's bytes."""
    shipped_versions = read_json(shipped("inverted-pendulum") / "card.json")["versions"]
    same = {name: versions()[name] for name in shipped_versions} == shipped_versions
    assert same, "the tests run with the versions of constraints.txt"
    with pytest.raises(
        OffbenchError, match="inverted-pendulum-random-v0 is not recorded yet; first `offbench collect"
    ):
        card("inverted-pendulum")
    for level in LEVELS:
        offbench.collect("inverted-pendulum", level)
        assert "content equal to the dataset card's, bit for bit" in capfd.readouterr().err
    folder = card("inverted-pendulum", home / "card")
    for name in ("card.json", "README.md"):
        assert (folder / name).read_text() == (shipped("inverted-pendulum") / name).read_text()
    assert (folder / "card.png").read_bytes().startswith(b"\x89PNG")
    offbench.collect("inverted-pendulum", "random", steps=500, overwrite=True)
    with pytest.raises(OffbenchError, match="does not match the card"):
        card("inverted-pendulum")


def test_another_content_is_said_with_the_likely_reason(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = replace(load_recipe("hopper"), folder=home)

    def said(level: str, content: str) -> str:
        compare_with_card(recipe, level, content)
        return capsys.readouterr().err

    assert said("medium", "abc") == ""  # no card
    here = versions()["mujoco"]
    contents = {here: "abc", "3.4.9": "abe"}
    known = {"versions": {"numpy": versions()["numpy"]}, "levels": {"medium": {"content_sha256": contents}}}
    (home / "card.json").write_text(json.dumps(known))
    assert said("60percent", "abc") == ""  # no such level on it
    for content in contents.values():  # also the earlier MuJoCo's
        assert said("medium", content) == "offbench: content equal to the dataset card's, bit for bit\n"
    differs = "offbench: warning: content differs from the dataset card's, "
    assert said("medium", "abd").startswith(f"{differs}although the versions are the same")
    (home / "card.json").write_text(json.dumps(known | {"levels": {"medium": {"content_sha256": {"3.4.9": "abe"}}}}))
    assert said("medium", "abd") == f"{differs}which was made with mujoco 3.4.9\n"
    (home / "card.json").write_text(json.dumps(known | {"versions": {"numpy": "0.1"}}))
    assert said("medium", "abd") == f"{differs}which was made with numpy 0.1\n"


def test_an_environment_without_a_ladder_has_no_card(home: Path) -> None:
    (home / "mine.toml").write_text('env_id = "Swimmer-v5"')
    with pytest.raises(OffbenchError, match="mine has no ladder: none is shipped, and there is none in behaviour"):
        card("./mine.toml")


def test_an_environment_of_ones_own_has_a_card_too(tiny: tuple[str, str], home: Path) -> None:
    recipe, behaviour_dir = tiny
    for level in LEVELS:
        offbench.collect(recipe, level, behaviour_dir=behaviour_dir, workers=1)
    text = (card(recipe, home / "card", behaviour_dir) / "README.md").read_text()
    levels = read_json(home / "card" / "card.json")["levels"]
    assert f"| medium | {levels['medium']['transitions']:,} |" in text
    assert f"all saved policies: `{behaviour_dir}/tiny/seed-0/ladder`." in text
    assert f"Generated by `offbench card {recipe}`." in text
