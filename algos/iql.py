"""IQL: Kostrikov, Nair & Levine, "Offline Reinforcement Learning with Implicit Q-Learning", ICLR 2022.

Reference: the authors' code, github.com/ikostrikov/implicit_q_learning. No action outside the data is ever evaluated:

    value    mean |expectile - 1(u < 0)| u^2,   u = min_i Q'_i(s, a) - V(s)                                   (eq. 5)
    actor    mean -min(exp(temperature (min_i Q'_i(s, a) - V(s))), 100) log pi(a | s)                         (eq. 7)
    critic   sum_i mean (r + discount (1 - terminated) V(s') - Q_i(s, a))^2                                   (eq. 6)

in this order, each with what the ones before it have just learned; the critics' targets Q' follow at the end. The
policy is a Gaussian around tanh(mean) whose std is one learned number an action, and acts with its mean.
Deviations: rewards are taken as they are (the authors scale MuJoCo's by 1000 / (best - worst return); `reward_scale`
does that); initial weights are torch.nn.Linear's, theirs are orthogonal; data actions are not clipped (theirs to
+-(1 - 1e-5)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from offbench.algorithm import Algorithm, Batch, Logs, Noise, Target, cosine_decay, minimize, per_sample, setting

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
MAX_WEIGHT = 100.0  # of a single sample


@dataclass(frozen=True)
class Config:
    """Settings of IQL (the authors' for MuJoCo)."""

    expectile: float = setting(
        0.7, "of Q that V estimates: 0.5 is the mean, near 1 the best", low=0.5, high=1, per_run=True
    )
    temperature: float = setting(3.0, "how much better actions are preferred: 0 is cloning", low=0, per_run=True)
    reward_scale: float = setting(
        1.0, "factor of rewards; the authors: 1000 / (best - worst return)", above=0, per_run=True
    )
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the critics' targets", above=0, high=1)
    learning_rate: float = setting(3e-4, "Adam's learning rate of all networks", above=0)
    decay_steps: int = setting(1_000_000, "updates in which the actor's rate falls to 0 by a cosine", low=1)
    batch_size: int = setting(256, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers of all networks", low=1)
    normalize: bool = setting(False, "normalize observations by the dataset's mean and std + 1e-3")


class IQL(Algorithm[Config]):
    """A stack of IQL runs."""

    def setup(self, c: Config) -> None:
        """Make the actor's mean and std, two critics, the value network, and the critics' target."""
        rate = cosine_decay(c.learning_rate, c.decay_steps)
        self.actor = self.actor_network(self.action_dim, rate)
        self.critic = self.critic_network(c.learning_rate, ensemble_size=2)
        self.value = self.value_network(c.learning_rate)
        self.log_std = self.parameters(self.action_dim, rate)
        self.critic_target = Target(self.critic)

    def target_q(self, batch: Batch) -> Tensor:
        """Return min_i Q'_i(s, a) of the data's actions, [runs, batch]."""
        return self.critic_target(batch.observations, batch.actions).amin(0)

    def value_loss(self, batch: Batch, c: Config) -> Logs:
        """Return V's loss, eq. 5."""
        u = self.target_q(batch) - self.value(batch.observations)  # [runs, batch]
        expectile = per_sample(c.expectile)
        weight = torch.where(u > 0, expectile, 1 - expectile)
        return {"value_loss": (weight * u.square()).mean(-1), "advantage": u.mean(-1)}

    def actor_loss(self, batch: Batch, c: Config) -> Logs:
        """Return the actor's loss, eq. 7."""
        advantage = self.target_q(batch) - self.value.frozen(batch.observations)
        weight = (per_sample(c.temperature) * advantage).exp().clamp(max=MAX_WEIGHT)
        mean = self.actor(batch.observations).tanh()
        log_std = self.log_std.value.clamp(LOG_STD_MIN, LOG_STD_MAX).unsqueeze(1)  # [runs, 1, act]
        density = -0.5 * ((batch.actions - mean) / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
        loss = -(weight * density.sum(-1)).mean(-1)
        return {"actor_loss": loss, "weight": weight.mean(-1), "std": log_std.exp().mean((-1, -2))}

    def critic_loss(self, batch: Batch, c: Config) -> Logs:
        """Return the critics' loss, eq. 6."""
        next_v = self.value.frozen(batch.next_observations)
        target = per_sample(c.reward_scale) * batch.rewards + c.discount * batch.masks * next_v
        q = self.critic(batch.observations, batch.actions)  # [critics, runs, batch]
        return {"critic_loss": (q - target).square().mean(-1).sum(0), "q_abs": q[0].abs().mean(-1)}

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        """Update V, the actor and the critics, then the critics' target."""
        c = self.config
        logs = self.value_loss(batch, c)
        self.value.minimize(logs["value_loss"])
        logs |= self.actor_loss(batch, c)
        minimize(logs["actor_loss"], self.actor, self.log_std)
        logs |= self.critic_loss(batch, c)
        self.critic.minimize(logs["critic_loss"])
        self.critic_target.polyak_update(c.tau)
        return logs
