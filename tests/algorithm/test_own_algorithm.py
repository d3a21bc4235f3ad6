"""Mistakes in an algorithm of one's own: one line that says what is wrong, before they cost time."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import types
from pathlib import Path
from typing import Any

import pytest
import torch

import offbench
from offbench.algorithm import Algorithm, Network, PolicyParts
from offbench.algorithm.interface import Distribution
from offbench.common.errors import OffbenchError
from offbench.training import registry
from offbench.training.registry import algorithm_names, load_algorithm
from offbench.training.spec import Times
from tests.cli.test_bad_input import refusal


def own(**parts: Any) -> type:
    """Return TD3+BC with mistakes of one's own: what `update` logs, what `policy` returns."""
    changed = {name: lambda self, *_, found=found: found(self) for name, found in parts.items()}
    return type("AWAC", (load_algorithm("td3_bc"),), changed)


def with_setting(field: Any) -> type:
    """Return TD3+BC with one more setting: its name, type and default."""
    td3_bc = load_algorithm("td3_bc")
    config = dataclasses.make_dataclass("Config", [field], bases=(td3_bc.Config,), frozen=True, kw_only=True)
    return type("AWAC", (td3_bc,), {"Config": config})


COUNT = itertools.count()


def elsewhere(self: Any, run: int) -> PolicyParts:
    """A policy whose network is not kept."""
    return PolicyParts(
        "tanh", Network(self.observation_dim, (8,), self.action_dim, [0], 0, learning_rate=1.0).layers(0)
    )


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
    "no logs": (own(update=lambda self: None), "AWAC.update must return a dict of logs, not a NoneType"),
    "a kind": (
        own(policy=lambda self: PolicyParts("mixture", self.actor.layers(0))),
        "AWAC.policy: unknown kind 'mixture'",
    ),
    "an activation": (
        own(policy=lambda self: PolicyParts("tanh", self.actor.layers(0), activation="gelu")),
        "AWAC.policy: unknown activation 'gelu'; the activations are relu, tanh",
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
        type(
            "AWAC",
            (load_algorithm("td3_bc"),),
            {"noise_spec": lambda self, c: {"target": Distribution((8, 1), "beta")}},
        ),
        "noise_spec: 'target' must be normal or uniform, not 'beta'",
    ),
    "nothing learned": (
        type("AWAC", (load_algorithm("td3_bc"),), {"setup": lambda self, c: None, "policy": elsewhere}),
        "AWAC has no networks among its attributes",
    ),
    "other logs": (
        own(update=lambda self: {f"loss {next(COUNT)}": torch.zeros(2)}),
        "AWAC.update must log the same names at every update of phase",
    ),
    "no base class": (
        type("AWAC", (), {}),
        "algorithm 'awac' (awac:AWAC) must be a subclass of offbench.algorithm.Algorithm",
    ),
    "no Config": (
        type("AWAC", (Algorithm,), {"Config": None}),
        "algorithm 'awac' (awac:AWAC): Config must be a dataclass",
    ),
    "no batch_size": (
        type("AWAC", (Algorithm,), {"Config": dataclasses.make_dataclass("Config", ["normalize"])}),
        "algorithm 'awac' (awac:AWAC): its Config lacks the setting batch_size",
    ),
    "an option's name": (
        with_setting(("steps", int, 3)),
        "the setting steps has the name of an option of training; rename it",
    ),
    "no default": (
        with_setting(("need", int)),
        "the setting need needs a default",
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


def test_every_option_of_train_is_reserved() -> None:
    """A setting of its name could not be given."""
    options = set(inspect.signature(offbench.train).parameters) - {"settings"}
    entry = {"name", "label", "datasets", *(field.name for field in dataclasses.fields(Times))}
    assert options | entry | {"help"} <= registry.RESERVED_SETTINGS
    for name in algorithm_names():
        assert not registry.RESERVED_SETTINGS & {f.name for f in dataclasses.fields(load_algorithm(name).Config)}
