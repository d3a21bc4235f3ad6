"""A replayed update has the bits of one that runs as it is, and what cannot be replayed is noticed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from offbench.algorithm.capture import NotCapturableError, record
from offbench.algorithm.interface import Batch, Draw, PolicyParts
from offbench.algorithm.networks import Network
from offbench.benchmarks.throughput import made_up
from offbench.common.errors import OffbenchError
from offbench.common.settings import build, setting
from offbench.envs.recipes import load_recipe
from offbench.training import stack as stack_module
from offbench.training.devices import arithmetic
from offbench.training.registry import load_algorithm
from offbench.training.stack import Stack


def stack_of(kind: type, runs: int = 1, **settings: Any) -> Stack:
    config: Any = build(kind.Config, settings, "test")  # type: ignore[attr-defined]
    member = made_up("test", config, load_recipe("hopper").env_spec())
    return Stack(kind, [member] * runs, "cpu")


def trained(stack: Stack, steps: int) -> tuple[dict[str, Tensor], list[dict[str, float]]]:
    for _ in stack.train(steps):
        pass
    return {name: tensor.detach().clone() for name, tensor in stack.tensors().items()}, stack.logged()


SMALL = {"hidden": "16,16", "batch_size": "32"}
CASES: list[tuple[str, dict[str, str]]] = [
    ("bc", {}),
    ("td3_bc", {}),
    ("bdb", {}),
    ("bdb", {"beta": "learned", "critic_penalty": "cql", "cloning_steps": "20"}),
    ("bdb", {"critics": "3", "beta_scope": "batch", "uncertainty": "relative"}),
    ("cql", {"bc_steps": "20", "num_actions": "3"}),
    ("cql", {"bc_steps": "0", "lagrange": "true", "num_actions": "3"}),
]


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize(("algorithm", "settings"), CASES)
def test_a_replayed_update_has_the_bits_of_an_eager_one(
    algorithm: str, settings: dict[str, str], runs: int, precision: str
) -> None:
    kind = load_algorithm(algorithm)
    replayed, eager = (stack_of(kind, runs, **SMALL, **settings) for _ in range(2))
    eager.program.eager = True
    with arithmetic("cpu", precision):
        ours, theirs = trained(replayed, 60), trained(eager, 60)
    assert not replayed.program.eager
    assert replayed.program._recordings
    assert ours[1] == theirs[1]
    assert all(torch.equal(ours[0][name], theirs[0][name]) for name in theirs[0])


@dataclass(frozen=True)
class Config:
    learning_rate: float = setting(3e-4, "Adam's learning rate", above=0)
    batch_size: int = setting(32, "transitions an update", low=1)
    normalize: bool = setting(False, "normalise")


class Plain:
    """Behaviour cloning whose loss tests replace."""

    Config = Config

    def __init__(self, config: Any, observation_dim: int, action_dim: int, run_seeds: Any, device: Any) -> None:
        self.actor = Network((observation_dim, 8, action_dim), run_seeds, 0, learning_rate=1e-2, device=device)
        self.learned = {"actor": self.actor}
        self.updates = 0

    @property
    def draws(self) -> dict[str, Draw]:
        return {}

    def kind(self, step: int) -> str:
        return "cloning"

    def loss(self, error: Tensor) -> Tensor:
        return error.square().mean((-1, -2))

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        self.updates += 1
        loss = self.loss(self.actor(batch.observations)[0].tanh() - batch.actions)
        self.actor.minimize(loss.sum())
        return {"bc": loss.detach()}

    def policy(self, run: int) -> PolicyParts:
        return PolicyParts("tanh", self.actor.layers(run))


class Random(Plain):
    def loss(self, error: Tensor) -> Tensor:
        return (error + 0.1 * torch.randn_like(error)).square().mean((-1, -2))


class ReadsNumbers(Plain):
    def loss(self, error: Tensor) -> Tensor:
        loss = super().loss(error)
        return loss * (2.0 if float(loss[0].detach()) > 0.5 else 1.0)


class Counts(Plain):
    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) / self.updates


class Changes(Plain):
    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) * (1.0 if self.updates < 5 else 0.5)


class Converts(Plain):
    """A constant made anew at every update is the same constant."""

    def loss(self, error: Tensor) -> Tensor:
        return super().loss(error) * torch.tensor([0.5, 2.0])[1]


@pytest.mark.parametrize("kind", [Random, ReadsNumbers, Counts])
def test_what_cannot_be_replayed_runs_as_it_is_and_says_so(kind: type, capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    ours = stack_of(kind)
    found = trained(ours, 50)
    assert ours.program.eager
    assert f"{kind.__name__}.update" in capsys.readouterr().err
    torch.manual_seed(0)
    eager = stack_of(kind)
    eager.program.eager = True
    wanted = trained(eager, 50)
    assert all(torch.equal(found[0][name], wanted[0][name]) for name in wanted[0])


def test_a_constant_made_anew_is_replayed(capsys: pytest.CaptureFixture[str]) -> None:
    ours, eager = stack_of(Converts), stack_of(Converts)
    eager.program.eager = True
    assert torch.equal(trained(ours, 50)[0]["actor.flat"], trained(eager, 50)[0]["actor.flat"])
    assert not ours.program.eager
    assert capsys.readouterr().err == ""


def test_an_update_that_changes_later_on_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stack_module, "RECORD_EVERY", 20)

    class Later(Changes):
        def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
            return super().update(batch, noise, kind)

    with pytest.raises(OffbenchError, match=r"Later\.update changes with the number of updates.*capture = False"):
        trained(stack_of(Later), 100)
    Later.capture = False  # type: ignore[attr-defined]
    ours = stack_of(Later)
    trained(ours, 100)
    assert ours.algorithm.updates == 100  # type: ignore[attr-defined]


def test_a_record_is_done_as_well() -> None:
    total = torch.zeros(3)

    def update() -> None:
        total.add_(torch.ones(3) * 2)

    recording = record(update)
    assert total.tolist() == [2, 2, 2]
    recording.replay()
    assert total.tolist() == [4, 4, 4]
    with pytest.raises(NotCapturableError, match=r"item|local_scalar"):
        record(lambda: total.sum().item())
