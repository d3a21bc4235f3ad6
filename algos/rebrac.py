"""ReBRAC: Tarasov et al., "Revisiting the Minimalist Approach to Offline Reinforcement Learning", NeurIPS 2023.

Reference: the authors' code in CORL, `rebrac.py`. TD3+BC (td3_bc.py) with deeper networks, LayerNorm in the critics,
larger batches, and a penalty on the target actions too; a' are the target's actions, b' the data's next actions:

    critic   y = r + discount (1 - terminated) [min_i Q'_i(s', a') - critic_penalty |a' - b'|^2]
             a' = clip(pi'(s') + clip(noise));   loss = sum_i mean (Q_i(s, a) - y)^2
    actor    loss = mean [actor_penalty |pi(s) - a|^2 - lambda min_i Q_i(s, pi(s))],   lambda = 1 / mean |min_i Q_i|

Squares are summed over the action's dimensions. The actor and all targets are updated at every `policy_freq`-th
update only. The authors tuned the penalties for each dataset; the defaults are those of hopper-medium
(halfcheetah-medium has actor_penalty 0.001). Deviations: where the data has no next action, at a truncated episode's
end, there is no penalty on a' (the authors drop that transition); initial weights are torch.nn.Linear's (theirs have
biases of 0.1 and a last layer near 0); the actor's target follows it after its update (theirs before); the actor's
updates are the second, fourth, ... (theirs the first, third, ...).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from offbench.algorithm import Algorithm, Batch, Logs, Noise, NoiseSpec, Target, normal, per_sample, setting


@dataclass(frozen=True)
class Config:
    """Settings of ReBRAC (the authors' for locomotion)."""

    actor_penalty: float = setting(0.01, "weight of the actor's distance from the data", low=0, per_run=True)
    critic_penalty: float = setting(0.01, "weight of the target actions' distance from the data", low=0, per_run=True)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the targets", above=0, high=1)
    policy_noise: float = setting(0.2, "std of the noise on target actions, in units of the largest action", low=0)
    noise_clip: float = setting(0.5, "that noise is clipped to +- this", low=0)
    policy_freq: int = setting(2, "updates of the critics for each of the actor and targets", low=1)
    critics: int = setting(2, "number of critics", low=1)
    actor_learning_rate: float = setting(1e-3, "Adam's learning rate of the actor", above=0)
    critic_learning_rate: float = setting(1e-3, "Adam's learning rate of the critics", above=0)
    batch_size: int = setting(1024, "transitions per update", low=1)
    hidden: tuple[int, ...] = setting((256, 256, 256), "hidden layers of actor and critics", low=1)
    normalize: bool = setting(False, "normalize observations by the dataset's mean and std + 1e-3")


class ReBRAC(Algorithm[Config]):
    """A stack of ReBRAC runs."""

    uses_next_actions = True

    def setup(self, c: Config) -> None:
        """Make the actor, the critics with LayerNorm, and the target of each."""
        self.actor = self.actor_network(self.action_dim, c.actor_learning_rate)
        self.critic = self.critic_network(c.critic_learning_rate, ensemble_size=c.critics, norm="after")
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
            distance = (next_actions - batch.next_actions).square().sum(-1) * batch.next_action_masks
            next_q = self.critic_target(batch.next_observations, next_actions).amin(0)
            next_q = next_q - per_sample(c.critic_penalty) * distance
            target = batch.rewards + c.discount * batch.masks * next_q
        q = self.critic(batch.observations, batch.actions)  # [critics, runs, batch]
        loss = (q - target).square().mean(-1).sum(0)
        return {"critic_loss": loss, "q_abs": q[0].abs().mean(-1), "next_distance": distance.mean(-1)}

    def actor_loss(self, batch: Batch, c: Config) -> Logs:
        """Return the actor's loss."""
        pi = self.actor(batch.observations).tanh()
        q = self.critic.frozen(batch.observations, pi).amin(0)
        lambda_q = q.mean(-1) / q.detach().abs().mean(-1)
        distance = (pi - batch.actions).square().sum(-1).mean(-1)
        return {"actor_loss": c.actor_penalty * distance - lambda_q, "lambda_q": lambda_q, "distance": distance}

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        """Update the critics; in every `policy_freq`-th update the actor and the targets too."""
        c = self.config
        logs = self.critic_loss(batch, noise["target"], c)
        self.critic.minimize(logs["critic_loss"])
        if phase:
            logs |= self.actor_loss(batch, c)
            self.actor.minimize(logs["actor_loss"])
            self.actor_target.polyak_update(c.tau)
            self.critic_target.polyak_update(c.tau)
        return logs
