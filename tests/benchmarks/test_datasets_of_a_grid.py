"""Datasets that are not what their id says, and ladders that are no longer what datasets were recorded from."""

from __future__ import annotations

import dataclasses
import json
import shlex
import shutil
from pathlib import Path

import pytest

import offbench
from offbench.agents.behaviour import behaviour
from offbench.agents.ladder import find_ladder, read_ladder
from offbench.benchmarks.datasets import check_recorded
from offbench.benchmarks.grid import Grid, GridDataset, load_grid
from offbench.benchmarks.plan import prepare
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data.card import card
from offbench.data.other_references import warn_other_references
from offbench.envs.recipes import load_recipe

AGAIN = r"record it again \(`offbench collect .* --overwrite`\)"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, ""),
        ({"steps": 600}, ""),
        ({"steps": 1000}, "it has 600 transitions, not 1,000"),
        ({"level": "expert"}, "level medium, not expert"),
        ({"seed": 3}, "seed 0, not 3"),
        ({"env": "hopper"}, "environment InvertedPendulum-v5, not Hopper-v5, 600 transitions, not 1,000,000"),
    ],
)
def test_a_grids_dataset_must_be_what_the_grid_would_record(
    medium: str, tiny: tuple[str, str], changes: dict[str, object], message: str
) -> None:
    source = dataclasses.replace(GridDataset(medium, tiny[0], "medium"), **changes)  # type: ignore[arg-type]
    if not message:
        check_recorded(source)
        return
    with pytest.raises(OffbenchError, match=f"{message}.*{AGAIN}"):
        check_recorded(source)


def test_a_grids_dataset_must_have_the_recipes_contact_margins(medium: str, tiny: tuple[str, str], home: Path) -> None:
    recipe = home / "other" / "tiny.toml"
    recipe.parent.mkdir()
    recipe.write_text('contact_margin = "sum"\n' + Path(tiny[0]).read_text())
    with pytest.raises(OffbenchError, match="it has contact_margin max, not sum"):
        check_recorded(GridDataset(medium, str(recipe), "medium"))


def test_a_shipped_grid_is_not_run_on_a_small_dataset_of_the_same_id(capsys: pytest.CaptureFixture[str]) -> None:
    """What a newcomer has after trying `collect` with a few steps."""
    offbench.collect("hopper", "random", steps=300, workers=1)
    for words in (["--plan"], []):
        with pytest.raises(SystemExit) as stopped:
            main(["benchmark", "paper-small", *words])
        assert stopped.value.code == 2
        said = capsys.readouterr().err
        assert "hopper-random-v0" in said
        assert "300 transitions, not 1,000,000" in said
        assert "--overwrite" in said


def test_others_datasets_are_taken_as_they_are(medium: str, tiny: tuple[str, str]) -> None:
    """Without offbench's metadata nothing but the environment can be compared."""
    path = next(Path().glob("minari/*/data/metadata.json"))
    metadata = json.loads(path.read_text())
    del metadata["offbench"]
    path.write_text(json.dumps(metadata))
    check_recorded(GridDataset(medium, tiny[0], "expert", 10))
    with pytest.raises(OffbenchError, match="environment InvertedPendulum-v5, not Hopper-v5"):
        check_recorded(GridDataset(medium, "hopper", "medium"))


def test_a_recipe_does_not_take_a_shipped_ones_name(home: Path) -> None:
    recipe = home / "hopper.toml"
    recipe.write_text('env_id = "Swimmer-v5"')
    with pytest.raises(OffbenchError, match=r"hopper is a shipped environment, Hopper-v5.*another name"):
        load_recipe(str(recipe))
    recipe.write_text('env_id = "Hopper-v5"\n[sac]\nenvs = 2')  # the same environment, trained otherwise
    assert load_recipe(str(recipe)).name == "hopper"


def test_datasets_of_an_older_ladder_are_named(
    medium: str, tiny: tuple[str, str], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Scores of two ladders' references are no one scale."""
    recipe = load_recipe(tiny[0])
    shutil.copytree(tiny[1], home / "behaviour")
    ladder = find_ladder(recipe, home / "behaviour")
    assert ladder is not None
    warn_other_references(recipe, ladder)
    assert "warning" not in capsys.readouterr().err
    # a shorter ladder of the same training: another expert
    shorter = behaviour(recipe, steps=1600, workers=1)
    warn_other_references(recipe, shorter)
    assert shorter.expert_return != ladder.expert_return
    said = capsys.readouterr().err
    assert f"scores of tiny are now from {shorter.random_return:.1f} to {shorter.expert_return:.1f}" in said
    assert f"not to be compared with: {medium}; record them again with --overwrite" in said
    offbench.collect(tiny[0], "random", workers=1)
    assert f"not to be compared with: {medium};" in capsys.readouterr().err


def test_another_recipe_than_the_agent_was_trained_by_is_said(
    tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = load_recipe(tiny[0])
    changed = dataclasses.replace(recipe, sac=dataclasses.replace(recipe.sac, batch_size=32, hidden=(8,)))
    for one, words in ((recipe, ""), (changed, "other [sac] settings than the recipe's (batch_size, hidden)")):
        assert find_ladder(one, Path(tiny[1])) is not None
        said = capsys.readouterr().err
        assert (words in said) if words else ("[sac]" not in said)


def test_a_ladder_that_lacks_a_policy_is_damaged(tiny: tuple[str, str], home: Path) -> None:
    shutil.copytree(Path(tiny[1]) / "tiny" / "seed-0" / "ladder", home / "ladder")
    next((home / "ladder" / "policies").iterdir()).unlink()
    with pytest.raises(OffbenchError, match=r"is damaged .*it lacks policies/.*delete .*ladder and build it again"):
        read_ladder(home / "ladder")


def test_a_card_of_ones_own_looks_where_the_agent_was_trained(tiny: tuple[str, str]) -> None:
    with pytest.raises(OffbenchError, match="tiny has no ladder: none is shipped, and there is none in behaviour"):
        card(tiny[0])
    with pytest.raises(OffbenchError, match="tiny-random-v0 is not recorded yet") as refused:
        card(tiny[0], behaviour_dir=tiny[1])
    hint = str(refused.value).partition("`")[2].partition("`")[0]
    main(shlex.split(hint)[1:])  # as it can be pasted
    with pytest.raises(OffbenchError, match="tiny-medium-replay-v0 is not recorded yet"):
        card(tiny[0], behaviour_dir=tiny[1])


ENTRIES = 'seeds = 1\nsteps = 20\neval_every = 20\neval_episodes = 1\n[[algorithms]]\nname = "bc"\nhidden = [8]\n'


def grid_of(dataset: str) -> Grid:
    Path("mine.toml").write_text(f"datasets = [{dataset}]\n{ENTRIES}")
    return load_grid("./mine.toml")


@pytest.mark.parametrize(
    ("dataset", "source"),
    [
        ('{id = "hopper-expert-v0", steps = 500}', ("hopper", "expert", 500)),
        ('{id = "my-random-v0", env = "hopper", steps = 500}', ("hopper", "random", 500)),
        ('{id = "my-30percent-v0", env = "hopper"}', ("hopper", "0.3", None)),
        ('{id = "mine-v0", env = "hopper"}', ("hopper", "medium", None)),
        ('{id = "mine-v0", env = "hopper", level = "0.3"}', ("hopper", "0.3", None)),
        ('"hopper-medium-v2"', ("", "", None)),
    ],
)
def test_a_table_may_leave_out_what_the_id_names(
    dataset: str, source: tuple[str, str, int | None], home: Path
) -> None:
    (read,) = grid_of(dataset).datasets
    assert (read.env, read.level, read.steps) == source


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        ('{id = "hopper-random-v0", level = "medium"}', "the id hopper-random-v0 names the level random, not medium"),
        (
            '{id = "my-random-v0", env = "hopper", level = "0.3"}',
            "the id my-random-v0 names the level random, not 0.3",
        ),
        ('{id = "theirs-v2", steps = 500}', "theirs-v2 needs env"),
        ('"hopper-mediun-v0"', "unknown level 'mediun'"),
        ('{id = "hopper-random-v0", steps = -1}', "steps must be at least 1, not -1"),
        ('{id = "hopper-random-v0", seed = -1}', "seed must be at least 0, not -1"),
    ],
)
def test_an_id_that_contradicts_its_table_is_refused(dataset: str, message: str, home: Path) -> None:
    with pytest.raises(OffbenchError, match=message):
        grid_of(dataset)


def test_a_recorded_blend_is_used_by_its_id(home: Path) -> None:
    name = offbench.collect("inverted-pendulum", mix="random:0.5,expert:0.5", steps=200, workers=1)
    assert grid_of(f'"{name}"').datasets == (GridDataset(name),)
    assert prepare("./mine.toml").missing() == []
