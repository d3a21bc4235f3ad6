"""TD3+BC: Fujimoto & Gu, "A Minimalist Approach to Offline Reinforcement Learning", NeurIPS 2021.

Reference: the authors' code, github.com/sfujim/TD3_BC. TD3 whose actor is also held to the data's actions:

    critic   y = r + discount (1 - terminated) min_i Q'_i(s', clip(pi'(s') + clip(noise)))
             loss = sum_i mean (Q_i(s, a) - y)^2
    actor    loss = -lambda mean Q_1(s, pi(s)) + mean (pi(s) - a)^2,   lambda = alpha / mean |Q_1(s, pi(s))|

The actor and all targets move on every `policy_freq`-th update alone. Deviations: actions are scaled to [-1, 1], so
the noise needs no factor of the largest action, and cloning errors count in those units (the same where the bounds
are 1, as in the locomotion tasks); the initial weights come from NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from offbench.algorithm import Batch, Draw, Network, PolicyParts, Target, setting


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
    batch_size: int = setting(256, "transitions an update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers of actor and critics", low=1)
    normalize: bool = setting(True, "normalise observations by the dataset's mean and std + 1e-3")


def critic_loss(
    critic: Network, critic_target: Target, actor_target: Target, batch: Batch, noise: Tensor, c: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the critics' loss [runs], and what is logged."""
    with torch.no_grad():
        noise = (noise * c.policy_noise).clamp(-c.noise_clip, c.noise_clip)
        next_actions = (actor_target(batch.next_observations)[0].tanh() + noise).clamp(-1, 1)
        next_q = critic_target(batch.next_observations, next_actions).squeeze(-1).amin(0)
        target = batch.rewards + c.discount * batch.masks * next_q
    q = critic(batch.observations, batch.actions).squeeze(-1)  # [critics, runs, batch]
    loss = (q - target).square().mean(-1).sum(0)
    return loss, {"critic_loss": loss.detach(), "q_abs": q[0].detach().abs().mean(-1)}


def actor_loss(actor: Network, critic: Network, batch: Batch, c: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the actor's loss [runs], and what is logged."""
    pi = actor(batch.observations)[0].tanh()
    q = critic.frozen(batch.observations, pi, copies=1)[0].squeeze(-1)  # Q1 alone: [runs, batch]
    lambda_q = c.alpha / q.detach().abs().mean(-1) * q.mean(-1)
    cloning = (pi - batch.actions).square().mean(-1)
    loss = -lambda_q + cloning.mean(-1)
    return loss, {"actor_loss": loss.detach(), "lambda_q": lambda_q.detach(), "bc": cloning.detach().mean(-1)}


class TD3BC:
    """A stack of TD3+BC runs."""

    Config = Config

    def __init__(
        self,
        config: Any,
        observation_dim: int,
        action_dim: int,
        run_seeds: Sequence[int],
        device: torch.device | str,
    ) -> None:
        c = self.config = config
        self.action_dim = action_dim
        sizes, inputs = c.hidden, observation_dim + action_dim
        self.actor = Network(
            (observation_dim, *sizes, action_dim),
            run_seeds,
            0,
            learning_rate=c.actor_learning_rate,
            device=device,
        )
        self.critic = Network(
            (inputs, *sizes, 1), run_seeds, 1, learning_rate=c.critic_learning_rate, copies=2, device=device
        )
        self.actor_target, self.critic_target = Target(self.actor), Target(self.critic)
        self.learned = {
            "actor": self.actor,
            "critic": self.critic,
            "actor_target": self.actor_target,
            "critic_target": self.critic_target,
        }

    @property
    def draws(self) -> dict[str, Draw]:
        """One normal number for each target action."""
        return {"target": Draw((self.config.batch_size, self.action_dim), "normal")}

    def kind(self, step: int) -> str:
        """The actor and the targets wait for every `policy_freq`-th update."""
        return "critic+actor" if (step + 1) % self.config.policy_freq == 0 else "critic"

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        """One update of every run."""
        c = self.config
        loss, logs = critic_loss(self.critic, self.critic_target, self.actor_target, batch, noise["target"], c)
        self.critic.minimize(loss.sum())
        if kind == "critic+actor":
            loss, more = actor_loss(self.actor, self.critic, batch, c)
            self.actor.minimize(loss.sum())
            self.actor_target.follow(c.tau)
            self.critic_target.follow(c.tau)
            logs |= more
        return logs

    def policy(self, run: int) -> PolicyParts:
        """Return the actor: tanh of its output."""
        return PolicyParts("tanh", self.actor.layers(run))
