"""A replayed update has the bits of one that runs as it is, and what cannot be replayed is noticed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from offbench.algorithm import Algorithm, Batch, Logs, Noise
from offbench.algorithm.cpu_capture import NotCapturableError, trace
from offbench.benchmarks.throughput import random_stack
from offbench.common.errors import OffbenchError
from offbench.common.settings import build, setting
from offbench.envs.recipes import load_recipe
from offbench.training import captured_update
from offbench.training.devices import matmul_settings
from offbench.training.registry import load_algorithm
from offbench.training.stack import Stack


def stack_of(kind: type, runs: int = 1, device: str = "cpu", **settings: Any) -> Stack:
    config: Any = build(kind.Config, settings, "test")  # type: ignore[attr-defined]
    return random_stack(kind, [config] * runs, load_recipe("hopper").env_spec(), device)


def trained(stack: Stack, steps: int) -> tuple[dict[str, Tensor], list[dict[str, float]]]:
    stack.train(steps)
    return {name: tensor.detach().clone() for name, tensor in stack.tensors().items()}, stack.captured_update.logged()


SMALL = {"hidden": "16,16", "batch_size": "32"}
CASES: list[tuple[str, dict[str, str]]] = [
    ("bc", {}),
    ("td3_bc", {}),
    ("bdb", {}),
    ("bdb_plus", {"beta": "learned", "critic_penalty": "cql"}),
    ("bdb_plus", {"critics": "3", "beta_scope": "batch", "beta_max": "0.5"}),
    ("iql", {"decay_steps": "50"}),
    ("rebrac", {}),
    ("bear", {"warm_up_steps": "20", "vae_hidden": "16", "target_samples": "2", "match_samples": "2"}),
    ("cql", {"bc_steps": "20", "num_actions": "3"}),
    ("cql", {"bc_steps": "0", "lagrange": "true", "num_actions": "3"}),
]


WIDE = {"hidden": "64,64"}  # a CPU multiplies narrower layers in float32, but for those with LayerNorm
HALF = [("td3_bc", WIDE), ("bdb", WIDE), ("rebrac", {})]


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize(
    ("algorithm", "settings", "precision"), [*((*c, "float32") for c in CASES), *((*c, "bfloat16") for c in HALF)]
)
@pytest.mark.usefixtures("bfloat16")
def test_a_replayed_update_has_the_bits_of_an_eager_one(
    algorithm: str, settings: dict[str, str], precision: str, runs: int
) -> None:
    kind = load_algorithm(algorithm)
    replayed, eager = (stack_of(kind, runs, **(SMALL | settings)) for _ in range(2))
    eager.captured_update.eager = True
    with matmul_settings("cpu", precision):
        ours, theirs = trained(replayed, 60), trained(eager, 60)
    assert not replayed.captured_update.eager
    assert replayed.captured_update._traces
    assert ours[1] == theirs[1]
    assert all(torch.equal(ours[0][name], theirs[0][name]) for name in theirs[0])


@dataclass(frozen=True)
class Config:
    learning_rate: float = setting(3e-4, "Adam's learning rate", above=0)
    batch_size: int = setting(32, "transitions an update", low=1)
    normalize: bool = setting(False, "normalise")


class Plain(Algorithm[Config]):
    """Behaviour cloning whose loss tests replace."""

    def setup(self, c: Config) -> None:
        self.actor = self.actor_network(self.action_dim, 1e-2, hidden=(8,))
        self.updates, self.history, self.limits = 0, [0.5], {"low": [1.0]}

    def loss(self, error: Tensor) -> Tensor:
        return error.square().mean((-1, -2))

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        loss = self.loss(self.actor(batch.observations).tanh() - batch.actions)
        self.actor.minimize(loss)
        return {"bc": loss}


class Random(Plain):
    def loss(self, error: Tensor) -> Tensor:
        return (error + 0.1 * torch.randn_like(error)).square().mean((-1, -2))


class HasAGenerator(Plain):
    def setup(self, c: Config) -> None:
        super().setup(c)
        self.generator = np.random.default_rng(0)

    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) * self.generator.uniform(0.5, 1.5)


class HidesANetwork(Plain):
    """Its second network is in an object that no checkpoint looks into."""

    def setup(self, c: Config) -> None:
        super().setup(c)
        self.nets = SimpleNamespace(second=self.actor_network(self.action_dim, 1e-2, hidden=(8,)))

    def update(self, batch: Batch, noise: Noise, phase: None) -> Logs:
        loss = self.loss(self.nets.second(batch.observations) - batch.actions)
        self.nets.second.minimize(loss)
        return super().update(batch, noise, phase)


class ReadsNumbers(Plain):
    def loss(self, error: Tensor) -> Tensor:
        loss = super().loss(error)
        return loss * (2.0 if float(loss[0].detach()) > 0.5 else 1.0)


class ReadsByNumPy(Plain):
    def loss(self, error: Tensor) -> Tensor:
        loss = super().loss(error)
        return loss * (2.0 if np.asarray(loss.detach())[0] > 0.5 else 1.0)


class ReadsAList(Plain):
    def loss(self, error: Tensor) -> Tensor:
        loss = super().loss(error)
        return loss * (2.0 if loss.detach().tolist()[0] > 0.5 else 1.0)


class WritesByNumPy(Plain):
    """A running mean that NumPy updates in place."""

    def setup(self, c: Config) -> None:
        super().setup(c)
        self.mean = torch.ones(len(self.run_seeds))

    def loss(self, error: Tensor) -> Tensor:
        self.mean.numpy()[:] *= 0.9
        return super().loss(error) / self.mean


class Counts(Plain):
    def loss(self, error: Tensor) -> Tensor:
        self.updates += 1
        return super().loss(error) / self.updates


class EveryFifth(Plain):
    """Its counter is out of sight of any look at attributes."""

    def setup(self, c: Config) -> None:
        super().setup(c)
        count = itertools.count(1)
        self.fifth = lambda: next(count) % 5 == 0

    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) * (0.5 if self.fifth() else 1.0)


class EveryFifthByAttribute(Plain):
    def loss(self, error: Tensor) -> Tensor:
        self.updates += 1
        return super().loss(error) * (1.0 if self.updates % 5 else 0.5)


class GrowsAList(Plain):
    """It reads the list much later than it is changed."""

    def loss(self, error: Tensor) -> Tensor:
        self.history.append(0.5)
        return super().loss(error) * (1.0 if len(self.history) < 30 else 0.5)


class ChangesAListInADict(Plain):
    def loss(self, error: Tensor) -> Tensor:
        self.limits["low"][0] *= 0.99
        return super().loss(error) * self.limits["low"][0]


class ChangesConfig(Plain):
    def loss(self, error: Tensor) -> Tensor:
        self.config.learning_rate *= 0.99
        return super().loss(error) * self.config.learning_rate


class ReplacesATensor(Plain):
    """A running mean that is a new tensor at every update."""

    def setup(self, c: Config) -> None:
        super().setup(c)
        self.mean = torch.ones(len(self.run_seeds))

    def loss(self, error: Tensor) -> Tensor:
        loss = super().loss(error)
        self.mean = 0.9 * self.mean + 0.1 * loss.detach()
        return loss / self.mean


class CountsInAPhase(Plain):
    """A counter that moves in a phase that comes at every tenth update alone, and is read in the other."""

    def phase(self, step: int) -> bool:
        return step % 10 == 9

    def update(self, batch: Batch, noise: Noise, phase: bool) -> Logs:
        self.updates += phase
        loss = self.loss(self.actor(batch.observations).tanh() - batch.actions) / (1 + self.updates)
        self.actor.minimize(loss)
        return {"bc": loss}


class Converts(Plain):
    """A constant made anew at every update is the same constant."""

    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) * torch.tensor([0.5, 2.0])[1]


class ChangesInPlace(Plain):
    """A running mean that stays in its tensor is replayed too, and one made at the first update."""

    factor: Tensor | None = None

    def setup(self, c: Config) -> None:
        super().setup(c)
        self.mean = torch.ones(len(self.run_seeds))

    def loss(self, error: Tensor) -> Tensor:
        if self.factor is None:
            self.factor = torch.full((1,), 0.9)
        loss = super().loss(error)
        self.mean.mul_(self.factor).add_(0.1 * loss.detach())
        return loss / self.mean


EAGER = [
    Random,
    HasAGenerator,
    ReadsNumbers,
    ReadsByNumPy,
    ReadsAList,
    WritesByNumPy,
    Counts,
    EveryFifth,
    EveryFifthByAttribute,
    GrowsAList,
    ChangesAListInADict,
]
EAGER += [ChangesConfig, ReplacesATensor, CountsInAPhase]


@pytest.mark.parametrize("kind", EAGER)
def test_what_cannot_be_replayed_runs_as_it_is_and_says_so(kind: type, capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    ours = stack_of(kind)
    found = trained(ours, 50)
    assert ours.captured_update.eager
    said = capsys.readouterr().err
    assert said.count("without capture") == 1
    assert f"{kind.__name__}.update" in said
    torch.manual_seed(0)
    eager = stack_of(kind)
    eager.captured_update.eager = True
    wanted = trained(eager, 50)
    assert all(torch.equal(found[0][name], wanted[0][name]) for name in wanted[0])


@pytest.mark.parametrize("kind", [Plain, Converts, ChangesInPlace])
def test_what_does_the_same_at_every_update_is_replayed(kind: type, capsys: pytest.CaptureFixture[str]) -> None:
    ours, eager = stack_of(kind), stack_of(kind)
    eager.captured_update.eager = True
    assert torch.equal(trained(ours, 50)[0]["actor.flat"], trained(eager, 50)[0]["actor.flat"])
    assert not ours.captured_update.eager
    said = capsys.readouterr().err
    lost = "ChangesInPlace.update changes the attribute mean, which no checkpoint keeps: a resumed run begins with"
    assert said.count(lost) == (2 if kind is ChangesInPlace else 0)  # of each stack
    assert (said == "") is (kind is not ChangesInPlace)


@pytest.mark.parametrize("capture", [True, False])
@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Random, "Random.update draws random numbers that a resumed run would not repeat; use noise_spec"),
        (HasAGenerator, "HasAGenerator.update changes the attribute generator, which no checkpoint keeps"),
        (HidesANetwork, "HidesANetwork.update changes the attribute nets, which no checkpoint keeps"),
    ],
)
def test_what_a_resume_would_not_repeat_is_said(
    kind: type, message: str, capture: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = stack_of(kind)
    ours.captured_update.eager = not capture
    ours.train(20)
    assert capsys.readouterr().err.count(message) == 1


def test_an_update_that_changes_later_on_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captured_update, "TRACE_EVERY", 20)

    class Later(Plain):
        def setup(self, c: Config) -> None:
            super().setup(c)
            count = itertools.count()
            self.early = lambda: next(count) < captured_update.TRACED_UPDATES

        def loss(self, error: Tensor) -> Tensor:
            return super().loss(error) * (1.0 if self.early() else 0.5)

    with pytest.raises(OffbenchError, match=r"Later\.update is not the same at every update.*capture = False"):
        trained(stack_of(Later), 100)
    Later.capture = False
    ours = stack_of(Later)
    trained(ours, 100)
    assert not ours.captured_update._traces


def test_a_record_is_done_as_well() -> None:
    total = torch.zeros(3)

    def update() -> None:
        total.add_(torch.ones(3) * 2)

    recorded = trace(update)
    assert total.tolist() == [2, 2, 2]
    recorded.replay()
    assert total.tolist() == [4, 4, 4]
    with pytest.raises(NotCapturableError, match=r"item|local_scalar"):
        trace(lambda: total.sum().item())
    first, again = (trace(lambda: total.mul_(float("nan"))) for _ in range(2))
    assert first.same_as(again)
    with pytest.raises(NotCapturableError, match=r"draws random numbers by aten\.rand"):
        trace(lambda: torch.rand(3))


def test_recording_changes_running_means_once() -> None:
    """PyTorch's schema of batch normalization does not say that it changes them."""
    means = [torch.zeros(3), torch.zeros(3)]
    batch = torch.randn(8, 3)

    def update(mean: Tensor) -> None:
        torch.nn.functional.batch_norm(batch, mean, torch.ones(3), training=True)

    recorded = trace(lambda: update(means[0]))
    update(means[1])
    assert torch.equal(*means)
    recorded.replay()
    update(means[1])
    assert torch.equal(*means)
