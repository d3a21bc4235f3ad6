"""IQL: Kostrikov, Nair & Levine, "Offline Reinforcement Learning with Implicit Q-Learning", ICLR 2022.

Reference: the authors' code, github.com/ikostrikov/implicit_q_learning. No action outside the data is ever evaluated:

    value    mean |expectile - 1(u < 0)| u^2,   u = min_i Q'_i(s, a) - V(s)                                   (eq. 5)
    actor    mean -min(exp(temperature (min_i Q'_i(s, a) - V(s))), 100) log pi(a | s)                         (eq. 7)
    critic   sum_i mean (r + discount (1 - terminated) V(s') - Q_i(s, a))^2                                   (eq. 6)

in this order, each with what the ones before it have just learned; the critics' targets Q' follow at the end. The
policy is a Gaussian around tanh(mean) whose std is one learned number an action, and acts with its mean.
Deviations: the actor's learning rate stays where the authors' falls to 0 by a cosine; rewards are taken as they are
(the authors scale MuJoCo's by 1000 / (best - worst return); `reward_scale` does that); initial weights are
torch.nn.Linear's, theirs are orthogonal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from offbench.algorithm import Batch, Draw, Learned, Network, PolicyParts, Target, setting

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
MOST = 100.0  # weight of a single sample


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
    batch_size: int = setting(256, "transitions an update", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers of all networks", low=1)
    normalize: bool = setting(False, "normalise observations by the dataset's mean and std + 1e-3")


def value_loss(value: Network, critic_target: Target, batch: Batch, c: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Return V's loss [runs], eq. 5, and what is logged."""
    u = lowest(critic_target, batch) - value(batch.observations)[0].squeeze(-1)  # [runs, batch]
    expectile = c.expectile.unsqueeze(-1)
    weight = torch.where(u > 0, expectile, 1 - expectile)
    loss = (weight * u.square()).mean(-1)
    return loss, {"value_loss": loss.detach(), "advantage": u.detach().mean(-1)}


def actor_loss(
    actor: Network, log_std: Learned, value: Network, critic_target: Target, batch: Batch, c: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the actor's loss [runs], eq. 7, and what is logged."""
    advantage = lowest(critic_target, batch) - value.frozen(batch.observations)[0].squeeze(-1)
    weight = (c.temperature.unsqueeze(-1) * advantage).exp().clamp(max=MOST)
    mean = actor(batch.observations)[0].tanh()
    spread = log_std.flat[0].clamp(LOG_STD_MIN, LOG_STD_MAX).unsqueeze(1)  # [runs, 1, act]
    density = -0.5 * ((batch.actions - mean) / spread.exp()).square() - spread - 0.5 * math.log(2 * math.pi)
    loss = -(weight * density.sum(-1)).mean(-1)
    return loss, {"actor_loss": loss.detach(), "weight": weight.mean(-1), "std": spread.detach().exp().mean((-1, -2))}


def critic_loss(critic: Network, value: Network, batch: Batch, c: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the critics' loss [runs], eq. 6, and what is logged."""
    next_v = value.frozen(batch.next_observations)[0].squeeze(-1)
    target = c.reward_scale.unsqueeze(-1) * batch.rewards + c.discount * batch.masks * next_v
    q = critic(batch.observations, batch.actions).squeeze(-1)  # [critics, runs, batch]
    loss = (q - target).square().mean(-1).sum(0)
    return loss, {"critic_loss": loss.detach(), "q_abs": q[0].detach().abs().mean(-1)}


def lowest(critic_target: Target, batch: Batch) -> Tensor:
    """Return min_i Q'_i(s, a) of the data's actions, [runs, batch]."""
    return critic_target(batch.observations, batch.actions).squeeze(-1).amin(0)


class IQL:
    """A stack of IQL runs."""

    Config = Config

    def __init__(
        self, config: Any, observation_dim: int, action_dim: int, run_seeds: Sequence[int], device: torch.device | str
    ) -> None:
        c = self.config = config
        rate = {"learning_rate": c.learning_rate, "device": device}
        self.actor = Network((observation_dim, *c.hidden, action_dim), run_seeds, 0, **rate)
        self.critic = Network((observation_dim + action_dim, *c.hidden, 1), run_seeds, 1, copies=2, **rate)
        self.value = Network((observation_dim, *c.hidden, 1), run_seeds, 2, **rate)
        self.log_std = Learned(torch.zeros(1, len(run_seeds), action_dim, device=device), c.learning_rate)
        self.critic_target = Target(self.critic)
        self.learned = {
            "actor": self.actor,
            "log_std": self.log_std,
            "critic": self.critic,
            "critic_target": self.critic_target,
            "value": self.value,
        }

    @property
    def draws(self) -> dict[str, Draw]:
        """Nothing random beside the batch."""
        return {}

    def kind(self, step: int) -> str:
        """Every update is the same."""
        return "update"

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        """One update of every run."""
        c = self.config
        loss, logs = value_loss(self.value, self.critic_target, batch, c)
        self.value.minimize(loss.sum())
        loss, more = actor_loss(self.actor, self.log_std, self.value, self.critic_target, batch, c)
        self.actor.minimize(loss.sum(), retain_graph=True)
        self.log_std.minimize(loss.sum())
        logs |= more
        loss, more = critic_loss(self.critic, self.value, batch, c)
        self.critic.minimize(loss.sum())
        self.critic_target.follow(c.tau)
        return logs | more

    def policy(self, run: int) -> PolicyParts:
        """Return the actor: tanh of its output, the Gaussian's mean."""
        return PolicyParts("tanh", self.actor.layers(run))
