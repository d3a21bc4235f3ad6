"""The algorithms by the papers' equations in float64, for one run, with torch.nn and torch.optim alone.

Every number comes from the run's settings `c`; only the initial weights are read from offbench's stack.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution, kl_divergence
from torch.distributions.transforms import TanhTransform

ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh}


def networks(weights: Any, run: int) -> list[nn.Module]:
    """One run's networks of a stacked network or a target, read from its flat tensor, in float64."""
    stacked = getattr(weights, "source", weights)
    made: list[nn.Module] = []
    for member in range(stacked.ensemble_size):
        flat, modules = weights.flat.detach()[member, run].double(), []

        def take(*shape: int) -> nn.Parameter:
            nonlocal flat
            part, flat = flat.split([count := torch.Size(shape).numel(), len(flat) - count])
            return nn.Parameter(part.view(shape).clone())

        last = len(stacked.sizes) - 2
        for layer, (i, o) in enumerate(zip(stacked.sizes, stacked.sizes[1:], strict=False)):
            linear = nn.Linear(i, o)
            linear.weight, linear.bias = nn.Parameter(take(i, o).T.contiguous()), take(o)
            modules.append(linear)
            if layer < last:
                modules.append(ACTIVATIONS[stacked.activation]())
                if stacked.norm == "after":
                    norm = nn.LayerNorm(o)
                    norm.weight, norm.bias = take(o), take(o)
                    modules.append(norm)
        made.append(nn.Sequential(*modules))
    return made


def polyak(targets: list[nn.Module], sources: list[nn.Module], tau: float) -> None:
    for target, source in zip(targets, sources, strict=True):
        for p, new in zip(target.parameters(), source.parameters(), strict=True):
            p.data = (1 - tau) * p.data + tau * new.data


def step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def adam(rate: float, *parts: Any) -> torch.optim.Adam:
    every = [list(part.parameters()) if isinstance(part, nn.Module) else [part] for part in parts]
    return torch.optim.Adam([p for part in every for p in part], lr=rate)


class BC:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        (self.actor,) = networks(stack.actor, run)
        self.adam = adam(c.learning_rate, self.actor)

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        logs = {"bc": nn.functional.mse_loss(self.actor(b[0]).tanh(), b[1])}
        step(self.adam, logs["bc"])
        return logs

    def parts(self) -> dict[str, Any]:
        return {"actor": [self.actor]}


class TD3BC:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), (self.actor_target,) = networks(stack.actor, run), networks(stack.actor, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        self.actor_adam = adam(c.actor_learning_rate, self.actor)
        self.critic_adam = adam(c.critic_learning_rate, *self.critics)

    def target_noise(self, noise: Tensor) -> Tensor:
        return (self.c.policy_noise * noise).clamp(-self.c.noise_clip, self.c.noise_clip)

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, _, _), c = b, self.c
        with torch.no_grad():
            a2 = (self.actor_target(s2).tanh() + self.target_noise(noise["target"])).clamp(-1, 1)
            q2 = torch.stack([q(torch.cat([s2, a2], 1))[:, 0] for q in self.targets]).min(0).values
            y = r + c.discount * mask * q2
        logs = {"critic_loss": sum(((q(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean() for q in self.critics)}
        step(self.critic_adam, logs["critic_loss"] + self.penalty(s, a, s2, noise))
        self.count += 1
        if self.count % c.policy_freq == 0:
            pi = self.actor(s).tanh()
            q = torch.stack([q(torch.cat([s, pi], 1))[:, 0] for q in self.critics])
            constraint = self.constraint(s, a, pi, (q.max(0).values - q.min(0).values).detach())
            logs["actor_loss"] = constraint.mean() - c.alpha / q[0].abs().mean().detach() * q[0].mean()
            step(self.actor_adam, logs["actor_loss"])
            polyak([self.actor_target, *self.targets], [self.actor, *self.critics], c.tau)
        return logs

    def penalty(self, s: Tensor, a: Tensor, s2: Tensor, noise: dict[str, Tensor]) -> Tensor | float:
        return 0.0

    def constraint(self, s: Tensor, a: Tensor, pi: Tensor, spread: Tensor) -> Tensor:
        return ((pi - a) ** 2).mean(1)

    def parts(self) -> dict[str, Any]:
        parts = {"actor": [self.actor], "critic": self.critics}
        return parts | {"actor_target": [self.actor_target], "critic_target": self.targets}


class BDB(TD3BC):
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        super().__init__(stack, run, c)
        (self.discriminator,) = networks(stack.discriminator, run)
        self.discriminator_adam = adam(c.discriminator_learning_rate, self.discriminator)

    def beta(self, spread: Tensor) -> Any:
        if self.c.beta != "adaptive":
            return self.c.beta
        spread = spread.mean() if self.c.beta_scope == "batch" else spread
        return torch.minimum(torch.ones_like(spread), 1 / spread)

    def constraint(self, s: Tensor, a: Tensor, pi: Tensor, spread: Tensor) -> Tensor:
        real, fake = (self.discriminator(torch.cat([s, x], 1)).sigmoid() for x in (a, pi.detach()))
        step(self.discriminator_adam, -(torch.log(real) + torch.log(1 - fake)).mean())
        beta = self.beta(spread)
        d = self.discriminator(torch.cat([s, pi], 1))[:, 0].sigmoid()
        return beta * -torch.log(d) + (1 - beta) * super().constraint(s, a, pi, spread)

    def parts(self) -> dict[str, Any]:
        return super().parts() | {"discriminator": [self.discriminator]}


class BDBPlus(BDB):
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        super().__init__(stack, run, c)
        self.logit = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.logit_adam = adam(c.beta_learning_rate, self.logit)

    def penalty(self, s: Tensor, a: Tensor, s2: Tensor, noise: dict[str, Tensor]) -> Tensor | float:
        if self.c.critic_penalty == "none":
            return 0.0
        with torch.no_grad():
            actions = [*noise["uniform"], self.actor(s).tanh(), self.actor(s2).tanh()]
        q = torch.stack([torch.stack([q(torch.cat([s, x], 1))[:, 0] for x in [*actions, a]]) for q in self.critics])
        return self.c.penalty_weight * (q[:, :-1].exp().sum(1).log() - q[:, -1]).mean(1).sum()

    def beta(self, spread: Tensor) -> Any:
        if self.c.beta == "learned":
            return self.logit.sigmoid().detach().clamp(max=self.c.beta_max)
        beta = super().beta(spread)
        return beta.clamp(max=self.c.beta_max) if self.c.beta == "adaptive" else beta

    def constraint(self, s: Tensor, a: Tensor, pi: Tensor, spread: Tensor) -> Tensor:
        constraint = super().constraint(s, a, pi, spread)
        if self.c.beta == "learned":
            error = ((pi - a) ** 2).mean().detach()
            step(self.logit_adam, self.logit.sigmoid() * (error - self.c.beta_target))
        return constraint

    def parts(self) -> dict[str, Any]:
        return super().parts() | {"learned_beta": self.logit}


class ReBRAC(TD3BC):
    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, a2, has), c = b, self.c
        with torch.no_grad():
            pi2 = (self.actor_target(s2).tanh() + self.target_noise(noise["target"])).clamp(-1, 1)
            q2 = torch.stack([q(torch.cat([s2, pi2], 1))[:, 0] for q in self.targets]).min(0).values
            y = r + c.discount * mask * (q2 - c.critic_penalty * has * ((pi2 - a2) ** 2).sum(1))
        logs = {"critic_loss": sum(((q(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean() for q in self.critics)}
        step(self.critic_adam, logs["critic_loss"])
        self.count += 1
        if self.count % c.policy_freq == 0:
            pi = self.actor(s).tanh()
            q = torch.stack([q(torch.cat([s, pi], 1))[:, 0] for q in self.critics]).min(0).values
            logs["actor_loss"] = (c.actor_penalty * ((pi - a) ** 2).sum(1) - q / q.abs().mean().detach()).mean()
            step(self.actor_adam, logs["actor_loss"])
            polyak([self.actor_target, *self.targets], [self.actor, *self.critics], c.tau)
        return logs


class IQL:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.limited = c, 0
        (self.actor,), (self.value,) = networks(stack.actor, run), networks(stack.value, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        self.log_std = nn.Parameter(torch.zeros(stack.action_dim, dtype=torch.float64))
        self.actor_adam = adam(c.learning_rate, self.actor, self.log_std)
        self.value_adam, self.critic_adam = adam(c.learning_rate, self.value), adam(c.learning_rate, *self.critics)
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self.actor_adam, c.decay_steps)

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, _, _), c = b, self.c
        sa = torch.cat([s, a], 1)
        with torch.no_grad():
            q = torch.minimum(*(target(sa)[:, 0] for target in self.targets))
        u = q - self.value(s)[:, 0]
        logs = {"value_loss": ((c.expectile - (u < 0).double()).abs() * u**2).mean()}
        step(self.value_adam, logs["value_loss"])
        with torch.no_grad():
            weight = torch.exp(c.temperature * (q - self.value(s)[:, 0])).clamp(max=100)
        logs["weight"] = weight.mean()
        self.limited += (weight == 100).sum().item()
        policy = Normal(torch.tanh(self.actor(s)), self.log_std.exp())
        logs["actor_loss"] = -(weight * policy.log_prob(a).sum(1)).mean()
        step(self.actor_adam, logs["actor_loss"])
        self.schedule.step()
        with torch.no_grad():
            y = c.reward_scale * r + c.discount * mask * self.value(s2)[:, 0]
        logs["critic_loss"] = sum(((q(sa)[:, 0] - y) ** 2).mean() for q in self.critics)
        step(self.critic_adam, logs["critic_loss"])
        polyak(self.targets, self.critics, c.tau)
        return logs

    def parts(self) -> dict[str, Any]:
        parts = {"actor": [self.actor], "critic": self.critics, "value": [self.value]}
        return parts | {"log_std": self.log_std, "critic_target": self.targets}


class BEAR:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), (self.actor_target,) = networks(stack.actor, run), networks(stack.actor, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        (self.encoder,), (self.decoder,) = networks(stack.encoder, run), networks(stack.decoder, run)
        self.log_multiplier = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.actor_adam, self.critic_adam = adam(c.learning_rate, self.actor), adam(c.learning_rate, *self.critics)
        self.vae_adam = adam(c.learning_rate, self.encoder, self.decoder)
        self.multiplier_adam = adam(c.learning_rate, self.log_multiplier)

    def sample(self, actor: nn.Module, s: Tensor, noise: Tensor) -> Tensor:
        mean, log_std = actor(s).chunk(2, 1)
        return mean + log_std.exp() * noise  # [n, batch, act]

    def mmd(self, x: Tensor, y: Tensor) -> Tensor:
        x, y = x.transpose(0, 1), y.transpose(0, 1)  # [batch, n, act]
        order = 2 if self.c.kernel == "gaussian" else 1

        def k(p: Tensor, q: Tensor) -> Tensor:
            return torch.exp(-(torch.cdist(p, q, p=order) ** order) / (2 * self.c.kernel_width)).mean((1, 2))

        return torch.sqrt(k(x, x) + k(y, y) - 2 * k(x, y) + 1e-6).mean()

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, _, _), c = b, self.c
        mean, log_std = self.encoder(torch.cat([s, a], 1)).chunk(2, 1)
        posterior = Normal(mean, log_std.clamp(min=-4).exp())
        decoded = torch.tanh(self.decoder(torch.cat([s, mean + posterior.stddev * noise["vae"]], 1)))
        prior = Normal(torch.zeros_like(mean), torch.ones_like(mean))
        kl = kl_divergence(posterior, prior).mean()
        logs = {"vae_loss": nn.functional.mse_loss(decoded, a) + c.kl_weight * kl}
        step(self.vae_adam, logs["vae_loss"])
        with torch.no_grad():
            a2 = self.sample(self.actor_target, s2, noise["target"]).tanh()
            q = torch.stack([torch.stack([t(torch.cat([s2, x], 1))[:, 0] for x in a2]) for t in self.targets])
            mixed = c.target_min_weight * q.min(0).values + (1 - c.target_min_weight) * q.max(0).values
            y = r + c.discount * mask * mixed.max(0).values
        logs["critic_loss"] = sum(((q(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean() for q in self.critics)
        step(self.critic_adam, logs["critic_loss"])
        with torch.no_grad():
            data = torch.stack([self.decoder(torch.cat([s, z.clamp(-0.5, 0.5)], 1)) for z in noise["data"]])
        raw = self.sample(self.actor, s, noise["actor"].clamp(-0.5, 0.5))
        logs["mmd"] = self.mmd(data, raw)
        logs["actor_loss"] = self.log_multiplier.detach().exp() * logs["mmd"]
        if self.count >= c.warm_up_steps:
            pairs = [torch.cat([s, x.tanh()], 1) for x in raw]
            q = torch.stack([torch.stack([q(pair)[:, 0] for pair in pairs]).mean(0) for q in self.critics])
            logs["actor_loss"] = logs["actor_loss"] - q.min(0).values.mean()
        step(self.actor_adam, logs["actor_loss"])
        step(self.multiplier_adam, -self.log_multiplier.exp() * (logs["mmd"].detach() - c.threshold))
        polyak([self.actor_target, *self.targets], [self.actor, *self.critics], c.tau)
        self.count += 1
        return logs

    def parts(self) -> dict[str, Any]:
        parts = {"actor": [self.actor], "critic": self.critics, "encoder": [self.encoder], "decoder": [self.decoder]}
        parts |= {"actor_target": [self.actor_target], "critic_target": self.targets}
        return parts | {"log_multiplier": self.log_multiplier}


class CQL:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), self.critics = networks(stack.actor, run), networks(stack.critic, run)
        self.targets = networks(stack.critic, run)
        self.log_temperature, self.log_multiplier = (
            nn.Parameter(torch.zeros((), dtype=torch.float64)) for _ in range(2)
        )
        self.actor_adam = adam(c.actor_learning_rate, self.actor)
        self.critic_adam = adam(c.critic_learning_rate, *self.critics)
        self.temperature_adam = adam(c.actor_learning_rate, self.log_temperature)
        self.multiplier_adam = adam(c.critic_learning_rate, self.log_multiplier)

    def sample(self, s: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, TransformedDistribution]:
        """The policy's actions for a noise [..., batch, act], their log-densities, and the policy."""
        mean, log_std = self.actor(s).chunk(2, 1)
        policy = TransformedDistribution(Independent(Normal(mean, log_std.exp()), 1), [TanhTransform()])
        actions = torch.tanh(mean + log_std.exp() * noise)
        return actions, policy.log_prob(actions), policy

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, _, _), c = b, self.c
        with torch.no_grad():
            a2, _, _ = self.sample(s2, noise["target"][0])
            y = r + c.discount * mask * torch.minimum(*(q(torch.cat([s2, a2], 1))[:, 0] for q in self.targets))
            here, there = self.sample(s, noise["here"]), self.sample(s2, noise["there"])
            actions = torch.cat([noise["uniform"], here[0], there[0]])
            density = torch.cat([torch.full_like(here[1], 0.5 ** a.shape[1]), here[1].exp(), there[1].exp()])
        td, penalty = 0.0, 0.0  # type: Any, Any
        for q in self.critics:
            data, others = q(torch.cat([s, a], 1))[:, 0], torch.stack([q(torch.cat([s, x], 1))[:, 0] for x in actions])
            td += ((data - y) ** 2).mean()
            penalty += c.alpha * ((others.exp() / density).sum(0).log() - data).mean()
        logs = {"critic_loss": td, "penalty": penalty}
        if c.lagrange:
            gap = penalty - len(self.critics) * c.target_action_gap
            logs["multiplier"] = self.log_multiplier.exp()
            step(self.critic_adam, td + logs["multiplier"].detach() * gap)
            step(self.multiplier_adam, -logs["multiplier"] * gap.detach() / 2)
        else:
            step(self.critic_adam, td + penalty)
        pi, log_pi, policy = self.sample(s, noise["actor"][0])
        if self.count < c.bc_steps:
            value = policy.log_prob(a.clamp(-0.999, 0.999))
        else:
            value = torch.minimum(*(q(torch.cat([s, pi], 1))[:, 0] for q in self.critics))
        logs["actor_loss"] = (self.log_temperature.exp().detach() * log_pi - value).mean()
        step(self.actor_adam, logs["actor_loss"])
        step(self.temperature_adam, -self.log_temperature * (log_pi.mean().detach() - a.shape[1]))
        polyak(self.targets, self.critics, c.tau)
        self.count += 1
        return logs

    def parts(self) -> dict[str, Any]:
        parts = {"actor": [self.actor], "critic": self.critics, "critic_target": self.targets}
        parts |= {"log_temperature": self.log_temperature}
        return parts | {"log_multiplier": self.log_multiplier}
