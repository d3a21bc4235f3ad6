"""TD3+BC, BDB, IQL, ReBRAC and BEAR against the papers' equations, computed once more in float64 with torch.nn alone.

Two runs with different settings and seeds in one stack, 200 updates: losses and all parameters agree.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from offbench.algorithm import Batch, stack_configs
from offbench.training.registry import load_algorithm

OBS, ACT, BATCH, UPDATES = 5, 3, 16, 200
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


def polyak(targets: list[nn.Module], sources: list[nn.Module]) -> None:
    for target, source in zip(targets, sources, strict=True):
        for p, new in zip(target.parameters(), source.parameters(), strict=True):
            p.data = 0.995 * p.data + 0.005 * new.data


def step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def adam(rate: float, *parts: Any) -> torch.optim.Adam:
    every = [list(part.parameters()) if isinstance(part, nn.Module) else [part] for part in parts]
    return torch.optim.Adam([p for part in every for p in part], lr=rate)


class TD3BC:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), (self.actor_target,) = networks(stack.actor, run), networks(stack.actor, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        self.actor_adam, self.critic_adam = adam(3e-4, self.actor), adam(3e-4, *self.critics)

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, _, _), c = b, self.c
        with torch.no_grad():
            a2 = (self.actor_target(s2).tanh() + (0.2 * noise["target"]).clamp(-0.5, 0.5)).clamp(-1, 1)
            q2 = torch.stack([q(torch.cat([s2, a2], 1))[:, 0] for q in self.targets]).min(0).values
            y = r + 0.99 * mask * q2
        logs = {"critic_loss": sum(((q(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean() for q in self.critics)}
        step(self.critic_adam, logs["critic_loss"])
        self.count += 1
        if self.count % 2 == 0:
            pi = self.actor(s).tanh()
            q = torch.stack([q(torch.cat([s, pi], 1))[:, 0] for q in self.critics])
            constraint = self.constraint(s, a, pi, (q.max(0).values - q.min(0).values).detach())
            logs["actor_loss"] = constraint.mean() - c.alpha / q[0].abs().mean().detach() * q[0].mean()
            step(self.actor_adam, logs["actor_loss"])
            polyak([self.actor_target, *self.targets], [self.actor, *self.critics])
        return logs

    def constraint(self, s: Tensor, a: Tensor, pi: Tensor, spread: Tensor) -> Tensor:
        return ((pi - a) ** 2).mean(1)

    def parts(self) -> dict[str, list[nn.Module]]:
        parts = {"actor": [self.actor], "critic": self.critics}
        return parts | {"actor_target": [self.actor_target], "critic_target": self.targets}


class BDB(TD3BC):
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        super().__init__(stack, run, c)
        (self.discriminator,) = networks(stack.discriminator, run)
        self.discriminator_adam = adam(3e-4, self.discriminator)

    def constraint(self, s: Tensor, a: Tensor, pi: Tensor, spread: Tensor) -> Tensor:
        real, fake = (self.discriminator(torch.cat([s, x], 1)).sigmoid() for x in (a, pi.detach()))
        step(self.discriminator_adam, -(torch.log(real) + torch.log(1 - fake)).mean())
        beta = torch.minimum(torch.ones_like(spread), 1 / spread) if self.c.beta == "adaptive" else self.c.beta
        d = self.discriminator(torch.cat([s, pi], 1))[:, 0].sigmoid()
        return beta * -torch.log(d) + (1 - beta) * super().constraint(s, a, pi, spread)

    def parts(self) -> dict[str, list[nn.Module]]:
        return super().parts() | {"discriminator": [self.discriminator]}


class ReBRAC:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), (self.actor_target,) = networks(stack.actor, run), networks(stack.actor, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        self.actor_adam, self.critic_adam = adam(1e-3, self.actor), adam(1e-3, *self.critics)

    def update(self, b: list[Tensor], noise: dict[str, Tensor]) -> dict[str, Tensor]:
        (s, a, r, s2, mask, a2, has), c = b, self.c
        with torch.no_grad():
            pi2 = (self.actor_target(s2).tanh() + (0.2 * noise["target"]).clamp(-0.5, 0.5)).clamp(-1, 1)
            q2 = torch.stack([q(torch.cat([s2, pi2], 1))[:, 0] for q in self.targets]).min(0).values
            y = r + 0.99 * mask * (q2 - c.critic_penalty * has * ((pi2 - a2) ** 2).sum(1))
        logs = {"critic_loss": sum(((q(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean() for q in self.critics)}
        step(self.critic_adam, logs["critic_loss"])
        self.count += 1
        if self.count % 2 == 0:
            pi = self.actor(s).tanh()
            q = torch.stack([q(torch.cat([s, pi], 1))[:, 0] for q in self.critics]).min(0).values
            logs["actor_loss"] = (c.actor_penalty * ((pi - a) ** 2).sum(1) - q / q.abs().mean().detach()).mean()
            step(self.actor_adam, logs["actor_loss"])
            polyak([self.actor_target, *self.targets], [self.actor, *self.critics])
        return logs

    def parts(self) -> dict[str, list[nn.Module]]:
        return {"actor": [self.actor], "critic": self.critics}


class IQL:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c = c
        (self.actor,), (self.value,) = networks(stack.actor, run), networks(stack.value, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        self.log_std = nn.Parameter(torch.zeros(ACT, dtype=torch.float64))
        self.actor_adam = adam(3e-4, self.actor, self.log_std)
        self.value_adam, self.critic_adam = adam(3e-4, self.value), adam(3e-4, *self.critics)
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
        policy = torch.distributions.Normal(torch.tanh(self.actor(s)), self.log_std.exp())
        logs["actor_loss"] = -(weight * policy.log_prob(a).sum(1)).mean()
        step(self.actor_adam, logs["actor_loss"])
        self.schedule.step()
        with torch.no_grad():
            y = c.reward_scale * r + 0.99 * mask * self.value(s2)[:, 0]
        logs["critic_loss"] = sum(((q(sa)[:, 0] - y) ** 2).mean() for q in self.critics)
        step(self.critic_adam, logs["critic_loss"])
        polyak(self.targets, self.critics)
        return logs

    def parts(self) -> dict[str, list[nn.Module]]:
        return {"actor": [self.actor], "critic": self.critics, "value": [self.value]}


class BEAR:
    def __init__(self, stack: Any, run: int, c: Any) -> None:
        self.c, self.count = c, 0
        (self.actor,), (self.actor_target,) = networks(stack.actor, run), networks(stack.actor, run)
        self.critics, self.targets = networks(stack.critic, run), networks(stack.critic, run)
        (self.encoder,), (self.decoder,) = networks(stack.encoder, run), networks(stack.decoder, run)
        self.log_multiplier = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.actor_adam, self.critic_adam = adam(1e-3, self.actor), adam(1e-3, *self.critics)
        self.vae_adam, self.multiplier_adam = adam(1e-3, self.encoder, self.decoder), adam(1e-3, self.log_multiplier)

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
        posterior = torch.distributions.Normal(mean, log_std.clamp(min=-4).exp())
        decoded = torch.tanh(self.decoder(torch.cat([s, mean + posterior.stddev * noise["vae"]], 1)))
        prior = torch.distributions.Normal(torch.zeros_like(mean), torch.ones_like(mean))
        kl = torch.distributions.kl_divergence(posterior, prior).mean()
        logs = {"vae_loss": nn.functional.mse_loss(decoded, a) + 0.5 * kl}
        step(self.vae_adam, logs["vae_loss"])
        with torch.no_grad():
            a2 = self.sample(self.actor_target, s2, noise["target"]).tanh()
            q = torch.stack([torch.stack([t(torch.cat([s2, x], 1))[:, 0] for x in a2]) for t in self.targets])
            y = r + 0.99 * mask * (0.75 * q.min(0).values + 0.25 * q.max(0).values).max(0).values
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
        polyak([self.actor_target, *self.targets], [self.actor, *self.critics])
        self.count += 1
        return logs

    def parts(self) -> dict[str, list[nn.Module]]:
        return {"actor": [self.actor], "critic": self.critics, "encoder": [self.encoder], "decoder": [self.decoder]}


CASES: dict[str, tuple[Callable[..., Any], dict[str, Any], list[dict[str, Any]]]] = {
    "td3_bc": (TD3BC, {}, [{"alpha": 2.5}, {"alpha": 1.0}]),
    "bdb": (BDB, {}, [{"beta": 0.3}, {"beta": "adaptive"}]),
    "bdb of four critics": (BDB, {"critics": 4}, [{"beta": 1.0}, {"beta": "adaptive"}]),
    "iql": (
        IQL,
        {"decay_steps": 300},
        [{"expectile": 0.7, "temperature": 3.0}, {"expectile": 0.9, "temperature": 0.5, "reward_scale": 0.1}],
    ),
    "rebrac": (
        ReBRAC,
        {},
        [{"actor_penalty": 0.5, "critic_penalty": 0.3}, {"actor_penalty": 0.01, "critic_penalty": 0.0}],
    ),
    "bear": (
        BEAR,
        {"vae_hidden": (16, 16), "match_samples": 2, "target_samples": 3, "warm_up_steps": 100, "kernel_width": 2.0},
        [{"threshold": 0.05}, {"threshold": 0.5}],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_an_algorithm_follows_its_float64_reference_for_200_updates(name: str) -> None:
    reference, shared, settings = CASES[name]
    kind, generator = load_algorithm(name.partition(" ")[0]), torch.Generator().manual_seed(1)
    configs = [kind.Config(hidden=(16, 16), batch_size=BATCH, **shared, **own) for own in settings]
    stack: Any = kind(stack_configs(configs, "cpu"), OBS, ACT, [3, 4], "cpu")
    if reference is BDB:  # larger Q, so that the critics disagree by more than 1 and adaptive beta leaves its bound
        with torch.no_grad():
            stack.critic.flat *= 2.5
            stack.critic_target.flat.copy_(stack.critic.flat)
    references = [reference(stack, run, config) for run, config in enumerate(configs)]
    start = stack.actor.flat.detach().clone()

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, *shape, generator=generator)

    for number in range(UPDATES):
        masks, has = ((torch.rand(2, BATCH, generator=generator) > 0.2).float() for _ in range(2))
        actions, next_actions = (0.95 * normal(BATCH, ACT).tanh() for _ in range(2))
        known = next_actions * has.unsqueeze(-1)
        batch = Batch(normal(BATCH, OBS), actions, normal(BATCH), normal(BATCH, OBS), masks, known, has)
        noise = {key: normal(*found.shape) for key, found in stack.noise_spec(stack.config).items()}
        logs = stack.update(batch, noise, stack.phase(number))
        for run, one in enumerate(references):
            losses = one.update([x[run].double() for x in batch], {key: x[run].double() for key, x in noise.items()})
            for key, loss in losses.items():
                assert logs[key].detach()[run].item() == pytest.approx(loss.item(), rel=2e-3, abs=1e-4), (number, key)
    for run, one in enumerate(references):
        for part, theirs in one.parts().items():
            ours = networks(getattr(stack, part), run)
            for a, b in zip(ours, theirs, strict=True):
                for p, q in zip(a.parameters(), b.parameters(), strict=True):
                    torch.testing.assert_close(p, q, rtol=0, atol=1e-5 if issubclass(reference, TD3BC) else 2e-4)
            # nothing moves what is there for alignment alone
            assert not getattr(stack, part).flat[..., sum(p.numel() for p in theirs[0].parameters()) :].any()
    assert (stack.actor.flat - start).abs().max() > 1e-2  # it did move
    if reference is BDB:
        assert 0.01 < logs["beta"][1].item() < 0.99  # the rule was at work, not at its bound
    if name == "bear":
        values = [one.log_multiplier.item() for one in references]
        torch.testing.assert_close(stack.log_multiplier.value.tolist(), values, rtol=0, atol=1e-4)
        assert values[0] > 0.01
        assert values[1] < -0.01  # held from both sides
