"""Mistakes in an algorithm of one's own: one line that says what is wrong, before they cost time."""

from __future__ import annotations

import dataclasses
import itertools
import types
from pathlib import Path
from typing import Any

import pytest
import torch

from offbench.algorithm import Draw, PolicyParts
from offbench.common.errors import OffbenchError
from offbench.training import registry
from offbench.training.registry import load_algorithm
from tests.cli.test_bad_input import refusal


def own(**parts: Any) -> type:
    """Return TD3+BC with mistakes of one's own: what `update` logs, what `policy` returns."""
    changed = {name: lambda self, *_, found=found: found(self) for name, found in parts.items()}
    return type("AWAC", (load_algorithm("td3_bc"),), changed)


COUNT = itertools.count()


def acting(algorithm: Any) -> PolicyParts:
    return PolicyParts("tanh", algorithm.actor.layers(0))


OWN: dict[str, tuple[type, str]] = {
    "a number": (
        own(update=lambda self: {"critic_loss": 0.5}),
        "AWAC.update: log 'critic_loss' must be a tensor [runs] = [2], got a float",
    ),
    "a scalar tensor": (
        own(update=lambda self: {"q": torch.zeros(())}),
        "'q' must be a tensor [runs] = [2], got one []",
    ),
    "not reduced": (own(update=lambda self: {"q": torch.zeros(2, 8)}), "[runs] = [2], got one [2, 8]"),
    "a graph": (own(update=lambda self: {"q": self.actor.flat.sum((0, 2))}), "log 'q' must be detached"),
    "no logs": (own(update=lambda self: None), "AWAC.update must return a dict of logs, not a NoneType"),
    "a kind": (
        own(policy=lambda self: PolicyParts("gaussian", self.actor.layers(0))),
        "AWAC.policy: unknown kind 'gaussian'; known: tanh, squashed_gaussian, best_by_q, uniform",
    ),
    "an activation": (
        own(policy=lambda self: PolicyParts("tanh", self.actor.layers(0), activation="gelu")),
        "AWAC.policy: unknown activation 'gelu'; known: relu, tanh",
    ),
    "outputs": (
        own(policy=lambda self: PolicyParts("squashed_gaussian", self.actor.layers(0))),
        "AWAC.policy: 1 outputs where 2 are needed",
    ),
    "no critic": (own(policy=lambda self: PolicyParts("best_by_q", self.critic.layers(0)[:0])), "it has no layers"),
    "no layers": (own(policy=lambda self: PolicyParts("tanh", self.actor)), "AWAC.policy: "),
    "weights that learn": (
        own(policy=lambda self: PolicyParts("tanh", [(w.requires_grad_(), b) for w, b in self.actor.layers(0)])),
        "layers must be detached",
    ),
    "a distribution": (
        type("AWAC", (load_algorithm("td3_bc"),), {"draws": property(lambda self: {"target": Draw((8, 1), "beta")})}),
        "draws: 'target' must be normal or uniform, not 'beta'",
    ),
    "nothing learned": (
        own(policy=lambda self: setattr(self, "learned", {}) or acting(self)),
        "AWAC.learned is empty",
    ),
    "a network forgotten": (
        own(policy=lambda self: self.learned.pop("actor") and acting(self)),
        "AWAC.learned lacks actor: a run that resumes would go on with another one",
    ),
    "other logs": (
        own(update=lambda self: {f"loss {next(COUNT)}": torch.zeros(2)}),
        "AWAC.update must log the same names at every update of kind",
    ),
    "no Config": (type("AWAC", (), {"Config": None}), "algorithm 'awac' (awac:AWAC): Config must be a dataclass"),
    "no batch_size": (
        type("AWAC", (), {"Config": dataclasses.make_dataclass("Config", ["normalize"])}),
        "algorithm 'awac' (awac:AWAC): its Config lacks the setting batch_size",
    ),
    "no parts": (own(policy=lambda self: self.actor.layers(0)), "AWAC.policy must return PolicyParts, not a list"),
}


@pytest.mark.parametrize("mistake", OWN)
def test_mistakes_in_ones_own_algorithm_are_said_before_they_cost_time(
    mistake: str, medium: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, message = OWN[mistake]
    point = types.SimpleNamespace(load=lambda: kind, value="awac:AWAC")
    monkeypatch.setattr(registry, "_entry_points", lambda: {"awac": [point]})
    words = ["--seeds", "0,1", "--steps", "10", "--hidden", "8", "--batch-size", "8", "--workers", "1"]
    assert message in refusal(["train", "awac", "--dataset", medium, *words], capsys)
    assert not list(home.rglob("checkpoint-*"))


def test_two_algorithms_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose runs they are must not depend on the order of installation."""
    points = [types.SimpleNamespace(value=value) for value in ("offbench.algos.bc:BC", "mine:BC")]
    monkeypatch.setattr(registry, "_entry_points", lambda: {"bc": points})
    with pytest.raises(OffbenchError, match=r"two algorithms are named 'bc': offbench\.algos\.bc:BC and mine:BC"):
        load_algorithm("bc")
