"""BDB+: the paper's future work and the limit of beta, by hand; tests/training/test_bits_stay.py has BDB+ as BDB."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.algorithm.test_td3_bc_and_bdb import ACT, BATCH, batches, make, run


def first_beta(config: dict[str, Any]) -> float:
    algorithm = make("bdb_plus", [config])
    with torch.no_grad():
        algorithm.critic.flat *= 4
    return next(log["beta"].item() for log in run(algorithm, 2) if "beta" in log)


def test_beta_max_is_the_upper_limit_of_an_adaptive_and_a_learned_beta() -> None:
    assert first_beta({"beta": "adaptive", "beta_max": 0.2}) <= 0.2 < first_beta({"beta": "adaptive"})
    assert first_beta({"beta": "learned", "beta_max": 0.2}) == pytest.approx(0.2)
    assert first_beta({"beta": 0.6, "beta_max": 0.2}) == pytest.approx(0.6)  # a fixed beta is what it says


@pytest.mark.parametrize(("target", "rises"), [(1e-6, False), (10.0, True)])
def test_a_learned_beta_holds_the_cloning_error_at_its_target(target: float, rises: bool) -> None:
    algorithm = make("bdb_plus", [{"beta": "learned", "beta_target": target, "beta_learning_rate": 1e-2}])
    logs = [log["beta"].item() for log in run(algorithm, 100) if "beta" in log]
    assert logs[0] == 0.5
    assert (logs[-1] > 0.55) if rises else (logs[-1] < 0.45)


def test_the_learned_betas_gradient_is_that_of_beta_times_the_excess_error() -> None:
    algorithm = make("bdb_plus", [{"beta": "learned", "beta_target": 0.05}, {"beta": 0.5}])
    with torch.no_grad():
        algorithm.learned_beta.flat.fill_(0.4)
    cloning = torch.tensor([0.3, 0.3])
    found = algorithm.beta_gradient(cloning, algorithm.config)
    b = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(b.sigmoid() * 0.25, [b])
    assert found.shape == algorithm.learned_beta.flat.shape
    assert found.flatten().tolist() == pytest.approx([gradient.item(), 0.0])  # a fixed beta stands still


def test_the_critic_penalty_by_hand() -> None:
    algorithm = make("bdb_plus", [{"critic_penalty": "cql", "penalty_actions": 3}])
    batch, _ = next(batches(1))
    assert algorithm.noise_spec(algorithm.config)["uniform"].shape == (3, BATCH, ACT)
    uniform = torch.rand(1, 3, BATCH, ACT) * 2 - 1
    found = algorithm.conservative_penalty(batch, uniform)
    expected = 0.0
    with torch.no_grad():
        for i in range(BATCH):
            s, s2 = batch.observations[0, i], batch.next_observations[0, i]
            actions = [*uniform[0, :, i], *(algorithm.actor(x.view(1, 1, -1)).tanh().flatten() for x in (s, s2))]
            for c in range(2):
                q = [algorithm.critic(s.view(1, 1, -1), a.view(1, 1, -1))[c].item() for a in actions]
                data = algorithm.critic(s.view(1, 1, -1), batch.actions[0, i].view(1, 1, -1))[c].item()
                expected += (torch.tensor(q, dtype=torch.float64).exp().sum().log().item() - data) / BATCH
    assert found.item() == pytest.approx(expected, abs=1e-4)


def test_the_critic_penalty_lowers_q_off_the_data() -> None:
    gaps = []
    for weight in (0.0, 5.0):
        config = {"critic_penalty": "cql", "penalty_weight": weight, "critic_learning_rate": 3e-3}
        algorithm = make("bdb_plus", [config])
        batch, noise = next(batches(1))  # the same one again and again: there is a data set to stay near
        for step in range(200):
            uniform = torch.rand(1, 10, BATCH, ACT, generator=torch.Generator().manual_seed(step)) * 2 - 1
            algorithm.update(batch, noise | {"uniform": uniform}, algorithm.phase(step))
        on, off = (algorithm.critic(batch.observations, a).mean().item() for a in (batch.actions, -batch.actions))
        gaps.append(on - off)
    assert gaps[1] > gaps[0] + 0.3
