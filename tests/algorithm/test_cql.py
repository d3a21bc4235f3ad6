"""CQL: densities, the log-sum-exp against numerical integration, the warm-up, and the known traps of ports."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from offbench.algorithm.interface import Batch, stack_configs
from offbench.algos.cql import CQL, Config, log_prob, q_of_actions, sample
from offbench.rollouts.policy import Policy, from_bytes

OBS, ACT, BATCH = 3, 2, 64


def make(act: int = ACT, batch: int = BATCH, **settings: Any) -> CQL:
    config = Config(**({"hidden": (16, 16), "batch_size": batch} | settings))
    return CQL(stack_configs([config], "cpu"), OBS, act, [0], "cpu")


def noise_for(algorithm: CQL, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    found = {}
    for name, distribution in algorithm.noise_spec(algorithm.config).items():
        shape = (1, *distribution.shape)
        normal = distribution.name == "normal"
        found[name] = (
            torch.randn(shape, generator=generator) if normal else torch.rand(shape, generator=generator) * 2 - 1
        )
    return found


def a_batch(act: int = ACT, batch: int = BATCH, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn((1, batch, *shape), generator=generator)

    parts = normal(OBS), normal(act).tanh(), normal(), normal(OBS)
    return Batch(*parts, (torch.rand(1, batch, generator=generator) > 0.2).float())


def test_log_density_equals_pytorchs_distribution() -> None:
    mean, log_std, u = torch.randn(3, 100, ACT, dtype=torch.float64).unbind(0)
    base = Independent(Normal(mean, log_std.exp()), 1)
    theirs = TransformedDistribution(base, [TanhTransform(cache_size=1)])
    expected = base.log_prob(u) - torch.log(1 - torch.tanh(u) ** 2).sum(-1)
    torch.testing.assert_close(log_prob(mean, log_std, u), expected)
    torch.testing.assert_close(log_prob(mean, log_std, u), theirs.log_prob(u.tanh()), atol=1e-6, rtol=1e-6)
    assert torch.isfinite(log_prob(mean, log_std, 100 * torch.ones_like(u))).all()


def test_importance_weights_estimate_the_integral_over_actions() -> None:
    """In one dimension: E[logsumexp of N weighted samples] - log(3N) -> log of the integral of exp Q over [-1, 1]."""
    algorithm = make(act=1, batch=4, num_actions=4000)
    with torch.no_grad():
        algorithm.critic.flat *= 3  # a Q that varies over the actions
    batch, noise = a_batch(act=1, batch=4), noise_for(algorithm)
    grid = torch.linspace(-1, 1, 20_001)
    observations = batch.observations[:, :, None].expand(1, 4, len(grid), OBS).reshape(1, -1, OBS)
    q = algorithm.critic.frozen(observations, grid.repeat(4).view(1, -1, 1)).view(2, 4, len(grid)).double()
    integral = torch.trapezoid(q.exp(), grid.double(), dim=-1).log()  # [critics, batch]
    data = algorithm.critic.frozen(batch.observations, batch.actions)
    penalty = algorithm.conservative_penalty(batch, noise, data)
    expected = integral.mean(-1) + math.log(3 * 4000) - data[:, 0].mean(-1)
    torch.testing.assert_close(penalty[:, 0].double(), expected.double(), atol=0.02, rtol=0)


def test_uniform_actions_cover_both_signs() -> None:
    from offbench.training.batches import CHUNK, draw_chunk

    algorithm = make()
    _, noise = draw_chunk([0], [50], BATCH, algorithm.noise_spec(algorithm.config), 0, torch.device("cpu"))
    uniform = noise["uniform"]
    assert uniform.shape == (CHUNK, 1, 10, BATCH, ACT)
    assert uniform.min() < -0.99
    assert uniform.max() > 0.99
    assert abs(uniform.mean()) < 0.01


def test_the_warm_up_maximises_the_datas_likelihood() -> None:
    """Data actions near 0.7: after the warm-up the policy's mean is there; the critics play no part."""
    algorithm = make(actor_learning_rate=3e-3, bc_steps=10**6)
    batch = a_batch()
    data = torch.full_like(batch.actions, 0.7) + 0.05 * batch.actions
    batch = batch._replace(actions=data)
    before = _likelihood(algorithm, batch)
    for step in range(300):
        algorithm.update(batch, noise_for(algorithm, step), algorithm.phase(step))
    assert _likelihood(algorithm, batch) > before + 1
    mean = algorithm.actor(batch.observations).chunk(2, -1)[0].tanh()
    assert (mean - 0.7).abs().mean() < 0.1


def _likelihood(algorithm: CQL, batch: Batch) -> float:
    mean, log_std = algorithm.actor(batch.observations).chunk(2, -1)
    return log_prob(mean, log_std, batch.actions.atanh()).mean().item()


def test_data_at_the_bounds_stays_finite() -> None:
    algorithm = make()
    batch = a_batch()
    batch = batch._replace(actions=batch.actions.sign())
    for step in range(5):
        logs = algorithm.update(batch, noise_for(algorithm, step), "cloning")
        assert all(torch.isfinite(value).all() for value in logs.values())


def test_the_warm_up_ends() -> None:
    algorithm = make(bc_steps=3)
    assert [algorithm.phase(step) for step in range(5)] == [True] * 3 + [False] * 2


def test_the_actor_step_gives_the_critics_no_gradient() -> None:
    algorithm = make()
    loss = algorithm.actor_loss(a_batch(), noise_for(algorithm)["actor"], torch.ones(1), False)["actor_loss"]
    (to_critic,) = torch.autograd.grad(loss.sum(), [algorithm.critic.flat], retain_graph=True, allow_unused=True)
    (to_actor,) = torch.autograd.grad(loss.sum(), [algorithm.actor.flat])
    assert to_critic is None
    assert to_actor.abs().max() > 0


def test_the_critic_step_gives_the_actor_no_gradient() -> None:
    algorithm = make()
    loss, _ = algorithm.critic_loss(a_batch(), noise_for(algorithm), torch.ones(1), algorithm.config)
    (to_actor,) = torch.autograd.grad(loss.sum(), [algorithm.actor.flat], allow_unused=True)
    assert to_actor is None


def test_no_entropy_in_the_target() -> None:
    """y = r + discount (1 - terminated) min Q'(s', a'), computed here by hand."""
    algorithm, batch = make(alpha=0.0), a_batch()
    noise = noise_for(algorithm)
    with torch.no_grad():
        actions, _ = sample(algorithm.actor, batch.next_observations, noise["target"])
        q = algorithm.critic.frozen(batch.next_observations, actions[:, 0])
        y = batch.rewards + 0.99 * batch.masks * torch.minimum(q[0], q[1])
        now = algorithm.critic.frozen(batch.observations, batch.actions)
        expected = ((now[0] - y) ** 2).mean() + ((now[1] - y) ** 2).mean()
    loss, _ = algorithm.critic_loss(batch, noise, torch.ones(1), algorithm.config)
    torch.testing.assert_close(loss[0], expected)


def test_cql_does_not_bootstrap_from_terminal_states() -> None:
    """Only where no transition is terminal do the next observations matter."""
    algorithm, batch = make(alpha=0.0), a_batch()
    for masks, same in ((torch.zeros_like(batch.masks), True), (torch.ones_like(batch.masks), False)):
        losses = []
        for shift in (0.0, 3.0):
            moved = batch._replace(masks=masks, next_observations=batch.next_observations + shift)
            losses.append(
                algorithm.critic_loss(moved, noise_for(algorithm), torch.ones(1), algorithm.config)[0].item()
            )
        assert (losses[0] == losses[1]) == same


def test_the_temperature_moves_towards_the_target_entropy() -> None:
    """Entropy above the target (log pi below dim A): the temperature falls."""
    algorithm = make(actor_learning_rate=1e-3, bc_steps=0)
    for step in range(50):
        logs = algorithm.update(a_batch(seed=step), noise_for(algorithm, step), False)
    assert logs["log_pi"].item() < ACT
    assert logs["temperature"].item() < 1


def test_runs_in_a_stack_equal_runs_alone() -> None:
    def train(seeds: list[int], alphas: list[float]) -> CQL:
        configs = [Config(hidden=(16, 16), batch_size=BATCH, alpha=alpha, bc_steps=100) for alpha in alphas]
        algorithm = CQL(stack_configs(configs, "cpu"), OBS, ACT, seeds, "cpu")
        for step in range(200):
            batch, noise = a_batch(seed=step), noise_for(algorithm, step)
            batch = Batch(*(x.expand(len(seeds), *x.shape[1:]).contiguous() for x in batch[:5]))
            many = {k: x.expand(len(seeds), *x.shape[1:]).contiguous() for k, x in noise.items()}
            algorithm.update(batch, many, algorithm.phase(step))
        return algorithm

    stack = train([1, 2, 3], [10.0, 1.0, 5.0])
    for i, (seed, alpha) in enumerate([(1, 10.0), (2, 1.0), (3, 5.0)]):
        alone = train([seed], [alpha])
        for name, part in alone.learned.items():
            found = stack.learned[name].tensors()["flat"][:, i : i + 1]
            assert torch.equal(found, part.tensors()["flat"]), name


@pytest.mark.parametrize("alpha", [0.0, 10.0])
def test_the_penalty_keeps_q_off_the_data_below(alpha: float) -> None:
    algorithm = make(alpha=alpha, bc_steps=0, critic_learning_rate=3e-3)
    for step in range(300):
        algorithm.update(a_batch(), noise_for(algorithm, step), False)
    batch = a_batch()
    data = algorithm.critic.frozen(batch.observations, batch.actions).mean()
    elsewhere = algorithm.critic.frozen(batch.observations, noise_for(algorithm)["uniform"][:, 0]).mean()
    gap = (data - elsewhere).item()
    assert gap > 1 if alpha else abs(gap) < 1


@pytest.mark.parametrize(("gap", "rises"), [(0.5, True), (500.0, False)])
def test_the_lagrange_multiplier_holds_the_penalty_at_its_target(gap: float, rises: bool) -> None:
    algorithm = make(lagrange=True, target_action_gap=gap, critic_learning_rate=3e-3, bc_steps=0)
    for step in range(60):
        logs = algorithm.update(a_batch(seed=step), noise_for(algorithm, step), False)
    assert (logs["multiplier"].item() > 1.05) if rises else (logs["multiplier"].item() < 0.95)


def test_the_lagrange_form_by_hand() -> None:
    """td + multiplier (alpha penalty - gap), both critics, against the plain form's parts."""
    algorithm, batch = make(alpha=3.0, target_action_gap=0.7), a_batch()
    noise = noise_for(algorithm)
    plain, logs = algorithm.critic_loss(batch, noise, torch.ones(1), algorithm.config)
    algorithm.config.lagrange = True
    held, _ = algorithm.critic_loss(batch, noise, torch.tensor([2.5]), algorithm.config)
    torch.testing.assert_close(held, logs["critic_loss"] + 2.5 * (logs["penalty"] - 1.4))
    torch.testing.assert_close(plain, logs["critic_loss"] + logs["penalty"])


def test_best_by_q_takes_the_sample_that_q1_likes_most() -> None:
    """The policy file's choice in NumPy against the networks themselves."""
    algorithm = make(eval_samples=6)
    parts = algorithm.policy(0)
    assert (parts.kind, parts.samples) == ("best_by_q", 6)
    arrays = [tuple((w.numpy(), b.numpy()) for w, b in net) for net in (parts.layers, parts.critic)]
    zeros, ones = np.zeros(OBS, np.float32), np.ones(OBS, np.float32)
    bounds = -np.ones(ACT, np.float32), np.ones(ACT, np.float32)
    policy = from_bytes(
        Policy("best_by_q", arrays[0], zeros, ones, *bounds, "X-v0", {}, critic=arrays[1], samples=6).to_bytes()
    )
    assert policy.needs_noise(deterministic=True)
    noise = policy.draw(np.random.default_rng(0), 32)
    assert noise.shape == (32, 6, ACT)
    observations = a_batch(batch=32).observations
    actions, _ = sample(algorithm.actor, observations, torch.from_numpy(noise).float().transpose(0, 1).unsqueeze(0))
    q = q_of_actions(algorithm.critic, observations, actions)[0, 0]  # [samples, batch]
    expected = actions[0, q.argmax(0), torch.arange(32)]
    np.testing.assert_allclose(policy.act(observations[0].numpy(), noise), expected.detach().numpy(), atol=1e-5)
