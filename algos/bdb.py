"""BDB: "Combined Constraint on Behavior Cloning and Discriminator in Offline Reinforcement Learning".

TD3+BC (td3_bc.py) whose constraint is shared by beta between cloning and a GAN discriminator D:

    discriminator  loss = mean -log D(s, a) + mean -log(1 - D(s, pi(s)))                                  (eq. 16)
    actor          loss = -lambda mean Q_1(s, pi(s)) + mean [beta (-log D(s, pi(s))) + (1 - beta) (pi(s) - a)^2]
                                                                                                          (eq. 17)
    adaptive beta  = min(1, 1 / Unc),  Unc = max_i Q_i(s, pi(s)) - min_i Q_i(s, pi(s)), detached     (Algorithm 2)

D moves just before the actor, its actions pi(s) detached; it works on logits, -log D = softplus(-logit). With
beta = 0 every number is TD3+BC's, bit for bit. Critics start in agreement, so Unc < 1 and the adaptive beta is
near 1 at first: the published rule lets the discriminator alone hold the policy until Q has grown.
Deviations: lambda is TD3+BC's, by mean |Q_1(s, pi(s))|, as in the authors' code that the paper builds on (its eq. 12
has the data's actions). The paper leaves open whether beta is a sample's or a batch's (`beta_scope`).

Ours, not the paper's, and off by default (the paper's future work, and remedies for that early beta):
`uncertainty = relative`, `beta_max`, `cloning_steps`, `beta = learned`, `critic_penalty = cql`; the end of this file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from offbench.algorithm import Batch, Draw, Learned, Network, PolicyParts, Target, setting

ADAPTIVE, LEARNED = -1.0, -2.0  # what stack_configs makes of beta's words


@dataclass(frozen=True)
class Config:
    """Settings of BDB (the paper's Tables 3 and 4)."""

    alpha: float = setting(2.5, "weight of Q against the constraint: lambda = alpha / mean|Q1|", low=0, per_run=True)
    beta: float | str = setting(
        "adaptive",
        "share of the discriminator in the constraint; adaptive (the paper's rule), or learned (ours)",
        low=0,
        high=1,
        choices=("adaptive", "learned"),
        per_run=True,
    )
    beta_scope: str = setting("sample", "one adaptive beta a sample or a batch", choices=("sample", "batch"))
    critics: int = setting(2, "M, critics behind the target's minimum and the uncertainty", low=2)
    discriminator_learning_rate: float = setting(3e-4, "Adam's learning rate of the discriminator", above=0)
    discriminator_hidden: tuple[int, ...] = setting((64, 64), "hidden layers of the discriminator (tanh)", low=1)
    uncertainty: str = setting("absolute", "ours: relative divides Unc by mean|Q1|", choices=("absolute", "relative"))
    uncertainty_scale: float = setting(1.0, "ours: factor of the relative Unc", above=0)
    beta_max: float = setting(1.0, "ours: adaptive and learned beta stay below this", low=0, high=1, per_run=True)
    cloning_steps: int = setting(0, "ours: updates at the start whose constraint is cloning alone", low=0)
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


def discriminator_loss(discriminator: Network, pi: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the discriminator's loss [runs], eq. 16: the data's actions are real, the policy's (detached) are not."""
    observations, actions = torch.cat([batch.observations] * 2, 1), torch.cat([batch.actions, pi], 1)
    real, fake = discriminator(observations, actions)[0].squeeze(-1).chunk(2, -1)
    loss = softplus(-real).mean(-1) + softplus(fake).mean(-1)
    seen = {"d_real": real.detach().sigmoid().mean(-1), "d_fake": fake.detach().sigmoid().mean(-1)}
    return loss, {"discriminator_loss": loss.detach()} | seen


def actor_loss(
    pi: Tensor, critic: Network, discriminator: Network, learned_beta: Learned, batch: Batch, c: Any, warm_up: bool
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the actor's loss [runs], eq. 17, and what is logged."""
    q = critic.frozen(batch.observations, pi, copies=1)[0].squeeze(-1)  # Q1 alone: [runs, batch]
    lambda_q = c.alpha / q.detach().abs().mean(-1) * q.mean(-1)
    cloning = (pi - batch.actions).square().mean(-1)
    adversarial = softplus(-discriminator.frozen(batch.observations, pi)[0].squeeze(-1))
    others = critic.frozen(batch.observations, pi.detach(), first=1).squeeze(-1)
    unc = uncertainty(torch.cat([q.detach().unsqueeze(0), others]), c)
    beta = mixture(unc, learned_beta, c, warm_up)
    loss = -lambda_q + (beta * adversarial + (1 - beta) * cloning).mean(-1)
    logs = {"actor_loss": loss.detach(), "lambda_q": lambda_q.detach(), "bc": cloning.detach().mean(-1)}
    ordered, last = beta.sort(-1).values, beta.shape[-1] - 1
    low, median, high = (ordered[:, round(share * last)] for share in (0.05, 0.5, 0.95))
    logs |= {"adversarial": adversarial.detach().mean(-1), "uncertainty": unc.mean(-1), "beta": beta.mean(-1)}
    return loss, logs | {"beta_5": low, "beta_50": median, "beta_95": high}


def uncertainty(q: Tensor, c: Any) -> Tensor:
    """Return max_i Q_i - min_i Q_i [runs, batch] of the M critics' values q at (s, pi(s)) (Algorithm 2)."""
    unc = q.amax(0) - q.amin(0)
    if c.uncertainty == "relative":
        unc = c.uncertainty_scale * unc / q[0].abs().mean(-1, keepdim=True)
    return unc.mean(-1, keepdim=True).expand_as(unc) if c.beta_scope == "batch" else unc


def mixture(unc: Tensor, learned_beta: Learned, c: Any, warm_up: bool) -> Tensor:
    """Return beta [runs, batch]: fixed, adaptive by Algorithm 2, or learned."""
    fixed, most = c.beta.unsqueeze(-1), c.beta_max.unsqueeze(-1)
    adaptive = (1 / unc).clamp(max=1).minimum(most)  # Unc = 0 gives 1
    learned = learned_beta.flat.detach()[0].sigmoid().minimum(most)
    beta = torch.where(fixed == ADAPTIVE, adaptive, torch.where(fixed == LEARNED, learned, fixed))
    return torch.zeros_like(beta) if warm_up else beta


class BDB:
    """A stack of BDB runs."""

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
            (inputs, *sizes, 1),
            run_seeds,
            1,
            learning_rate=c.critic_learning_rate,
            copies=c.critics,
            device=device,
        )
        self.discriminator = Network(
            (inputs, *c.discriminator_hidden, 1),
            run_seeds,
            2,
            learning_rate=c.discriminator_learning_rate,
            activation="tanh",
            device=device,
        )
        # one number a run, beta = its sigmoid; it starts at 0.5 and stands still unless beta is learned
        self.learned_beta = Learned(torch.zeros(1, len(run_seeds), 1, device=device), c.beta_learning_rate)
        self.actor_target, self.critic_target = Target(self.actor), Target(self.critic)
        self.learned = {
            "actor": self.actor,
            "critic": self.critic,
            "discriminator": self.discriminator,
            "learned_beta": self.learned_beta,
            "actor_target": self.actor_target,
            "critic_target": self.critic_target,
        }

    @property
    def draws(self) -> dict[str, Draw]:
        """One normal number for each target action; uniform actions if the critics are penalised."""
        c, shape = self.config, (self.config.batch_size, self.action_dim)
        penalty = {"uniform": Draw((c.penalty_actions, *shape), "uniform")} if c.critic_penalty == "cql" else {}
        return {"target": Draw(shape, "normal"), **penalty}

    def kind(self, step: int) -> str:
        """The actor and the targets wait for every `policy_freq`-th update."""
        if (step + 1) % self.config.policy_freq:
            return "critic"
        return "critic+cloning actor" if step < self.config.cloning_steps else "critic+actor"

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        """One update of every run."""
        c = self.config
        loss, logs = critic_loss(self.critic, self.critic_target, self.actor_target, batch, noise["target"], c)
        if c.critic_penalty == "cql":
            penalty = conservative_penalty(self.critic, self.actor, batch, noise["uniform"])
            loss, logs["penalty"] = loss + c.penalty_weight * penalty, penalty.detach()
        self.critic.minimize(loss.sum())
        if kind != "critic":
            pi = self.actor(batch.observations)[0].tanh()
            loss, more = discriminator_loss(self.discriminator, pi.detach(), batch)
            self.discriminator.minimize(loss.sum())
            logs |= more
            warm_up = kind == "critic+cloning actor"
            loss, more = actor_loss(pi, self.critic, self.discriminator, self.learned_beta, batch, c, warm_up)
            self.actor.minimize(loss.sum())
            self.learned_beta.descend(learned_beta_gradient(self.learned_beta, more["bc"], c, warm_up))
            self.actor_target.follow(c.tau)
            self.critic_target.follow(c.tau)
            logs |= more
        return logs

    def policy(self, run: int) -> PolicyParts:
        """Return the actor: tanh of its output."""
        return PolicyParts("tanh", self.actor.layers(run))


# Ours, beyond the paper; all of it off by default.


def learned_beta_gradient(learned_beta: Learned, cloning: Tensor, c: Any, warm_up: bool) -> Tensor:
    """Return the gradient [1, runs, 1] of beta (cloning error - target), beta = sigmoid(b); 0 if it is not learned.

    1 - beta is the multiplier of the constraint "cloning error <= beta_target": an error above the target lowers
    beta, so cloning holds tighter; one below it raises beta, and the discriminator takes over.
    """
    at_work = (c.beta == LEARNED) & (not warm_up)
    error = torch.where(at_work, cloning - c.beta_target, torch.zeros_like(cloning))
    beta = learned_beta.flat.detach().sigmoid()
    return beta * (1 - beta) * error.unsqueeze(-1)


def conservative_penalty(critic: Network, actor: Network, batch: Batch, uniform: Tensor) -> Tensor:
    """Return mean [logsumexp_j Q(s, a_j) - Q(s, a)], critics summed, [runs].

    a_j: the uniform actions [runs, n, batch, act], pi(s) and pi(s'). A deterministic actor has no density, so they are
    not importance-weighted: the second of the three variants in the CQL authors' code.
    """
    with torch.no_grad():
        here, there = (actor(s)[0].tanh().unsqueeze(1) for s in (batch.observations, batch.next_observations))
        actions = torch.cat([uniform, here, there], 1)
    runs, n, size, _ = actions.shape
    repeated = batch.observations.unsqueeze(1).expand(runs, n, size, -1).reshape(runs, n * size, -1)
    q = critic(repeated, actions.reshape(runs, n * size, -1)).view(-1, runs, n, size)
    data = critic(batch.observations, batch.actions).squeeze(-1)
    return (q.logsumexp(2) - data).mean(-1).sum(0)
