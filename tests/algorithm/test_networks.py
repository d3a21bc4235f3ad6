"""What networks and batches offer beyond plain MLPs, against PyTorch's own and by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import offbench
from offbench.algorithm import Batch, Logs, Network, Noise, NoiseSpec, cosine_decay, linear_decay, normal
from offbench.common.errors import OffbenchError
from offbench.training.batches import StackData
from offbench.training.spec import RunSpec
from tests.algorithm.references import networks
from tests.algorithm.test_cpu_capture import Plain, stack_of, trained
from tests.made_datasets import episode, foreign


def network(**options: Any) -> Network:
    return Network(3, (8, 8), None, [0, 1], 0, learning_rate=1e-2, ensemble_size=2, **options)


@pytest.mark.parametrize("norm", ["before", "after"])
def test_layer_norm_is_pytorchs(norm: Any) -> None:
    ours = network(norm=norm)
    with torch.no_grad():
        ours.flat += 0.1 * torch.randn(ours.flat.shape)  # gains and shifts too
    x = torch.randn(2, 16, 3)
    for run in range(2):
        for member, theirs in enumerate(networks(ours, run) if norm == "after" else moved(networks, ours, run)):
            torch.testing.assert_close(ours(x)[member, run].double(), theirs(x[run].double())[:, 0], atol=1e-5, rtol=0)
    assert ours.frozen(x, members=1).shape == (2, 16)
    with pytest.raises(OffbenchError, match="cannot hold a network with LayerNorm"):
        ours.layers(0)


def moved(read: Any, ours: Network, run: int) -> list[nn.Sequential]:
    """The same networks with each norm before its activation."""
    ours.norm = "after"
    made = [nn.Sequential(*(part[i] for i in (0, 2, 1, 3, 5, 4, 6))) for part in read(ours, run)]
    ours.norm = "before"
    return made


def test_weight_decay_is_adamws() -> None:
    ours = network(weight_decay=0.1)
    theirs = networks(ours, 0)
    adam = torch.optim.AdamW([p for net in theirs for p in net.parameters()], lr=1e-2, weight_decay=0.1)
    for _ in range(20):
        x = torch.randn(2, 16, 3)
        ours.minimize((ours(x) - 1).square().mean(-1).sum(0))
        loss = sum(((net(x[0].double())[:, 0] - 1) ** 2).mean() for net in theirs)
        adam.zero_grad()
        loss.backward()  # type: ignore[union-attr]
        adam.step()
    for net, expected in zip(networks(ours, 0), theirs, strict=True):
        for p, q in zip(net.parameters(), expected.parameters(), strict=True):
            torch.testing.assert_close(p, q, atol=1e-5, rtol=0)


def test_schedules_begin_at_the_rate_and_end_at_zero() -> None:
    for schedule, half in ((cosine_decay(0.1, 10), 0.05), (linear_decay(0.1, 10), 0.05)):
        rates = [schedule(torch.tensor(float(step))).item() for step in (0, 5, 10, 20)]
        assert rates == pytest.approx([0.1, half, 0.0, 0.0], abs=1e-7)
    assert cosine_decay(0.1, 10)(torch.tensor(2.5)).item() == pytest.approx(0.05 * (1 + 0.5**0.5))


class Penalized(Plain):
    """A critic of the data's rewards whose gradient in the actions is penalized, with a rate that decays."""

    def setup(self, c: Any) -> None:
        super().setup(c)
        rate = cosine_decay(1e-2, 100)
        self.critic = self.critic_network(rate, hidden=(8,), activation="tanh", twice_differentiable=True)

    def noise_spec(self, c: Any) -> NoiseSpec:
        return {"x": normal(c.batch_size, self.action_dim)}

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        actions = noise["x"].detach().requires_grad_()
        (gradient,) = torch.autograd.grad(self.critic(batch.observations, actions).sum(), actions, create_graph=True)
        penalty = gradient.square().sum(-1).mean(-1)
        loss = (self.critic(batch.observations, batch.actions) - batch.rewards).square().mean(-1).sum(0) + penalty
        self.critic.minimize(loss)
        return super().update(batch, noise, phase) | {"loss": loss, "penalty": penalty}


def test_a_gradient_penalty_is_replayed_with_the_same_bits() -> None:
    ours, eager = stack_of(Penalized, 2), stack_of(Penalized, 2)
    eager.captured_update.eager = True
    (found, logs), (expected, others) = trained(ours, 40), trained(eager, 40)
    assert not ours.captured_update.eager
    assert logs == others
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert logs[0]["penalty"] > 0


def test_a_gradient_penalty_by_finite_differences() -> None:
    """The gradient of the squared gradient, along a random direction of the weights."""
    ours = network(activation="tanh", twice_differentiable=True)
    x = torch.randn(2, 4, 3)

    def penalty(flat: Tensor) -> Tensor:
        inputs = x.to(flat.dtype).requires_grad_()
        (gradient,) = torch.autograd.grad(ours.forward(flat, inputs).sum(), inputs, create_graph=True)
        return gradient.square().sum()

    (found,) = torch.autograd.grad(penalty(ours.flat), [ours.flat])
    direction, flat = torch.randn(ours.flat.shape, dtype=torch.float64), ours.flat.detach().double()
    with torch.enable_grad():
        slope = (penalty(flat + 1e-5 * direction) - penalty(flat - 1e-5 * direction)) / 2e-5
    assert (found.double() * direction).sum().item() == pytest.approx(slope.item(), rel=1e-3)


def test_next_actions_by_hand(home: Any) -> None:
    """Two datasets, in each an episode of 3 that is truncated, and one of 2 that terminates."""
    kinds = []
    for number, name in enumerate(("one-v0", "two-v0")):
        low, high = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)
        values = np.linspace(0, 1, 5).reshape(5, 1) * (high - low) * (0.5 + 0.5 * number) + low
        parts = [
            episode(3, 0, False, actions=values[:3].astype(np.float32)),
            episode(2, 1, True, actions=values[3:].astype(np.float32)),
        ]
        kinds.append(foreign(name, parts))
    datasets = {name: offbench.load(name) for name in kinds}
    config = Plain.Config()
    specs = [RunSpec("x", config, name, 0, 1, 1, 1, home) for name in kinds]
    batch = StackData(specs, datasets, True, torch.device("cpu"), True).batch(torch.arange(5).repeat(2, 1))
    for run, name in enumerate(kinds):
        actions = torch.from_numpy(np.array(datasets[name].actions))
        assert torch.equal(batch.actions[run], actions)
        assert batch.next_action_masks[run].tolist() == [1, 1, 0, 1, 0]
        for index in range(5):
            expected = actions[index + 1] if index in (0, 1, 3) else torch.zeros(2)
            assert torch.equal(batch.next_actions[run, index], expected)
    without = StackData(specs, datasets, True, torch.device("cpu")).batch(torch.arange(5).repeat(2, 1))
    with pytest.raises(RuntimeError):
        without.actions - without.next_actions
