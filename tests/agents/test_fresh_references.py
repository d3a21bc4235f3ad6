"""The references of a ladder are measured in episodes that chose no policy."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from offbench.agents.build_ladder import RungEvaluator, build_ladder
from offbench.agents.ladder import folder_of
from offbench.agents.training_folder import TrainingFolder
from offbench.common.seeds import Purpose
from offbench.envs.recipes import load_recipe
from offbench.rollouts.policy import Policy
from offbench.rollouts.rollouts import EpisodeStats


def test_the_experts_reference_is_of_fresh_episodes(
    tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Policies return a tenth of their step in the search, and 1,000 in the one measurement of more episodes."""
    recipe = load_recipe(tiny[0])
    folder = TrainingFolder(recipe, 0, home / "training")
    trained = folder_of(recipe, 0, Path(tiny[1]))
    shutil.copytree(trained, folder.path, ignore=shutil.ignore_patterns("ladder", "measured.json"))
    runs: list[tuple[int, tuple[int, ...], int, bool]] = []

    def run(
        self: RungEvaluator, policy: Policy, stream: tuple[int, ...], count: int, deterministic: bool = False
    ) -> list[EpisodeStats]:
        step: int = policy.origin["step"]
        runs.append((step, stream, count, deterministic))
        base = 1000.0 if count == recipe.measure.reference_episodes else step / 10
        return [EpisodeStats(base + i, 9) for i in range(count)]

    monkeypatch.setattr(RungEvaluator, "run", run)
    build_ladder(folder, 2400, home / "ladder", 0, "")
    info = json.loads((home / "ladder" / "ladder.json").read_text())
    references = [played for played in runs if played[2] == recipe.measure.reference_episodes]
    assert references == [(info["levels"]["expert"], (int(Purpose.REFERENCE), 1), 20, False)]
    streams = [stream for _, stream, _, _ in runs]
    assert len(set(streams)) == len(streams) > 4
    assert (int(Purpose.REFERENCE), 0) not in streams, "the random policy's episodes"
    assert info["references"]["expert"]["return"] == 1009.5
