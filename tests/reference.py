"""TD3+BC and BDB once more, written from the papers' equations in float64, with no offbench code in it.

One run, one network at a time, torch.nn and torch.optim alone. Used as the independent side of the tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn


def mlp(layers: list[tuple[Any, Any]], activation: type[nn.Module], out: type[nn.Module] | None = None) -> nn.Module:
    """A float64 network with given weights ([in, out] and [out] arrays)."""
    modules: list[nn.Module] = []
    for i, (weight, bias) in enumerate(layers):
        linear = nn.Linear(*weight.shape).double()
        with torch.no_grad():
            linear.weight.copy_(torch.as_tensor(np.asarray(weight, np.float64).T))
            linear.bias.copy_(torch.as_tensor(np.asarray(bias, np.float64)))
        modules.append(linear)
        if i < len(layers) - 1:
            modules.append(activation())
    if out:
        modules.append(out())
    return nn.Sequential(*modules)


class Reference:
    """TD3+BC; BDB where `beta` is given (a number, or "adaptive")."""

    def __init__(self, actor: Any, critics: list[Any], discriminator: Any = None, beta: Any = None, lr: float = 3e-4):
        self.actor, self.actor_target = (mlp(actor, nn.ReLU, nn.Tanh) for _ in range(2))
        self.critics, self.critic_targets = ([mlp(c, nn.ReLU) for c in critics] for _ in range(2))
        self.beta, self.step = beta, 0
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=lr)
        parameters = [p for critic in self.critics for p in critic.parameters()]
        self.critic_optimizer = torch.optim.Adam(parameters, lr=lr)
        if beta is not None:
            self.discriminator = mlp(discriminator, nn.Tanh, nn.Sigmoid)
            self.discriminator_optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=lr)

    def update(self, s: Any, a: Any, r: Any, s2: Any, terminated: Any, noise: Any, alpha: float = 2.5) -> None:
        """One step on a batch, as in Fujimoto & Gu's algorithm and the BDB paper's Algorithm 1."""
        self.step += 1
        with torch.no_grad():
            a2 = torch.clamp(self.actor_target(s2) + torch.clamp(0.2 * noise, -0.5, 0.5), -1, 1)
            q2 = torch.stack([c(torch.cat([s2, a2], 1))[:, 0] for c in self.critic_targets])
            y = r + 0.99 * (1 - terminated) * q2.min(0).values
        loss = sum(torch.mean((c(torch.cat([s, a], 1))[:, 0] - y) ** 2) for c in self.critics)
        self._step(self.critic_optimizer, loss)
        if self.step % 2:
            return
        if self.beta is not None:
            real = self.discriminator(torch.cat([s, a], 1))
            fake = self.discriminator(torch.cat([s, self.actor(s).detach()], 1))
            self._step(self.discriminator_optimizer, -(torch.log(real) + torch.log(1 - fake)).mean())
        pi = self.actor(s)
        q = torch.stack([c(torch.cat([s, pi], 1))[:, 0] for c in self.critics])
        loss = -alpha / q[0].abs().mean().detach() * q[0].mean()
        cloning = ((pi - a) ** 2).mean(1)
        if self.beta is None:
            loss = loss + cloning.mean()
        else:
            beta = self.beta
            if beta == "adaptive":
                spread = (q.max(0).values - q.min(0).values).detach()
                beta = torch.minimum(torch.ones_like(spread), 1 / spread)
            d = self.discriminator(torch.cat([s, pi], 1))[:, 0]
            loss = loss + (beta * -torch.log(d) + (1 - beta) * cloning).mean()
        self._step(self.actor_optimizer, loss)
        for target, source in [
            (self.actor_target, self.actor),
            *zip(self.critic_targets, self.critics, strict=True),
        ]:
            for p, q_ in zip(target.parameters(), source.parameters(), strict=True):
                p.data = 0.995 * p.data + 0.005 * q_.data

    @staticmethod
    def _step(optimizer: torch.optim.Optimizer, loss: Any) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def flat(network: nn.Module) -> torch.Tensor:
    """All parameters in offbench's order: W [in, out] row by row, then b, layer after layer."""
    parts = []
    for module in network:  # type: ignore[attr-defined]
        if isinstance(module, nn.Linear):
            parts += [module.weight.detach().T.reshape(-1), module.bias.detach()]
    return torch.cat(parts)
