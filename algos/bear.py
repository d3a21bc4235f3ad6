"""BEAR: Kumar et al., "Stabilizing Off-Policy Q-Learning via Bootstrapping Error Reduction", NeurIPS 2019.

Reference: the authors' code, github.com/aviralkumar2907/BEAR, with the settings that its readme recommends. The
actor's support is held within the data's, which a variational autoencoder (VAE) models, by maximum mean discrepancy:

    VAE        mean (decoder(s, z) - a)^2 + kl_weight KL(encoder(s, a) || N(0, 1)),   z ~ encoder(s, a)
    critic     y = r + discount (1 - terminated) max_j [l min_i Q'_i(s', a_j) + (1 - l) max_i Q'_i(s', a_j)]
               a_j ~ pi'(s'), p of them;   loss = sum_i mean (Q_i(s, a) - y)^2      (the BDB paper's eq. 14)
    actor      mean [-min_i mean_j Q_i(s, a_j)] + multiplier MMD,   a_j ~ pi(s); MMD alone in the first `warm_up_steps`
    MMD        mean sqrt(E k(x, x') + E k(y, y') - 2 E k(x, y) + 1e-6), x of the decoder, y of the actor, before tanh
    multiplier raised where MMD > threshold, lowered where it is below:  loss = -multiplier (MMD - threshold)

Noise of the samples in MMD is clipped to +-0.5, as in the authors' code. Acts with the best of `eval_samples` samples
by Q1. Deviations: no standard deviation of the ensemble in the actor's loss and no bootstrap masks (the authors'
readme and script turn them off); the multiplier starts at 1 (theirs at exp of a normal number); log std is clamped to
[-20, 2] (theirs is not), the VAE's to [-4, 2] (theirs to [-4, 15]); one kernel for all environments, the readme's
second choice (its example for hopper has the first: laplacian, width 10).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from offbench.algorithm import (
    Algorithm,
    Batch,
    Logs,
    Network,
    Noise,
    NoiseSpec,
    PolicyParts,
    Target,
    minimize,
    normal,
    setting,
)

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
VAE_LOG_STD_MIN = -4.0
NOISE_CLIP = 0.5  # of samples that MMD compares
LOG_MULTIPLIER_MIN, LOG_MULTIPLIER_MAX = -5.0, 10.0


@dataclass(frozen=True)
class Config:
    """Settings of BEAR (the authors')."""

    threshold: float = setting(0.05, "MMD that the multiplier holds", above=0, per_run=True)
    kernel: str = setting("gaussian", "kernel of MMD", choices=("gaussian", "laplacian"))
    kernel_width: float = setting(20.0, "sigma of the kernel exp(-distance / (2 sigma))", above=0)
    match_samples: int = setting(5, "samples of the actor and of the VAE in MMD", low=2)
    target_samples: int = setting(10, "p, actions in the target's maximum", low=1)
    target_min_weight: float = setting(0.75, "lambda, share of the ensemble's minimum in the target", low=0, high=1)
    critics: int = setting(2, "K, number of critics", low=2)
    warm_up_steps: int = setting(20_000, "updates at the start in which the actor minimizes MMD alone", low=0)
    eval_samples: int = setting(10, "act with the best of so many samples by Q1", low=1)
    kl_weight: float = setting(0.5, "weight of KL in the VAE's loss", low=0)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the targets", above=0, high=1)
    learning_rate: float = setting(1e-3, "Adam's learning rate of all networks and of the multiplier", above=0)
    batch_size: int = setting(100, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((400, 300), "hidden layers of actor and critics", low=1)
    vae_hidden: tuple[int, ...] = setting((750, 750), "hidden layers of the VAE's encoder and decoder", low=1)
    normalize: bool = setting(False, "normalize observations by the dataset's mean and std + 1e-3")


def repeat(observations: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
    """Return observations and samples [runs, n, batch, dim], each as [runs, n * batch, dim]."""
    runs, n, batch, _ = samples.shape
    repeated = observations.unsqueeze(1).expand(runs, n, batch, -1)
    return repeated.reshape(runs, n * batch, -1), samples.reshape(runs, n * batch, -1)


class BEAR(Algorithm[Config]):
    """A stack of BEAR runs."""

    def setup(self, c: Config) -> None:
        """Make the actor (mean and log std), the critics, the target of each, the VAE and the multiplier."""
        rate, self.latent_dim = c.learning_rate, 2 * self.action_dim
        self.actor = self.actor_network(2 * self.action_dim, rate)
        self.critic = self.critic_network(rate, ensemble_size=c.critics)
        inputs = self.observation_dim + self.action_dim, self.observation_dim + self.latent_dim
        self.encoder = self.network(inputs[0], 2 * self.latent_dim, rate, hidden=c.vae_hidden)
        self.decoder = self.network(inputs[1], self.action_dim, rate, hidden=c.vae_hidden)
        self.actor_target, self.critic_target = Target(self.actor), Target(self.critic)
        self.log_multiplier = self.parameters(None, rate)

    def noise_spec(self, c: Config) -> NoiseSpec:
        """Return normal numbers for the VAE's latent variable and every sampled action."""
        n, p, size = c.match_samples, c.target_samples, c.batch_size
        vae, target = normal(size, self.latent_dim), normal(p, size, self.action_dim)
        data, actor = normal(n, size, self.latent_dim), normal(n, size, self.action_dim)
        return {"vae": vae, "target": target, "data": data, "actor": actor}

    def phase(self, step: int) -> bool:
        """Return whether the actor minimizes MMD alone."""
        return step < self.config.warm_up_steps

    def sample(self, actor: Network | Target, observations: Tensor, noise: Tensor) -> Tensor:
        """Return actions before the tanh, [runs, n, batch, act], for noise of that shape."""
        mean, log_std = actor(observations).unsqueeze(1).chunk(2, -1)
        return mean + log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp() * noise

    def vae_loss(self, batch: Batch, noise: Tensor, c: Config) -> Logs:
        """Return the VAE's loss."""
        mean, log_std = self.encoder(batch.observations, batch.actions).chunk(2, -1)
        log_std = log_std.clamp(VAE_LOG_STD_MIN, LOG_STD_MAX)
        decoded = self.decoder(batch.observations, mean + log_std.exp() * noise).tanh()
        kl = -0.5 * (1 + 2 * log_std - mean.square() - (2 * log_std).exp()).mean((-1, -2))
        error = (decoded - batch.actions).square().mean((-1, -2))
        return {"vae_loss": error + c.kl_weight * kl, "vae_error": error}

    def critic_loss(self, batch: Batch, noise: Tensor, c: Config) -> Logs:
        """Return the critics' loss, eq. 14 of the BDB paper."""
        with torch.no_grad():
            next_actions = self.sample(self.actor_target, batch.next_observations, noise).tanh()
            next_q = self.critic_target(*repeat(batch.next_observations, next_actions))
            next_q = next_q.view(-1, *noise.shape[:3])  # [critics, runs, p, batch]
            mixed = c.target_min_weight * next_q.amin(0) + (1 - c.target_min_weight) * next_q.amax(0)
            target = batch.rewards + c.discount * batch.masks * mixed.amax(1)
        q = self.critic(batch.observations, batch.actions)  # [critics, runs, batch]
        return {"critic_loss": (q - target).square().mean(-1).sum(0), "q_abs": q[0].abs().mean(-1)}

    def mmd(self, x: Tensor, y: Tensor, c: Config) -> Tensor:
        """Return the maximum mean discrepancy of samples [runs, n, batch, act], a mean over the batch, [runs]."""

        def kernel(a: Tensor, b: Tensor) -> Tensor:
            difference = a.unsqueeze(2) - b.unsqueeze(1)
            size = difference.square() if c.kernel == "gaussian" else difference.abs()
            return (-size.sum(-1) / (2 * c.kernel_width)).exp().mean((1, 2))

        return (kernel(x, x) + kernel(y, y) - 2 * kernel(x, y) + 1e-6).sqrt().mean(-1)

    def actor_loss(self, batch: Batch, noise: Noise, warm_up: bool, c: Config) -> Logs:
        """Return the actor's loss."""
        with torch.no_grad():
            data = self.decoder(*repeat(batch.observations, noise["data"].clamp(-NOISE_CLIP, NOISE_CLIP)))
            data = data.view(*noise["data"].shape[:3], -1)
        raw = self.sample(self.actor, batch.observations, noise["actor"].clamp(-NOISE_CLIP, NOISE_CLIP))
        mmd = self.mmd(data, raw, c)
        loss = self.log_multiplier.value.detach().exp() * mmd
        if not warm_up:
            q = self.critic.frozen(*repeat(batch.observations, raw.tanh())).view(-1, *raw.shape[:3])
            q = q.mean(2).amin(0)  # [runs, batch]
            loss = loss - q.mean(-1)
        return {"actor_loss": loss, "mmd": mmd}

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the VAE, the critics, the actor and the multiplier, then the targets."""
        c = self.config
        logs = self.vae_loss(batch, noise["vae"], c)
        minimize(logs["vae_loss"], self.encoder, self.decoder)
        logs |= self.critic_loss(batch, noise["target"], c)
        self.critic.minimize(logs["critic_loss"])
        logs |= self.actor_loss(batch, noise, phase, c)
        self.actor.minimize(logs["actor_loss"])
        multiplier = self.log_multiplier.value.exp()
        self.log_multiplier.minimize(-multiplier * (logs["mmd"].detach() - c.threshold))
        with torch.no_grad():
            self.log_multiplier.flat.clamp_(LOG_MULTIPLIER_MIN, LOG_MULTIPLIER_MAX)
        self.actor_target.polyak_update(c.tau)
        self.critic_target.polyak_update(c.tau)
        return logs | {"multiplier": multiplier}

    def policy(self, run: int) -> PolicyParts:
        """Return the actor, mean and log std before the tanh, with Q1 to choose among its samples."""
        if self.config.eval_samples == 1:
            return super().policy(run)
        return PolicyParts("best_by_q", self.actor.layers(run), self.critic.layers(run), self.config.eval_samples)
