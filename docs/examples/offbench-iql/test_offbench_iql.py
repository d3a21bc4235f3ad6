"""IQL against the paper's equations, computed once more in float64 with torch.nn and none of offbench's code."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from offbench_iql import IQL, Config
from torch import nn

from offbench.algorithm import Batch, stack_configs

OBS, ACT, BATCH, UPDATES = 5, 3, 32, 100
SETTINGS = [{"expectile": 0.7, "temperature": 3.0}, {"expectile": 0.9, "temperature": 0.5, "reward_scale": 0.1}]


def network(layers: list[tuple[Any, Any]]) -> nn.Sequential:
    modules: list[nn.Module] = []
    for weight, bias in layers:
        linear = nn.Linear(*weight.shape).double()
        linear.weight.data, linear.bias.data = weight.double().T.contiguous(), bias.double()
        modules += [linear, nn.ReLU()]
    return nn.Sequential(*modules[:-1])


def copies(stacked: Any, run: int) -> list[nn.Sequential]:
    """One run's networks of a stacked one, read from its flat tensor."""
    found = []
    for member in range(stacked.ensemble_size):
        flat, layers = stacked.flat.detach()[member, run], []
        for fan_in, fan_out in zip(stacked.sizes, stacked.sizes[1:], strict=False):
            weight, flat = flat[: fan_in * fan_out].view(fan_in, fan_out), flat[fan_in * fan_out :]
            bias, flat = flat[:fan_out], flat[fan_out:]
            layers.append((weight.clone(), bias.clone()))
        found.append(network(layers))
    return found


class Reference:
    """One run of IQL in float64."""

    def __init__(self, stack: IQL, run: int) -> None:
        (self.actor,), (self.value,) = copies(stack.actor, run), copies(stack.value, run)
        self.critics, self.targets = copies(stack.critic, run), copies(stack.critic, run)
        self.log_std = torch.zeros(ACT, dtype=torch.float64, requires_grad=True)
        groups = {"value": [self.value], "actor": [self.actor], "critic": self.critics}
        self.adam = {
            name: torch.optim.Adam(
                [p for m in modules for p in m.parameters()] + ([self.log_std] if name == "actor" else []), lr=3e-4
            )
            for name, modules in groups.items()
        }

    def update(self, batch: list[torch.Tensor], tau: float, kappa: float, scale: float) -> dict[str, float]:
        s, a, r, s2, mask = batch
        sa = torch.cat([s, a], 1)
        with torch.no_grad():
            q = torch.minimum(self.targets[0](sa), self.targets[1](sa))[:, 0]
        u = q - self.value(s)[:, 0]
        value = torch.mean(torch.abs(tau - (u < 0).double()) * u**2)
        self.step("value", value)
        with torch.no_grad():
            weight = torch.minimum(torch.exp(kappa * (q - self.value(s)[:, 0])), torch.tensor(100.0))
        normal = torch.distributions.Normal(torch.tanh(self.actor(s)), torch.exp(self.log_std))
        actor = -torch.mean(weight * normal.log_prob(a).sum(1))
        self.step("actor", actor)
        with torch.no_grad():
            y = scale * r + 0.99 * mask * self.value(s2)[:, 0]
        critic = sum(torch.mean((c(sa)[:, 0] - y) ** 2) for c in self.critics)
        self.step("critic", critic)
        for target, source in zip(self.targets, self.critics, strict=True):
            for p, new in zip(target.parameters(), source.parameters(), strict=True):
                p.data = 0.995 * p.data + 0.005 * new.data
        return {"value_loss": value.item(), "actor_loss": actor.item(), "critic_loss": critic.item()}

    def step(self, name: str, loss: Any) -> None:
        self.adam[name].zero_grad()
        loss.backward()
        self.adam[name].step()


def test_losses_and_parameters_follow_the_equations() -> None:
    generator = torch.Generator().manual_seed(1)
    configs = [Config(hidden=(16, 16), **values) for values in SETTINGS]
    stack = IQL(stack_configs(configs, "cpu"), OBS, ACT, [3, 4], "cpu")
    references = [Reference(stack, run) for run in range(2)]
    for _ in range(UPDATES):
        s, s2 = (torch.randn(2, BATCH, OBS, generator=generator) for _ in range(2))
        a = torch.rand(2, BATCH, ACT, generator=generator) * 2 - 1
        r = torch.randn(2, BATCH, generator=generator)
        masks = (torch.rand(2, BATCH, generator=generator) > 0.2).float()
        logs = stack.update(Batch(s, a, r, s2, masks), {}, stack.phase(0))
        logs = {name: value.detach() for name, value in logs.items()}
        for run, reference in enumerate(references):
            config = configs[run]
            alone = [x[run].double() for x in (s, a, r, s2, masks)]
            losses = reference.update(alone, config.expectile, config.temperature, config.reward_scale)
            for name, loss in losses.items():
                assert logs[name][run].item() == pytest.approx(loss, rel=1e-4, abs=1e-5), name
    for run, reference in enumerate(references):
        for mine, theirs in ((stack.actor, [reference.actor]), (stack.value, [reference.value])):
            assert_same(copies(mine, run), theirs)
        assert_same(copies(stack.critic, run), reference.critics)
        torch.testing.assert_close(stack.log_std.flat[0, run].double(), reference.log_std, rtol=0, atol=1e-5)
        assert reference.log_std.abs().min() > 1e-3  # it has moved


def assert_same(mine: list[nn.Sequential], theirs: list[nn.Sequential]) -> None:
    for a, b in zip(mine, theirs, strict=True):
        for p, q in zip(a.parameters(), b.parameters(), strict=True):
            torch.testing.assert_close(p, q, rtol=0, atol=1e-5)
