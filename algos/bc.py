"""BC: behaviour cloning, the floor that every offline method must beat.

    loss = mean (pi(s) - a)^2

A deterministic policy, regressed on the data's actions; `top = 0.1` clones the best tenth of the episodes by return
alone ("10%BC", Chen et al., "Decision Transformer", NeurIPS 2021). The setting of TD3+BC otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from offbench.algorithm import Batch, Draw, Network, PolicyParts, setting


@dataclass(frozen=True)
class Config:
    """Settings of BC."""

    top: float = setting(
        1.0, "share of the episodes that is cloned, the best by return", above=0, high=1, per_run=True
    )
    learning_rate: float = setting(3e-4, "Adam's learning rate", above=0)
    batch_size: int = setting(256, "transitions an update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers", low=1)
    normalize: bool = setting(True, "normalise observations by the dataset's mean and std + 1e-3")


class BC:
    """A stack of BC runs."""

    Config = Config

    def __init__(
        self, config: Any, observation_dim: int, action_dim: int, run_seeds: Sequence[int], device: torch.device | str
    ) -> None:
        sizes = (observation_dim, *config.hidden, action_dim)
        self.actor = Network(sizes, run_seeds, 0, learning_rate=config.learning_rate, device=device)
        self.learned = {"actor": self.actor}

    @property
    def draws(self) -> dict[str, Draw]:
        """Nothing random beside the batch."""
        return {}

    def kind(self, step: int) -> str:
        """Every update is the same."""
        return "cloning"

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        """One update of every run."""
        pi = self.actor(batch.observations)[0].tanh()
        loss = (pi - batch.actions).square().mean(-1).mean(-1)
        self.actor.minimize(loss.sum())
        return {"bc": loss.detach()}

    def policy(self, run: int) -> PolicyParts:
        """Return the actor: tanh of its output."""
        return PolicyParts("tanh", self.actor.layers(run))
