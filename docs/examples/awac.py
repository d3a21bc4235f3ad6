"""AWAC: Nair et al., "AWAC: Accelerating Online Reinforcement Learning with Offline Datasets", 2020.

    critic   sum_i mean (r + discount (1 - terminated) min_i Q'_i(s', a') - Q_i(s, a))^2,   a' ~ pi(s')
    actor    mean -min(exp(advantage / temperature), 100) log pi(a | s)
             advantage = min_i Q_i(s, a) - min_i Q_i(s, b),   b ~ pi(s)

The policy is a Gaussian around tanh(actor(s)) with a learned std for each action dimension; its samples are clipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from offbench.algorithm import Algorithm, Batch, Logs, Noise, NoiseSpec, Target, minimize, normal, setting


@dataclass(frozen=True)
class Config:
    temperature: float = setting(1.0, "an action's weight is exp(advantage / temperature)", above=0)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the critics' target", above=0, high=1)
    learning_rate: float = setting(3e-4, "Adam's learning rate", above=0)
    batch_size: int = setting(256, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256, 256), "hidden layers of actor and critics", low=1)
    normalize: bool = setting(True, "normalize observations by the dataset's mean and std + 1e-3")


class AWAC(Algorithm[Config]):
    def setup(self, c: Config) -> None:
        self.actor = self.actor_network(self.action_dim, c.learning_rate)
        self.log_std = self.parameters(self.action_dim, c.learning_rate)
        self.critic = self.critic_network(c.learning_rate, ensemble_size=2)
        self.critic_target = Target(self.critic)

    def noise_spec(self, c: Config) -> NoiseSpec:
        return {name: normal(c.batch_size, self.action_dim) for name in ("here", "next")}

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        c, s, a, log_std = self.config, batch.observations, batch.actions, self.log_std.value.unsqueeze(1)
        mean = self.actor(s).tanh()  # [runs, batch, act]
        with torch.no_grad():
            next_actions = (self.actor(batch.next_observations).tanh() + log_std.exp() * noise["next"]).clamp(-1, 1)
            next_q = self.critic_target(batch.next_observations, next_actions).amin(0)
            target = batch.rewards + c.discount * batch.masks * next_q
            sampled = (mean + log_std.exp() * noise["here"]).clamp(-1, 1)
        q = self.critic(s, a)  # [critics, runs, batch]
        critic_loss = (q - target).square().mean(-1).sum(0)
        self.critic.minimize(critic_loss)
        advantage = self.critic.frozen(s, a).amin(0) - self.critic.frozen(s, sampled).amin(0)
        weight = (advantage / c.temperature).exp().clamp(max=100)
        log_pi = (-0.5 * ((a - mean) / log_std.exp()).square() - log_std).sum(-1)  # but for a constant
        actor_loss = -(weight * log_pi).mean(-1)
        minimize(actor_loss, self.actor, self.log_std)
        self.critic_target.polyak_update(c.tau)
        return {"critic_loss": critic_loss, "actor_loss": actor_loss, "weight": weight.mean(-1)}
