"""The limits of log standard deviations and of BEAR's multiplier, at values beyond them on both sides."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from offbench.algorithm import Batch, Network
from offbench.algos.cql import sample
from tests.algorithm.test_td3_bc_and_bdb import ACT, BATCH, batches, make


def set_outputs(network: Network, outputs: list[float]) -> None:
    """Give a network these outputs for every input: weights of 0, and the outputs as the last biases."""
    size = sum((i + 1) * o for i, o in itertools.pairwise(network.sizes))
    with torch.no_grad():
        network.flat.zero_()
        network.flat[..., size - len(outputs) : size] = torch.tensor(outputs)


def normal_noise(*shape: int) -> Tensor:
    return torch.randn(1, *shape, generator=torch.Generator().manual_seed(0))


def an_actor_beyond_the_limits(name: str) -> tuple[Any, Batch]:
    """Return an algorithm whose actor has means of 0 and log standard deviations of 5 and -30, and a batch."""
    algorithm = make(name, [{}])
    set_outputs(algorithm.actor, [0.0, 0.0, 5.0, -30.0])
    return algorithm, next(batches(1))[0]


def test_cql_limits_the_log_std_of_the_actor_to_minus_20_and_2() -> None:
    algorithm, batch = an_actor_beyond_the_limits("cql")
    noise, std = normal_noise(1, BATCH, ACT), torch.tensor([math.exp(2), math.exp(-20)], dtype=torch.float64)
    u = std * noise.double()
    slope = -2 * u.abs() + 2 * math.log(2) - 2 * torch.log1p(torch.exp(-2 * u.abs()))  # log(1 - tanh(u)^2)
    expected = (Normal(torch.zeros_like(std), std).log_prob(u) - slope).sum(-1)
    log_pi = algorithm.actor_loss(batch, noise, torch.ones(1), cloning=True)["log_pi"]
    torch.testing.assert_close(log_pi.double(), expected.mean((1, 2)))
    actions, log_density = sample(algorithm.actor, batch.observations, noise)
    torch.testing.assert_close(log_density.double(), expected)
    torch.testing.assert_close(actions.double(), u.tanh(), rtol=1e-5, atol=0)


def test_bear_limits_the_log_std_of_the_actor_to_minus_20_and_2() -> None:
    algorithm, batch = an_actor_beyond_the_limits("bear")
    noise = normal_noise(4, BATCH, ACT)
    samples = algorithm.sample(algorithm.actor, batch.observations, noise)
    expected = noise.double() * torch.tensor([math.exp(2), math.exp(-20)])
    torch.testing.assert_close(samples.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("output", "limit"), [(-9.0, -4.0), (5.0, 2.0)])
def test_bear_limits_the_log_std_of_the_vae_to_minus_4_and_2(output: float, limit: float) -> None:
    algorithm, (batch, _) = make("bear", [{"kl_weight": 1.0}]), next(batches(1))
    latent = algorithm.latent_dim
    set_outputs(algorithm.encoder, [0.0] * latent + [output] * latent)
    logs = algorithm.vae_loss(batch, normal_noise(BATCH, latent), algorithm.config)
    kl = kl_divergence(Normal(0.0, math.exp(limit)), Normal(0.0, 1.0))
    torch.testing.assert_close(logs["vae_loss"] - logs["vae_error"], kl.expand(1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("start", "threshold", "limit"), [(9.9995, 1e-3, 10.0), (-4.9995, 10.0, -5.0)])
def test_bear_limits_the_log_of_the_multiplier(start: float, threshold: float, limit: float) -> None:
    """MMD above the threshold raises the multiplier, MMD below lowers it, by 1e-3 an update."""
    algorithm = make("bear", [{"threshold": threshold, "match_samples": 2, "target_samples": 2}])
    with torch.no_grad():
        algorithm.log_multiplier.flat.fill_(start)
    for batch, _ in batches(3):
        noise = {k: normal_noise(*found.shape) for k, found in algorithm.noise_spec(algorithm.config).items()}
        logs = algorithm.update(batch, noise, True)
    assert algorithm.log_multiplier.value.item() == limit
    assert logs["multiplier"].item() == pytest.approx(math.exp(limit), rel=1e-5)


def test_iql_limits_the_log_std_to_minus_5_and_2() -> None:
    algorithm, (batch, _) = make("iql", [{"temperature": 0.0}]), next(batches(1))
    with torch.no_grad():
        algorithm.log_std.flat.copy_(torch.tensor([-7.0, 4.0]))
    set_outputs(algorithm.actor, [0.0, 0.0])
    logs = algorithm.actor_loss(batch, algorithm.config)
    policy = Normal(torch.zeros(2).double(), torch.tensor([-5.0, 2.0]).double().exp())
    expected = -policy.log_prob(batch.actions.double()).sum(-1).mean(-1)
    torch.testing.assert_close(logs["actor_loss"].double(), expected, rtol=1e-5, atol=0)
    assert logs["std"].item() == pytest.approx((math.exp(-5) + math.exp(2)) / 2)
