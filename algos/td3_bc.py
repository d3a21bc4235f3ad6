"""TD3+BC: Fujimoto & Gu, "A Minimalist Approach to Offline Reinforcement Learning", NeurIPS 2021.

Reference: the authors' code, github.com/sfujim/TD3_BC. TD3 whose actor is also held to the data's actions:

    critic   y = r + discount (1 - terminated) min_i Q'_i(s', clip(pi'(s') + clip(noise)))
             loss = sum_i mean (Q_i(s, a) - y)^2
    actor    loss = -lambda mean Q_1(s, pi(s)) + mean (pi(s) - a)^2,   lambda = alpha / mean |Q_1(s, pi(s))|

The actor and all targets are updated at every `policy_freq`-th update only. Deviations: actions are scaled to
[-1, 1], so the noise needs no factor of the largest action, and cloning errors count in those units (the same where
the bounds are 1, as in the locomotion tasks); the initial weights come from NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from offbench.algorithm import Algorithm, Batch, Logs, Noise, NoiseSpec, Target, normal, setting


@dataclass(frozen=True)
class Config:
    """Settings of TD3+BC (the BDB paper's Table 3, the authors' defaults)."""

    alpha: float = setting(2.5, "weight of Q against the constraint: lambda = alpha / mean|Q1|", low=0, per_run=True)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the targets", above=0, high=1)
    policy_noise: float = setting(0.2, "std of the noise on target actions, in units of the largest action", low=0)
    noise_clip: float = setting(0.5, "that noise is clipped to +- this", low=0)
    policy_freq: int = setting(2, "updates of the critics for each of the actor and targets", low=1)
    actor_learning_rate: float = setting(3e-4, "Adam's learning rate of the actor", above=0)
    critic_learning_rate: float = setting(3e-4, "Adam's learning rate of the critics", above=0)
    batch_size: int = setting(256, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers of actor and critics", low=1)
    normalize: bool = setting(True, "normalize observations by the dataset's mean and std + 1e-3")


class TD3BC(Algorithm[Config]):
    """A stack of TD3+BC runs."""

    def setup(self, c: Config) -> None:
        """Make the actor, two critics, and the target of each."""
        self.actor = self.actor_network(self.action_dim, c.actor_learning_rate)
        self.critic = self.critic_network(c.critic_learning_rate, ensemble_size=2)
        self.actor_target, self.critic_target = Target(self.actor), Target(self.critic)

    def noise_spec(self, c: Config) -> NoiseSpec:
        """Return one normal number for each target action."""
        return {"target": normal(c.batch_size, self.action_dim)}

    def phase(self, step: int) -> bool:
        """Return whether the actor and the targets are updated too."""
        return (step + 1) % self.config.policy_freq == 0

    def critic_loss(self, batch: Batch, noise: Tensor, c: Config) -> Logs:
        """Return the critics' loss."""
        with torch.no_grad():
            noise = (noise * c.policy_noise).clamp(-c.noise_clip, c.noise_clip)
            next_actions = (self.actor_target(batch.next_observations).tanh() + noise).clamp(-1, 1)
            next_q = self.critic_target(batch.next_observations, next_actions).amin(0)
            target = batch.rewards + c.discount * batch.masks * next_q
        q = self.critic(batch.observations, batch.actions)  # [critics, runs, batch]
        return {"critic_loss": (q - target).square().mean(-1).sum(0), "q_abs": q[0].abs().mean(-1)}

    def actor_loss(self, batch: Batch, pi: Tensor, c: Config) -> Logs:
        """Return the actor's loss at its actions pi [runs, batch, act]."""
        q = self.critic.frozen(batch.observations, pi, members=0)  # Q1 alone: [runs, batch]
        lambda_q = c.alpha / q.detach().abs().mean(-1) * q.mean(-1)
        cloning = (pi - batch.actions).square().mean(-1)
        loss = -lambda_q + cloning.mean(-1)
        return {"actor_loss": loss, "lambda_q": lambda_q, "bc": cloning.mean(-1)}

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the critics; in every `policy_freq`-th update the actor and the targets too."""
        c = self.config
        logs = self.critic_loss(batch, noise["target"], c)
        self.critic.minimize(logs["critic_loss"])
        if phase:
            pi = self.actor(batch.observations).tanh()
            logs |= self.actor_loss(batch, pi, c)
            self.actor.minimize(logs["actor_loss"])
            self.actor_target.polyak_update(c.tau)
            self.critic_target.polyak_update(c.tau)
        return logs
