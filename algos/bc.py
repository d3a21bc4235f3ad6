"""BC: behaviour cloning, the baseline that every offline method should beat.

    loss = mean (pi(s) - a)^2

A deterministic policy, regressed on the data's actions; `top = 0.1` clones the best tenth of the episodes by return
only, as "10%BC" of Chen et al., "Decision Transformer", NeurIPS 2021, which counts transitions instead of episodes.
Otherwise the settings of TD3+BC.
"""

from __future__ import annotations

from dataclasses import dataclass

from offbench.algorithm import Algorithm, Batch, Logs, Noise, setting


@dataclass(frozen=True)
class Config:
    """Settings of BC."""

    top: float = setting(
        1.0, "share of the episodes that is cloned, the best by return", above=0, high=1, per_run=True
    )
    learning_rate: float = setting(3e-4, "Adam's learning rate", above=0)
    batch_size: int = setting(256, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers", low=1)
    normalize: bool = setting(True, "normalize observations by the dataset's mean and std + 1e-3")


class BC(Algorithm[Config]):
    """A stack of BC runs."""

    def setup(self, c: Config) -> None:
        """Make the actor."""
        self.actor = self.actor_network(self.action_dim, c.learning_rate)

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        """Update the actor."""
        pi = self.actor(batch.observations).tanh()
        loss = (pi - batch.actions).square().mean(-1).mean(-1)
        self.actor.minimize(loss)
        return {"bc": loss}
