"""`verify` names observations out of bounds, episodes beyond the time limit, and levels whose numbers disagree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import offbench
from offbench.common.files import JsonObject
from offbench.data import minari_store
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.envs.environments import env_spec
from offbench.verification.verify import verify
from tests.made_datasets import episode, foreign
from tests.verification.test_verify import change_metadata, codes, tamper


@pytest.mark.parametrize("start", [-1e-6, 2.000001])
def test_observations_outside_their_space(start: float) -> None:
    """In a space of [0, 11], whose ends are inside. An episode's numbers are its start and nine more, 1 apart."""
    box = gym.spaces.Box(0.0, 11.0, (2,), np.float64)
    assert codes(foreign("inside-v0", [episode(4, 0, True), episode(4, 2, True)], box)) == set()
    report = verify(foreign("outside-v0", [episode(4, 0, True), episode(4, start, True)], box), workers=1)
    assert [(finding.code, finding.where) for finding in report.findings] == [("outside-space", "episode 1")]


def test_episodes_longer_than_the_time_limit(medium: str) -> None:
    lengths = [len(e) for e in episodes_of(open_minari(medium))]
    longest = max(lengths)
    where = ", ".join(f"episode {i}" for i, length in enumerate(lengths) if length == longest)
    change_metadata(medium, env_spec=env_spec("InvertedPendulum-v5", max_episode_steps=longest))
    assert "too-long" not in codes(medium, episodes=0)
    change_metadata(medium, env_spec=env_spec("InvertedPendulum-v5", max_episode_steps=longest - 1))
    findings = {finding.code: finding for finding in verify(medium, workers=1, episodes=0).findings}
    assert findings["too-long"].where == where
    assert f"{longest} steps, the limit is {longest - 1}" in findings["too-long"].what


def test_a_dataset_without_a_transition(medium: str) -> None:
    def edit(file: Any) -> None:
        for name in list(file):
            del file[name]

    assert "empty" in codes(tamper(medium, edit))


@pytest.fixture
def medium_expert(tiny: tuple[str, str]) -> str:
    return offbench.collect(tiny[0], "medium-expert", behaviour_dir=tiny[1], workers=1)


def swap(parts: list[JsonObject], *keys: str) -> None:
    for key in keys:
        parts[0][key], parts[1][key] = parts[1][key], parts[0][key]


def swap_returns(parts: list[JsonObject]) -> None:
    swap(parts, "return", "interval", "fraction")


def lower_the_experts_return(parts: list[JsonObject]) -> None:
    parts[1] |= {"return": parts[0]["return"] - 1e-3, "fraction": parts[0]["fraction"]}


def swap_fractions(parts: list[JsonObject]) -> None:
    swap(parts, "fraction")


def change_a_fraction(parts: list[JsonObject]) -> None:
    parts[1]["fraction"] += 0.02


@pytest.mark.parametrize(
    ("edit", "where"),
    [
        (swap_returns, "metadata"),
        (lower_the_experts_return, "metadata"),
        (swap_fractions, "part medium, part expert"),
        (change_a_fraction, "part expert"),
    ],
)
def test_levels_whose_numbers_disagree(
    edit: Callable[[list[JsonObject]], None], where: str, medium_expert: str
) -> None:
    """Returns that fit their fractions but are out of order, and fractions that are not those of the returns."""
    parts = minari_store.read_provenance(minari_store.read_metadata(medium_expert)).parts
    assert parts is not None
    edit(list(parts))
    change_metadata(medium_expert, parts=parts)
    found = {finding.code: finding.where for finding in verify(medium_expert, workers=1, episodes=0).findings}
    assert found["level-order"] == where
    assert found.keys() <= {"level-order", "wrong-level"}  # swapped returns are not those of the episodes either


def test_a_medium_level_as_good_as_the_expert(medium: str) -> None:
    provenance = minari_store.read_provenance(minari_store.read_metadata(medium))
    assert provenance.parts is not None
    best = provenance.references["expert"]["return"]
    change_metadata(medium, parts=[provenance.parts[0] | {"return": best, "fraction": 1.0}])
    found = {finding.code: finding.where for finding in verify(medium, workers=1, episodes=0).findings}
    assert found["level-order"] == "metadata"


def test_a_random_reference_above_the_experts(medium: str) -> None:
    references = minari_store.read_provenance(minari_store.read_metadata(medium)).references
    random = references["random"] | {"return": 2 * references["expert"]["return"]}
    change_metadata(medium, references=references | {"random": random})
    found = {finding.code: finding.where for finding in verify(medium, workers=1, episodes=0).findings}
    assert found["level-order"] == "metadata, part medium"  # which is a fraction of the distance between the two
