"""BDB: "Combined Constraint on Behavior Cloning and Discriminator in Offline Reinforcement Learning".

TD3+BC (td3_bc.py) with a constraint that beta divides between cloning and a GAN discriminator D:

    discriminator  loss = mean -log D(s, a) + mean -log(1 - D(s, pi(s)))                                  (eq. 16)
    actor          loss = -lambda mean Q_1(s, pi(s)) + mean [beta (-log D(s, pi(s))) + (1 - beta) (pi(s) - a)^2]
                                                                                                          (eq. 17)
    adaptive beta  = min(1, 1 / Unc),  Unc = max_i Q_i(s, pi(s)) - min_i Q_i(s, pi(s)), detached     (Algorithm 2)

D is updated just before the actor, its actions pi(s) detached; it works on logits, -log D = softplus(-logit). With
beta = 0 every number is TD3+BC's, bit for bit. Critics start in agreement, so Unc < 1 and the adaptive beta is
near 1 at first: by the published rule the discriminator alone constrains the policy until Q has grown.
Deviation: lambda is TD3+BC's, by mean |Q_1(s, pi(s))|, as in the authors' code that the paper builds on (its eq. 12
has the data's actions). Where the paper leaves it open: beta is computed per sample (`beta_scope`); Algorithm 2
compares the Q values of the M critics, not of their targets, at pi(s); the cloning error is a mean over the dimensions
of the action, as in TD3+BC; D takes normalized observations.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from offbench.algorithm import Algorithm, Batch, Logs, Noise, NoiseSpec, Target, normal, per_sample, setting


@dataclass(frozen=True)
class Config:
    """Settings of BDB (the paper's Tables 3 and 4)."""

    alpha: float = setting(2.5, "weight of Q against the constraint: lambda = alpha / mean|Q1|", low=0, per_run=True)
    beta: float | str = setting(
        "adaptive",
        "share of the discriminator in the constraint, or adaptive (the paper's rule)",
        low=0,
        high=1,
        choices=("adaptive",),
        per_run=True,
        notes={
            "adaptive": "the adaptive beta starts near 1, where the discriminator alone constrains the policy: early "
            "scores are low"
        },
    )
    beta_scope: str = setting("sample", "one adaptive beta per sample or per batch", choices=("sample", "batch"))
    critics: int = setting(2, "M, number of critics", low=2)
    discriminator_learning_rate: float = setting(3e-4, "Adam's learning rate of the discriminator", above=0)
    discriminator_hidden: tuple[int, ...] = setting((64, 64), "hidden layers of the discriminator (tanh)", low=1)
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


class BDB(Algorithm[Config]):
    """A stack of BDB runs."""

    def setup(self, c: Config) -> None:
        """Make the actor, M critics, the target of each, and the discriminator."""
        self.actor = self.actor_network(self.action_dim, c.actor_learning_rate)
        self.critic = self.critic_network(c.critic_learning_rate, ensemble_size=c.critics)
        self.discriminator = self.critic_network(
            c.discriminator_learning_rate, ensemble_size=None, hidden=c.discriminator_hidden, activation="tanh"
        )
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

    def discriminator_loss(self, batch: Batch, pi: Tensor) -> Logs:
        """Return the discriminator's loss, eq. 16: the data's actions are real, the policy's (detached) are not."""
        observations, actions = torch.cat([batch.observations] * 2, 1), torch.cat([batch.actions, pi], 1)
        real, fake = self.discriminator(observations, actions).chunk(2, -1)
        loss = softplus(-real).mean(-1) + softplus(fake).mean(-1)
        return {"discriminator_loss": loss, "d_real": real.sigmoid().mean(-1), "d_fake": fake.sigmoid().mean(-1)}

    def actor_loss(self, batch: Batch, pi: Tensor, c: Config) -> Logs:
        """Return the actor's loss at its actions pi [runs, batch, act], eq. 17."""
        q = self.critic.frozen(batch.observations, pi, members=0)  # Q1 alone: [runs, batch]
        lambda_q = c.alpha / q.detach().abs().mean(-1) * q.mean(-1)
        cloning = (pi - batch.actions).square().mean(-1)
        adversarial = softplus(-self.discriminator.frozen(batch.observations, pi))
        unc = self.uncertainty(batch, pi.detach(), q.detach(), c)
        beta = per_sample(c.beta, adaptive=(1 / unc).clamp(max=1)).expand_as(unc)  # Unc = 0 gives 1
        loss = -lambda_q + (beta * adversarial + (1 - beta) * cloning).mean(-1)
        logs = {"actor_loss": loss, "lambda_q": lambda_q, "bc": cloning.mean(-1)}
        logs |= {"adversarial": adversarial.mean(-1), "uncertainty": unc.mean(-1), "beta": beta.mean(-1)}
        ordered, last = beta.sort(-1).values, beta.shape[-1] - 1
        return logs | {f"beta_{percent}": ordered[:, round(percent / 100 * last)] for percent in (5, 50, 95)}

    def uncertainty(self, batch: Batch, pi: Tensor, q: Tensor, c: Config) -> Tensor:
        """Return max_i Q_i - min_i Q_i of the M critics at (s, pi(s)), [runs, batch]; q is Q1 there (Algorithm 2)."""
        others = self.critic.frozen(batch.observations, pi, members=slice(1, None))
        every = torch.cat([q.unsqueeze(0), others])
        unc = every.amax(0) - every.amin(0)
        return unc.mean(-1, keepdim=True).expand_as(unc) if c.beta_scope == "batch" else unc

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the critics; in every `policy_freq`-th update the discriminator, the actor and the targets too."""
        c = self.config
        logs = self.critic_loss(batch, noise["target"], c)
        self.critic.minimize(logs["critic_loss"])
        if phase:
            pi = self.actor(batch.observations).tanh()
            logs |= self.discriminator_loss(batch, pi.detach())
            self.discriminator.minimize(logs["discriminator_loss"])
            logs |= self.actor_loss(batch, pi, c)
            self.actor.minimize(logs["actor_loss"])
            self.actor_target.polyak_update(c.tau)
            self.critic_target.polyak_update(c.tau)
        return logs
