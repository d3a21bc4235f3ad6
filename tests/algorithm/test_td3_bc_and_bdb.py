"""TD3+BC and BDB, each of their particulars; test_references.py has their equations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from offbench.algorithm.interface import Algorithm, Batch, stack_configs
from offbench.training.registry import load_algorithm

OBS, ACT, BATCH = 5, 2, 32
HIDDEN = (16, 16)


def make(name: str, configs: list[dict[str, Any]], seeds: list[int] | None = None) -> Any:
    kind = load_algorithm(name)
    made = [kind.Config(**({"hidden": HIDDEN, "batch_size": BATCH} | config)) for config in configs]
    return kind(stack_configs(made, "cpu"), OBS, ACT, seeds or list(range(len(configs))), "cpu")


def batches(count: int, runs: int = 1, seed: int = 0) -> Iterator[tuple[Batch, dict[str, Tensor]]]:
    """Random transitions, the same for every run; large rewards and spread, a fifth of them terminal."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).expand(runs, *shape).contiguous()

    for _ in range(count):
        masks = (torch.rand(BATCH, generator=generator) > 0.2).float().expand(runs, BATCH)
        batch = Batch(normal(BATCH, OBS), normal(BATCH, ACT).tanh(), 5 * normal(BATCH), normal(BATCH, OBS), masks)
        yield batch, {"target": normal(BATCH, ACT)}


def updated(algorithm: Algorithm, batch: Batch, noise: dict[str, Tensor], phase: Any) -> dict[str, Tensor]:
    """Do an update, and return what it logs."""
    return {name: value.detach() for name, value in algorithm.update(batch, noise, phase).items()}


def run(algorithm: Algorithm, count: int, runs: int = 1, seed: int = 0) -> list[dict[str, Tensor]]:
    logs = []
    for step, (batch, noise) in enumerate(batches(count, runs, seed)):
        logs.append(updated(algorithm, batch, noise, algorithm.phase(step)))
    return logs


def test_beta_zero_is_td3_bc_bit_for_bit() -> None:
    td3_bc, bdb = make("td3_bc", [{}]), make("bdb", [{"beta": 0.0}])
    run(td3_bc, 100)
    run(bdb, 100)
    for name, part in td3_bc.learned.items():
        for key, tensor in part.tensors().items():
            assert torch.equal(tensor, bdb.learned[name].tensors()[key]), (name, key)


def test_the_policy_and_targets_wait_for_every_second_update() -> None:
    algorithm = make("td3_bc", [{}])
    before = {name: part.tensors()["flat"].clone() for name, part in algorithm.learned.items()}
    (first, second) = list(batches(2))
    algorithm.update(*first, algorithm.phase(0))
    moved = {n for n, part in algorithm.learned.items() if not torch.equal(part.tensors()["flat"], before[n])}
    assert moved == {"critic"}
    algorithm.update(*second, algorithm.phase(1))
    moved = {n for n, part in algorithm.learned.items() if not torch.equal(part.tensors()["flat"], before[n])}
    assert moved == {"critic", "actor", "actor_target", "critic_target"}


def test_a_termination_cuts_the_bootstrap() -> None:
    """With every transition terminal the next observation cannot matter; with none it must."""
    batch, noise = next(batches(1))
    for masks, same in ((torch.zeros_like(batch.masks), True), (torch.ones_like(batch.masks), False)):
        losses = []
        for shift in (0.0, 3.0):
            algorithm = make("td3_bc", [{}])
            moved = batch._replace(masks=masks, next_observations=batch.next_observations + shift)
            losses.append(updated(algorithm, moved, noise, False)["critic_loss"].item())
        assert (losses[0] == losses[1]) == same


def test_lambda_scales_q_away() -> None:
    """lambda mean Q1 is alpha times a number in [-1, 1], whatever the size of the rewards."""
    algorithm = make("td3_bc", [{"alpha": 2.5}])
    logs = run(algorithm, 100)
    values = torch.stack([log["lambda_q"] for log in logs if "lambda_q" in log])
    assert values.abs().max() <= 2.5 + 1e-5
    assert values.abs().max() > 0.1


def test_runs_in_a_stack_equal_runs_alone() -> None:
    """Three seeds with three settings each, together and one by one: the same bits."""
    for name, configs in {
        "td3_bc": [{"alpha": 2.5}, {"alpha": 1.0}, {"alpha": 4.0}],
        "bdb": [{"beta": 0.0}, {"beta": 0.7, "alpha": 1.0}, {"beta": "adaptive"}],
    }.items():
        stack = make(name, configs, [4, 5, 6])
        run(stack, 200, runs=3)
        for i, config in enumerate(configs):
            alone = make(name, [config], [4 + i])
            run(alone, 200)
            for key, part in alone.learned.items():
                found = stack.learned[key].tensors()["flat"][:, i : i + 1]
                assert torch.equal(found, part.tensors()["flat"]), (name, key)


def test_the_discriminator_tells_data_from_policy_where_it_can() -> None:
    """Data actions at +0.8, the policy near 0: separable. The same with the policy's own actions: chance."""
    separable, hopeless = make("bdb", [{"beta": 0.5}]), make("bdb", [{"beta": 0.5}])
    for algorithm, apart in ((separable, True), (hopeless, False)):
        for batch, _ in batches(400):
            pi = algorithm.actor(batch.observations).tanh().detach()
            batch = batch._replace(actions=torch.full_like(pi, 0.8) if apart else pi)
            logs = algorithm.discriminator_loss(batch, pi)  # the one loss alone, so that the policy stands still
            algorithm.discriminator.minimize(10 * logs["discriminator_loss"])
        if apart:
            assert logs["d_real"].item() > 0.9
            assert logs["d_fake"].item() < 0.1
        else:
            assert abs(logs["d_real"].item() - 0.5) < 0.05
            assert logs["discriminator_loss"].item() == pytest.approx(
                2 * torch.log(torch.tensor(2.0)).item(), abs=0.02
            )


def test_extreme_logits_stay_finite() -> None:
    algorithm = make("bdb", [{"beta": 1.0}])
    with torch.no_grad():
        algorithm.discriminator.flat *= 1e4
    logs = run(algorithm, 10)
    assert all(torch.isfinite(value).all() for log in logs for value in log.values())
    assert torch.isfinite(algorithm.actor.flat).all()


def test_adaptive_beta_is_one_over_the_spread_of_the_critics() -> None:
    algorithm = make("bdb", [{"beta": "adaptive"}])
    with torch.no_grad():
        algorithm.critic.flat *= 4  # so that the critics disagree by more than 1 somewhere
    batch, _ = next(batches(1))
    pi = algorithm.actor(batch.observations).tanh()
    q = algorithm.critic(batch.observations, pi).detach()
    spread = (q[0] - q[1]).abs()
    assert spread.min() < 1 < spread.max()
    expected = torch.where(spread < 1, torch.ones(()), 1 / spread)
    logs = algorithm.actor_loss(batch, pi, algorithm.config)
    torch.testing.assert_close(logs["beta"], expected.mean(-1))
    torch.testing.assert_close(logs["uncertainty"], spread.mean(-1))
    algorithm.config.beta_scope = "batch"
    logs = algorithm.actor_loss(batch, pi, algorithm.config)
    torch.testing.assert_close(logs["beta"], (1 / spread.mean(-1)).clamp(max=1))


@pytest.mark.parametrize("name", ["bdb", "bdb_plus"])
def test_bdb_logs_the_quantiles_of_beta(name: str) -> None:
    algorithm = make(name, [{}, {}])
    with torch.no_grad():
        algorithm.critic.flat *= 4
    batch, _ = next(batches(1, runs=2))
    pi = algorithm.actor(batch.observations).tanh()
    q = algorithm.critic(batch.observations, pi).detach().numpy()
    beta = np.minimum(1, 1 / abs(q[0] - q[1]))  # [runs, batch]
    logs = algorithm.actor_loss(batch, pi, algorithm.config)
    for percent in (5, 50, 95):
        expected = np.quantile(beta, percent / 100, axis=1, method="nearest")
        np.testing.assert_allclose(logs[f"beta_{percent}"].numpy(), expected, rtol=1e-4)
    assert (logs["beta_5"] < logs["beta_50"]).all()
    assert (logs["beta_50"] < logs["beta_95"]).all()


def test_what_bdb_logs() -> None:
    (log,) = (x for x in run(make("bdb", [{}, {"beta": 0.5}]), 2, runs=2) if "beta" in x)
    wanted = {"beta", "beta_5", "beta_50", "beta_95", "uncertainty", "d_real", "d_fake", "lambda_q", "bc"}
    assert wanted | {"adversarial", "q_abs", "critic_loss", "actor_loss", "discriminator_loss"} == set(log)
    assert all(value.shape == (2,) for value in log.values())
    assert log["beta"][1] == 0.5
