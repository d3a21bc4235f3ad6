"""Plain cloning, cloning of the best episodes alone, and the similar score of Table 2."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.evaluation.similarity import similarity
from offbench.rollouts.policy import read_policy_file
from offbench.training.restore import restore
from offbench.training.run import Run
from tests.made_datasets import episode, foreign

SMALL: dict[str, Any] = {"hidden": (32, 32), "batch_size": 64, "eval_every": 500, "eval_episodes": 2}


def two_kinds_of_episodes() -> str:
    """Nine poor episodes whose actions are the lower bound, one good one whose actions are the upper bound."""
    low, high = np.array([[-2.0, 0.0]], np.float32), np.array([[2.0, 10.0]], np.float32)
    poor = [episode(20, 0, True, actions=np.repeat(low, 20, 0), rewards=np.zeros(20)) for _ in range(9)]
    good = episode(20, 0, True, actions=np.repeat(high, 20, 0), rewards=np.ones(20))
    return foreign("kinds-v0", [*poor[:4], good, *poor[4:]])


def test_the_best_episodes_by_return() -> None:
    data = offbench.load(two_kinds_of_episodes())
    np.testing.assert_array_equal(data.best(0.1), np.arange(80, 100))
    assert len(data.best(1.0)) == 200
    np.testing.assert_array_equal(data.best(1e-9), data.best(0.1))  # one episode at least


def test_bc_clones_the_data_and_top_the_best_of_it() -> None:
    name = two_kinds_of_episodes()
    whole, top = offbench.train("bc", name, steps=500, top=[1.0, 0.1], learning_rate=3e-3, **SMALL)
    data = offbench.load(name)
    states = data.observations[data.rows[:20]]
    all_actions, top_actions = (read_policy_file(f / "policy.safetensors").act(states, None) for f in (whole, top))
    # squared error over nine parts low and one part high: the mean, -0.8 of the half span
    np.testing.assert_allclose(all_actions.mean(0), [-1.6, 1.0], atol=0.3)
    np.testing.assert_allclose(top_actions.mean(0), [2.0, 10.0], atol=0.2)


def test_similar_score_by_hand(medium: str) -> None:
    """Of samples that another seed draws, the scores are others."""
    (folder,) = offbench.train("td3_bc", medium, steps=300, **SMALL)
    stack, data = restore(Run(folder)), offbench.load(medium)
    critic: Any = stack.algorithm.learned["critic"]
    policy, (mean, std) = read_policy_file(folder / "policy.safetensors"), data.normalizer()
    found = []
    for seed in (0, 5):
        score = similarity(folder, samples=400, tolerance=0.02, action_tolerance=0.3, seed=seed)
        assert json.loads((folder / "similarity.json").read_text()) == dataclasses.asdict(score)
        rng = np.random.default_rng(np.random.SeedSequence([seed, 11]))
        chosen = rng.integers(len(data), size=(1, 400))[0]
        states, actions = data.observations[data.rows[chosen]], data.actions[chosen]
        pi = policy.act(states, None) / 3  # the pendulum's actions span [-3, 3]
        inputs = torch.from_numpy((states - mean) / std).unsqueeze(0)
        q_pi, q = (critic(inputs, torch.from_numpy(a).unsqueeze(0))[0, 0].detach().numpy() for a in (pi, actions))
        assert score.q_similar == pytest.approx(100 * np.mean(np.abs(q_pi - q) <= 0.02 * np.abs(q)), abs=0.3)
        distance = np.sqrt(((pi - actions) ** 2).mean(1))
        assert score.action_similar == pytest.approx(100 * np.mean(distance <= 0.3), abs=0.3)
        assert 0 < score.action_similar < 100
        found.append(score)
    assert abs(found[0].action_similar - found[1].action_similar) > 1  # more than the tolerance of both


def test_similarity_on_the_command_line(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [str(folder) for folder in offbench.train("bdb", medium, seeds=[0, 1], steps=20, **SMALL)]
    capsys.readouterr()
    main(["evaluate", *folders, "--similarity"])
    out = capsys.readouterr().out
    assert out.count("by Q") == out.count("by action") == 2
    assert all(folder in out for folder in folders)
    (bc,) = offbench.train("bc", medium, steps=20, **SMALL)
    main(["evaluate", str(bc), folders[0], "--similarity", "--tolerance", "0"])
    out, err = capsys.readouterr()
    assert folders[0] in out
    assert "(within 0% of |Q1(s, a)|)" in out
    assert f"left out: {bc}: bc has no critic" in " ".join(err.split())
    with pytest.raises(SystemExit) as stopped:
        main(["evaluate", str(bc), str(bc), "--similarity"])
    assert stopped.value.code == 2


def test_similarity_needs_a_critic_and_its_dataset(tiny: tuple[str, str], medium: str) -> None:
    (bc,) = offbench.train("bc", medium, steps=20, **SMALL)
    with pytest.raises(OffbenchError, match="bc has no critic"):
        similarity(bc)
    (run,) = offbench.train("td3_bc", medium, steps=20, **SMALL)
    offbench.collect(tiny[0], "medium", behaviour_dir=tiny[1], workers=1, seed=4, overwrite=True)
    with pytest.raises(OffbenchError, match="no longer the dataset"):
        similarity(run)
    with pytest.raises(OffbenchError, match="no run in nowhere"):
        similarity(Path("nowhere"))
