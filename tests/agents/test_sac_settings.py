"""A recipe's settings of SAC are those that the agent is trained with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import SAC

from offbench.agents import sac
from offbench.agents.training_folder import TrainingFolder
from offbench.envs.recipes import Recipe, SACSettings

# segments begin at steps 0, 400 and 800 of 800: the fractions 0, 1/2 and 1
SETTINGS = SACSettings(
    steps=800,
    segment=400,
    envs=1,
    gradient_steps=0.02,
    learning_starts=100,
    learning_rate=5e-3,
    final_learning_rate=1e-3,
    batch_size=16,
    hidden=(8,),
    discount=0.9,
    tau=0.25,
    rung_episodes=2,
)


def test_discount_tau_and_learning_rate_are_the_recipes(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, update = Recipe("tiny", "InvertedPendulum-v5", sac=SETTINGS), SAC.train
    used: dict[int, set[Any]] = {}

    def noted(model: SAC, *args: Any, **kwargs: Any) -> None:
        update(model, *args, **kwargs)
        optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
        rates = [round(group["lr"], 9) for optimizer in optimizers if optimizer for group in optimizer.param_groups]
        sizes = (model.batch_size, *model.policy.net_arch)
        used.setdefault((model.num_timesteps - 1) // 400, set()).add((model.gamma, model.tau, *sizes, *rates))

    monkeypatch.setattr(SAC, "train", noted)
    monkeypatch.setattr(sac, "_measure_gradient_step", lambda *_: 1e-3)
    sac.train(TrainingFolder(recipe, 0, home / "training"), 1200)
    assert used == {i: {(0.9, 0.25, 16, 8, *[rate] * 3)} for i, rate in enumerate((5e-3, 3e-3, 1e-3))}
