"""Mistakes in an algorithm of one's own: one line that says what is wrong, before they cost time."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
import types
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

import offbench
from offbench.algorithm import Algorithm, Network, PolicyParts, normal, setting
from offbench.algorithm.interface import Distribution
from offbench.common.errors import OffbenchError
from offbench.training import registry
from offbench.training.datasets import load_datasets
from offbench.training.registry import algorithm_names, load_algorithm
from offbench.training.spec import TrainingSchedule, specs_of
from offbench.training.stack import Stack
from tests.commands import refusal


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


def elsewhere(self: Any, run: int = 0) -> PolicyParts:
    """A policy whose network is not kept."""
    return PolicyParts(
        "tanh", Network(self.observation_dim, (8,), self.action_dim, [0], 0, learning_rate=1.0).layers(0)
    )


def relu(self: Any, run: int = 0) -> PolicyParts:
    """The policy of `actor`, whose activation is forgotten."""
    return PolicyParts("tanh", self.actor.layers(run))


def penalty(self: Any) -> None:
    """A gradient of a gradient."""
    actions = torch.zeros(2, 8, 1, requires_grad=True)
    q = self.critic(torch.zeros(2, 8, 4), actions)
    (gradient,) = torch.autograd.grad(q.sum(), actions, create_graph=True)
    self.critic.minimize(gradient.square().sum((1, 2)))


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
        "AWAC.noise_spec: 'target' must be normal(*shape) or uniform(*shape) with sizes from 0, not Distribution",
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
        "the setting need needs a default (default=, not default_factory=)",
    ),
    "a factory of a default": (
        with_setting(("widths", tuple[int, ...], dataclasses.field(default_factory=lambda: (4, 4)))),
        "the setting widths needs a default (default=, not default_factory=)",
    ),
    "a share of episodes that may be none": (
        with_setting(("top", float | None, None)),
        "the setting top must be declared as float",
    ),
    "a loss over all runs": (
        own(update=lambda self: self.critic.minimize(self.critic.flat.square().mean())),
        "a loss is one number for each run, [runs] = [2], not []: reduce the other axes",
    ),
    "forgotten actions": (
        own(update=lambda self: self.critic(torch.zeros(2, 8, 4))),
        "a network of 2 runs takes inputs [runs, batch, dim] of 5 dimensions in all, not [2, 8, 4]",
    ),
    "inputs of one run": (
        own(update=lambda self: self.actor(torch.zeros(1, 8, 4))),
        "a network of 2 runs takes inputs [runs, batch, dim] of 4 dimensions in all, not [1, 8, 4]",
    ),
    "a gradient penalty": (own(update=penalty), "needs a network made with twice_differentiable=True"),
    "a log of steps": (
        own(update=lambda self: {"step": torch.zeros(2)}),
        "AWAC.update: 'step' is the column of steps in losses.csv; give that log another name",
    ),
    "noise of a wrong shape": (
        own(noise_spec=lambda self: {"x": normal(0.5, 3)}),
        "AWAC.noise_spec: 'x' must be normal(*shape) or uniform(*shape) with sizes from 0, not Distribution",
    ),
    "noise of a negative size": (
        own(noise_spec=lambda self: {"x": normal(-1, 3)}),
        "with sizes from 0, not Distribution",
    ),
    "noise of no distribution": (
        own(noise_spec=lambda self: {"x": (32, 3)}),
        "AWAC.noise_spec: 'x' must be normal(*shape)",
    ),
    "a list as phase": (
        own(phase=lambda self: [1]),
        "AWAC.phase must return a number, text or tuple, not [1]",
    ),
    "random numbers in setup": (
        own(setup=lambda self: setattr(self, "actor", torch.nn.Linear(4, 1)), policy=elsewhere),
        "AWAC.setup draws random numbers that do not depend on a run's seed alone",
    ),
    "another activation": (
        own(setup=lambda self: setattr(self, "actor", self.actor_network(1, 0.1, activation="tanh")), policy=relu),
        "the layers of actor have the activation tanh, the policy relu",
    ),
    "a learning rate for each run": (
        own(setup=lambda self: setattr(self, "actor", self.actor_network(1, self.config.alpha))),
        "a learning rate is a number or a schedule; its setting cannot be per_run",
    ),
    "a batch_size that is no whole number": (
        with_setting(("batch_size", float, 8.0)),
        "the setting batch_size must be declared as int, and not per_run",
    ),
    "a type that settings cannot have": (
        with_setting(("kind", Literal["a", "b"], "a")),
        "settings are int, float, bool, str, None, tuple[int, ...] and unions of these",
    ),
    "lists for each run": (
        with_setting(("widths", tuple[int, ...], setting((8,), "widths", per_run=True))),
        "the setting widths is per_run, so it must be a number, or a word of its choices=",
    ),
    "words for each run": (
        with_setting(("kind", str, setting("a", "kind", per_run=True))),
        "the setting kind is per_run, so it must be a number, or a word of its choices=",
    ),
    "a default out of range": (
        with_setting(("rate", float, setting(3.0, "rate", high=1))),
        "a default: rate must be at most 1, not 3",
    ),
    "a default of another type": (
        with_setting(("rate", float, setting("3e-4", "rate"))),
        "a default: rate must be a number, not '3e-4'",
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


def test_a_config_that_no_class_of_a_file_uses_is_refused(home: Path) -> None:
    text = """from dataclasses import dataclass
from offbench.algorithm import Algorithm, setting
from offbench.algos import td3_bc

@dataclass(frozen=True)
class Config(td3_bc.Config):
    dropout: float = setting(0.1, "share", low=0, high=1)

class Mine(td3_bc.TD3BC"""
    (home / "forgotten.py").write_text(f"{text}): ...\n")
    with pytest.raises(OffbenchError, match=r"write class Mine\(TD3BC, Algorithm\[Config\]\), or rename"):
        registry.register("./forgotten.py:Mine")
    (home / "used.py").write_text(f"{text}, Algorithm[Config]): ...\n\nclass Plain(td3_bc.TD3BC): ...\n")
    settings = dataclasses.fields(load_algorithm(registry.register("./used.py:Mine")).Config)
    assert "dropout" in {field.name for field in settings}
    registry.register("./used.py:Plain")


def test_two_algorithms_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose runs they are must not depend on the order of installation."""
    points = [types.SimpleNamespace(value=value) for value in ("offbench.algos.bc:BC", "mine:BC")]
    monkeypatch.setattr(registry, "_entry_points", lambda: {"bc": points})
    with pytest.raises(OffbenchError, match=r"two algorithms are named 'bc': offbench\.algos\.bc:BC and mine:BC"):
        load_algorithm("bc")


def test_every_option_of_train_is_reserved() -> None:
    """A setting of its name could not be given."""
    options = set(inspect.signature(offbench.train).parameters) - {"settings"}
    entry = {"name", "label", "datasets", *(field.name for field in dataclasses.fields(TrainingSchedule))}
    assert options | entry | {"help"} <= registry.RESERVED_SETTINGS
    for name in algorithm_names():
        assert not registry.RESERVED_SETTINGS & {f.name for f in dataclasses.fields(load_algorithm(name).Config)}


def gaussian(self: Any, run: int = 0) -> PolicyParts:
    """A mean of the first action's bias alone, and a standard deviation of e^-1."""
    layers = [(torch.zeros_like(w), torch.zeros_like(b)) for w, b in self.actor.layers(run)]
    weight, bias = layers[-1]
    last = torch.cat([weight, weight], 1), torch.cat([bias + 0.5, bias - 1])
    return PolicyParts("gaussian", [*layers[:-1], last])


def test_a_gaussian_policy_is_scaled_to_the_bounds_as_the_others_are(medium: str) -> None:
    """Inverted-pendulum takes actions from -3 to 3."""
    config = load_algorithm("td3_bc").Config(hidden=(8, 8))
    schedule = TrainingSchedule((0,), 10, 10, 1)
    kind = own(policy=gaussian)
    ((spec,),) = specs_of(kind, {"hidden": (8, 8)}, [medium], schedule, Path("runs"))
    stack = Stack(kind, [replace(spec, config=config)], load_datasets([spec]), "cpu")
    observations, noise = np.zeros((3, 4)), np.array([[0.0], [1.0], [5.0]])
    policy, normalized = stack.policy(0), stack.normalized_policy(0)
    wanted = [0.5, 0.5 + math.exp(-1), 1.0]
    np.testing.assert_allclose(normalized.act(observations, noise)[:, 0], wanted, rtol=1e-6)
    np.testing.assert_allclose(policy.act(observations, noise)[:, 0], 3 * np.array(wanted), rtol=1e-6)
    np.testing.assert_allclose(policy.act(observations, None), 1.5, rtol=1e-6)


def test_an_algorithm_that_calls_exit_is_an_error(medium: str) -> None:
    kind = own(update=lambda self: exec("raise SystemExit"))
    with pytest.raises(OffbenchError, match="SystemExit"):
        offbench.train(kind, medium, steps=10, eval_every=10, eval_episodes=1, hidden=(8,))
