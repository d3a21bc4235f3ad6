"""CQL: Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning", NeurIPS 2020.

Reference: the authors' code, github.com/aviralkumar2907/CQL, with the settings of the BDB paper's Table 5. SAC whose
critics are pushed down where the policy or chance would act, and up on the data (CQL(H), importance-weighted):

    critic       sum_i mean (Q_i(s, a) - y)^2 + alpha sum_i mean [ logsumexp_j (Q_i(s, a_j) - log w_j) - Q_i(s, a) ]
                 y = r + discount (1 - terminated) min_i Q'_i(s', a'),  a' ~ pi(s'); no entropy in it
                 a_j: N uniform (w = 0.5^dim), N ~ pi(s), N ~ pi(s'), each with its own density; all Q at s
    actor        mean [ temperature log pi(a|s) - min_i Q_i(s, a) ],  a ~ pi(s)
                 in the first `bc_steps` updates: mean [ temperature log pi(a|s) - log pi(data's action|s) ]
                 lagrange: multiplier (penalty - target_action_gap), the multiplier trained to raise it
    temperature  loss = -log(temperature) mean [ log pi(a|s) + target entropy ],  target entropy = -dim(A)

Deviations: log std is at least -20 (theirs: -5); data actions are clipped to +-0.999 (theirs: 1 - 1e-6), which changes
the gradient of the cloning updates; log-densities are exact (theirs add 1e-6 to 1 - a^2); the mean is not clamped
(theirs to +-9 for data actions); the actor loss uses the critics after their update, as in SB3 (theirs: before), and
the temperature before its update (theirs: after); initial weights are torch.nn.Linear's (theirs: rlkit's). The actor
has three hidden layers, as in their code (Table 5 gives its width alone). Evaluations use the mode, as theirs, or the
best of `eval_samples`: 10 in the grid `paper`, which is our reading of Table 5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from offbench.algorithm import (
    Algorithm,
    Batch,
    Logs,
    Network,
    Noise,
    NoiseSpec,
    PolicyParts,
    Target,
    normal,
    setting,
    uniform,
)

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # as in CORL's code; the authors' has -5
ATANH_CLIP = 0.999  # data actions at the bounds have no inverse tanh; the authors' code has 1 - 1e-6


@dataclass(frozen=True)
class Config:
    """Settings of CQL (the BDB paper's Table 5)."""

    alpha: float = setting(10.0, "weight of the conservative penalty", low=0, per_run=True)
    lagrange: bool = setting(False, "scale the penalty by a multiplier that holds it at target_action_gap")
    target_action_gap: float = setting(5.0, "what the Lagrange form holds the penalty at", above=0)
    eval_samples: int = setting(1, "act with the best of so many samples by Q1; 1 acts with the mode", low=1)
    num_actions: int = setting(10, "actions of each of the three kinds in the log-sum-exp", low=1)
    bc_steps: int = setting(40_000, "updates in which the actor clones the data first", low=0)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the target critics", above=0, high=1)
    actor_learning_rate: float = setting(3e-5, "Adam's learning rate of the actor and temperature", above=0)
    critic_learning_rate: float = setting(3e-4, "Adam's learning rate of the critics", above=0)
    batch_size: int = setting(256, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256, 256), "hidden layers of actor and critics", low=1)
    normalize: bool = setting(False, "normalize observations by the dataset's mean and std + 1e-3")


def log_prob(mean: Tensor, log_std: Tensor, u: Tensor) -> Tensor:
    """Return the log-density of tanh(u), u normal, summed over the last axis.

    log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)) stays finite for any u.
    """
    density = -0.5 * ((u - mean) / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
    return (density - 2 * (math.log(2) - u - softplus(-2 * u))).sum(-1)


def distribution(actor: Network, observations: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and log std [runs, batch, act] of the normal before the tanh."""
    mean, log_std = actor(observations).chunk(2, -1)
    return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


def sample(actor: Network, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions [runs, n, batch, act] and their log-densities [runs, n, batch].

    Args:
        noise: [runs, n, batch, act], standard normal.
    """
    mean, log_std = (x.unsqueeze(1) for x in distribution(actor, observations))
    u = mean + log_std.exp() * noise
    return u.tanh(), log_prob(mean, log_std, u)


def q_of_actions(critic: Network, observations: Tensor, actions: Tensor) -> Tensor:
    """Return Q [critics, runs, n, batch] of several actions [runs, n, batch, act] at the same observations."""
    runs, n, batch, _ = actions.shape
    repeated = observations.unsqueeze(1).expand(runs, n, batch, -1)
    q = critic(repeated.reshape(runs, n * batch, -1), actions.reshape(runs, n * batch, -1))
    return q.view(-1, runs, n, batch)


class CQL(Algorithm[Config]):
    """A stack of CQL runs."""

    def setup(self, c: Config) -> None:
        """Make the actor (mean and log std), two critics and their target, the temperature and the multiplier."""
        self.actor = self.actor_network(2 * self.action_dim, c.actor_learning_rate)
        self.critic = self.critic_network(c.critic_learning_rate, ensemble_size=2)
        self.critic_target = Target(self.critic)
        self.log_temperature = self.parameters(None, c.actor_learning_rate)
        self.log_multiplier = self.parameters(None, c.critic_learning_rate)

    def noise_spec(self, c: Config) -> NoiseSpec:
        """Return normal numbers for every sampled action, uniform ones for the random actions."""
        one, many = (normal(n, c.batch_size, self.action_dim) for n in (1, c.num_actions))
        random = uniform(c.num_actions, c.batch_size, self.action_dim)
        return {"target": one, "actor": one, "here": many, "there": many, "uniform": random}

    def phase(self, step: int) -> bool:
        """Return whether the actor still clones the data."""
        return step < self.config.bc_steps

    def conservative_penalty(self, batch: Batch, noise: Noise, q: Tensor) -> Tensor:
        """Return mean [logsumexp_j (Q(s, a_j) - log w_j) - Q(s, a)] of each critic, [critics, runs]."""
        with torch.no_grad():
            here, here_log = sample(self.actor, batch.observations, noise["here"])
            there, there_log = sample(self.actor, batch.next_observations, noise["there"])
            random = noise["uniform"]
            random_log = torch.full_like(here_log, random.shape[-1] * math.log(0.5))
            actions = torch.cat([random, here, there], 1)
            log_density = torch.cat([random_log, here_log, there_log], 1)
        weighted = q_of_actions(self.critic, batch.observations, actions) - log_density
        return (weighted.logsumexp(2) - q).mean(-1)

    def critic_loss(self, batch: Batch, noise: Noise, multiplier: Tensor, c: Config) -> tuple[Tensor, Logs]:
        """Return the critics' loss [runs], and what is logged; `multiplier` [runs] is the Lagrange form's."""
        with torch.no_grad():
            next_actions, _ = sample(self.actor, batch.next_observations, noise["target"])
            next_q = self.critic_target(batch.next_observations, next_actions[:, 0]).amin(0)
            target = batch.rewards + c.discount * batch.masks * next_q
        q = self.critic(batch.observations, batch.actions)  # [critics, runs, batch]
        td = (q - target).square().mean(-1).sum(0)
        penalty = c.alpha * self.conservative_penalty(batch, noise, q)  # [critics, runs]
        logs = {"critic_loss": td, "penalty": penalty.sum(0), "q_abs": q[0].abs().mean(-1)}
        if c.lagrange:
            return td + multiplier * (penalty - c.target_action_gap).sum(0), logs
        return td + penalty.sum(0), logs

    def actor_loss(self, batch: Batch, noise: Tensor, temperature: Tensor, cloning: bool) -> Logs:
        """Return the actor's loss (cloning in the warm-up), and the log-density of its actions."""
        mean, log_std = distribution(self.actor, batch.observations)
        u = mean + log_std.exp() * noise[:, 0]
        log_pi = log_prob(mean, log_std, u)
        if cloning:
            data = batch.actions.clamp(-ATANH_CLIP, ATANH_CLIP).atanh()
            value = log_prob(mean, log_std, data)
        else:
            value = self.critic.frozen(batch.observations, u.tanh()).amin(0)
        loss = (temperature.unsqueeze(-1) * log_pi - value).mean(-1)
        return {"actor_loss": loss, "log_pi": log_pi.mean(-1)}

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the critics, the actor and the temperature, then the critics' target."""
        c = self.config
        multiplier = self.log_multiplier.value.exp().clamp(max=1e6)
        loss, logs = self.critic_loss(batch, noise, multiplier.detach(), c)
        self.critic.minimize(loss)
        if c.lagrange:
            gap = logs["penalty"].detach() - 2 * c.target_action_gap  # of both critics
            self.log_multiplier.minimize(-0.5 * multiplier * gap)
            logs["multiplier"] = multiplier
        temperature = self.log_temperature.value.detach().exp()
        logs |= self.actor_loss(batch, noise["actor"], temperature, cloning=phase)
        self.actor.minimize(logs["actor_loss"])
        target_entropy = -float(self.action_dim)
        self.log_temperature.minimize(-self.log_temperature.value * (logs["log_pi"].detach() + target_entropy))
        self.critic_target.polyak_update(c.tau)
        return logs | {"temperature": temperature}

    def policy(self, run: int) -> PolicyParts:
        """Return the actor, mean and log std before the tanh; Q1 with it if it acts with the best of samples."""
        if self.config.eval_samples == 1:
            return super().policy(run)
        return PolicyParts("best_by_q", self.actor.layers(run), self.critic.layers(run), self.config.eval_samples)
