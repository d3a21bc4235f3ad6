"""BDB+: BDB (bdb.py) with its paper's future work and a remedy for an adaptive beta near 1 at first; all ours.

    beta_max               adaptive and learned beta stay below it
    beta = learned         beta = sigmoid(b), trained to hold the cloning error at beta_target
    critic_penalty = cql   the critics are pushed down off the data, up on it, as in CQL:
                           loss + penalty_weight sum_i mean [logsumexp_j Q_i(s, a_j) - Q_i(s, a)]

Each is off by default, and then every number is BDB's, bit for bit. `diff algos/bdb.py algos/bdb_plus.py` shows them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from offbench.algorithm import (
    Algorithm,
    Batch,
    Logs,
    Noise,
    NoiseSpec,
    Target,
    has_word,
    normal,
    per_sample,
    setting,
    uniform,
)


@dataclass(frozen=True)
class Config:
    """Settings of BDB (the paper's Tables 3 and 4) and of what is ours."""

    alpha: float = setting(2.5, "weight of Q against the constraint: lambda = alpha / mean|Q1|", low=0, per_run=True)
    beta: float | str = setting(
        "adaptive",
        "share of the discriminator in the constraint; adaptive (the paper's rule), or learned (ours)",
        low=0,
        high=1,
        choices=("adaptive", "learned"),
        per_run=True,
    )
    beta_scope: str = setting("sample", "one adaptive beta per sample or per batch", choices=("sample", "batch"))
    critics: int = setting(2, "M, number of critics", low=2)
    discriminator_learning_rate: float = setting(3e-4, "Adam's learning rate of the discriminator", above=0)
    discriminator_hidden: tuple[int, ...] = setting((64, 64), "hidden layers of the discriminator (tanh)", low=1)
    beta_max: float = setting(1.0, "ours: adaptive and learned beta stay below this", low=0, high=1, per_run=True)
    beta_target: float = setting(0.05, "ours: cloning error that a learned beta holds", above=0, per_run=True)
    beta_learning_rate: float = setting(3e-4, "ours: Adam's learning rate of a learned beta", above=0)
    critic_penalty: str = setting("none", "ours: cql adds its conservative penalty", choices=("none", "cql"))
    penalty_weight: float = setting(1.0, "ours: weight of that penalty", low=0, per_run=True)
    penalty_actions: int = setting(10, "ours: uniform actions in its log-sum-exp", low=1)
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


class BDBPlus(Algorithm[Config]):
    """A stack of BDB+ runs."""

    def setup(self, c: Config) -> None:
        """Make the actor, M critics, the target of each, the discriminator, and a learned beta."""
        self.actor = self.actor_network(self.action_dim, c.actor_learning_rate)
        self.critic = self.critic_network(c.critic_learning_rate, ensemble_size=c.critics)
        self.discriminator = self.critic_network(
            c.discriminator_learning_rate, ensemble_size=None, hidden=c.discriminator_hidden, activation="tanh"
        )
        self.learned_beta = self.parameters(None, c.beta_learning_rate)  # moves only if beta is learned
        self.actor_target, self.critic_target = Target(self.actor), Target(self.critic)

    def noise_spec(self, c: Config) -> NoiseSpec:
        """Return one normal number for each target action, and uniform actions for the critics' penalty."""
        target = {"target": normal(c.batch_size, self.action_dim)}
        random = {"uniform": uniform(c.penalty_actions, c.batch_size, self.action_dim)}
        return target | random if c.critic_penalty == "cql" else target

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

    def conservative_penalty(self, batch: Batch, random: Tensor) -> Tensor:
        """Return mean [logsumexp_j Q(s, a_j) - Q(s, a)], critics summed, [runs].

        a_j: the random actions [runs, n, batch, act], pi(s) and pi(s'). A deterministic actor has no density, so they
        are not importance-weighted: the second of the three variants in the CQL authors' code.
        """
        with torch.no_grad():
            here, there = (self.actor(s).tanh().unsqueeze(1) for s in (batch.observations, batch.next_observations))
            actions = torch.cat([random, here, there], 1)
        runs, n, size, _ = actions.shape
        repeated = batch.observations.unsqueeze(1).expand(runs, n, size, -1).reshape(runs, n * size, -1)
        q = self.critic(repeated, actions.reshape(runs, n * size, -1)).view(-1, runs, n, size)
        return (q.logsumexp(2) - self.critic(batch.observations, batch.actions)).mean(-1).sum(0)

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
        adaptive = (1 / unc).clamp(max=1).minimum(per_sample(c.beta_max))  # Unc = 0 gives 1
        learned = self.learned_beta.flat.detach()[0].sigmoid().minimum(per_sample(c.beta_max))
        beta = per_sample(c.beta, adaptive=adaptive, learned=learned).expand_as(unc)
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

    def beta_gradient(self, cloning: Tensor, c: Config) -> Tensor:
        """Return the gradient [1, runs, 1] of beta (cloning error - target), beta = sigmoid(b); 0 if not learned.

        1 - beta is the multiplier of the constraint "cloning error <= beta_target": an error above the target lowers
        beta, so cloning holds tighter; one below it raises beta, and the discriminator takes over.
        """
        error = torch.where(has_word(c.beta, "learned"), cloning - c.beta_target, torch.zeros_like(cloning))
        beta = self.learned_beta.flat.detach().sigmoid()
        return beta * (1 - beta) * error.unsqueeze(-1)

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the critics; in every `policy_freq`-th update the discriminator, the actor and the targets too."""
        c = self.config
        logs = self.critic_loss(batch, noise["target"], c)
        loss = logs["critic_loss"]
        if c.critic_penalty == "cql":
            logs["penalty"] = self.conservative_penalty(batch, noise["uniform"])
            loss = loss + c.penalty_weight * logs["penalty"]
        self.critic.minimize(loss)
        if phase:
            pi = self.actor(batch.observations).tanh()
            logs |= self.discriminator_loss(batch, pi.detach())
            self.discriminator.minimize(logs["discriminator_loss"])
            logs |= self.actor_loss(batch, pi, c)
            self.actor.minimize(logs["actor_loss"])
            self.learned_beta.adam_step(self.beta_gradient(logs["bc"].detach(), c))
            self.actor_target.polyak_update(c.tau)
            self.critic_target.polyak_update(c.tau)
        return logs
