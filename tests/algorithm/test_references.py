"""Every algorithm against the papers' equations, computed once more in float64 (references.py).

Two runs with different settings and seeds in one stack: losses agree at each update, and all parameters after the
last. The cases of an algorithm together have a value other than the default of each setting.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from offbench.algorithm import Batch, stack_configs
from offbench.training.registry import algorithm_names, load_algorithm
from tests.algorithm.references import BC, BDB, BEAR, CQL, IQL, TD3BC, BDBPlus, ReBRAC, networks

OBS, ACT, BATCH = 5, 3, 16
REFERENCES: dict[str, Any] = {
    "bc": BC,
    "td3_bc": TD3BC,
    "bdb": BDB,
    "bdb_plus": BDBPlus,
    "cql": CQL,
    "bear": BEAR,
    "iql": IQL,
    "rebrac": ReBRAC,
}
RATES = {"actor_learning_rate": 1e-3, "critic_learning_rate": 5e-4}
TARGETS = {"discount": 0.9, "tau": 0.02}
TD3 = {**RATES, **TARGETS, "policy_noise": 0.3, "noise_clip": 0.1, "policy_freq": 3}
DISCRIMINATOR = {"discriminator_learning_rate": 2e-3, "discriminator_hidden": (24,)}
VAE = {"vae_hidden": (24, 20), "match_samples": 2, "target_samples": 3}

Settings = dict[str, Any]
CASES: dict[str, tuple[int, Settings, list[Settings]]] = {  # number of updates, settings of both runs, and of each
    "bc": (60, {"learning_rate": 1e-3}, [{}, {}]),
    "td3_bc": (200, {}, [{"alpha": 2.5}, {"alpha": 1.0}]),
    "td3_bc, other settings": (60, TD3, [{"alpha": 2.5}, {"alpha": 1.0}]),
    "bdb": (200, {}, [{"beta": 0.3}, {"beta": "adaptive"}]),
    "bdb, four critics": (60, {"critics": 4}, [{"beta": 1.0}, {"beta": "adaptive"}]),
    "bdb, other settings": (
        60,
        {**TD3, **DISCRIMINATOR, "beta_scope": "batch", "critics": 3},
        [{"beta": 0.6, "alpha": 1.0}, {"beta": "adaptive"}],
    ),
    "bdb_plus": (60, {}, [{"beta": "learned", "beta_target": 2.0}, {"beta": "learned", "beta_max": 0.4}]),
    "bdb_plus, other settings": (
        60,
        {**TD3, **DISCRIMINATOR, "beta_scope": "batch", "critics": 3, "beta_learning_rate": 5e-3}
        | {"critic_penalty": "cql", "penalty_actions": 2},
        [{"beta": "learned", "penalty_weight": 0.3, "alpha": 1.0}, {"beta": "adaptive", "beta_max": 0.2}],
    ),
    "cql": (60, {"bc_steps": 30, "num_actions": 2}, [{"alpha": 10.0}, {"alpha": 1.0}]),
    "cql, other settings": (
        60,
        {**RATES, **TARGETS, "bc_steps": 20, "num_actions": 3, "lagrange": True, "target_action_gap": 8.0},
        [{"alpha": 5.0}, {"alpha": 1.0}],
    ),
    "bear": (
        200,
        {**VAE, "warm_up_steps": 100, "kernel_width": 2.0},
        [{"threshold": 0.05}, {"threshold": 0.5}],
    ),
    "bear, other settings": (
        60,
        {**VAE, **TARGETS, "warm_up_steps": 30, "kernel": "laplacian", "kernel_width": 3.0, "learning_rate": 5e-4}
        | {"target_min_weight": 0.3, "critics": 3, "kl_weight": 0.1},
        [{"threshold": 0.1}, {"threshold": 0.5}],
    ),
    "iql": (
        200,
        {"decay_steps": 300},
        [{"expectile": 0.7, "temperature": 3.0}, {"expectile": 0.9, "temperature": 0.5, "reward_scale": 0.1}],
    ),
    "iql, other settings": (
        60,
        {**TARGETS, "learning_rate": 1e-3, "decay_steps": 90},
        [{"expectile": 0.8, "temperature": 50.0}, {"expectile": 0.6, "temperature": 1.0, "reward_scale": 3.0}],
    ),
    "rebrac": (
        200,
        {},
        [{"actor_penalty": 0.5, "critic_penalty": 0.3}, {"actor_penalty": 0.01, "critic_penalty": 0.0}],
    ),
    "rebrac, other settings": (
        60,
        {**TD3, "critics": 3, "actor_learning_rate": 5e-4, "critic_learning_rate": 2e-3},
        [{"actor_penalty": 0.1}, {"critic_penalty": 0.1}],
    ),
}
NOT_IN_UPDATES = {"normalize", "top", "eval_samples"}  # settings of the data and of evaluations


def make(case: str) -> tuple[Any, list[Any], list[Any]]:
    """Return the stack of a case, the Config of each run and the reference of each run."""
    _, shared, own = CASES[case]
    name = case.partition(",")[0]
    kind = load_algorithm(name)
    configs: list[Any] = [kind.Config(**{"hidden": (16, 16), "batch_size": BATCH, **shared, **c}) for c in own]
    stack: Any = kind(stack_configs(configs, "cpu"), OBS, ACT, [3, 4], "cpu")
    if name.startswith("bdb"):  # larger Q: the critics disagree by more than 1, and adaptive beta leaves its bound
        with torch.no_grad():
            stack.critic.flat *= 2.5
            stack.critic_target.flat.copy_(stack.critic.flat)
    return stack, configs, [REFERENCES[name](stack, run, config) for run, config in enumerate(configs)]


def train(case: str) -> tuple[Any, list[Any], dict[str, Tensor]]:
    """Update the stack and the references of a case, compare their losses, and return both and the last logs."""
    (stack, _, references), generator = make(case), torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, *shape, generator=generator)

    def draw(found: Any) -> Tensor:
        uniform = found.name == "uniform"
        return 2 * torch.rand(2, *found.shape, generator=generator) - 1 if uniform else normal(*found.shape)

    last: dict[str, Tensor] = {}
    for number in range(CASES[case][0]):
        masks, has = ((torch.rand(2, BATCH, generator=generator) > 0.2).float() for _ in range(2))
        actions, next_actions = ((1.1 * normal(BATCH, ACT).tanh()).clamp(-1, 1) for _ in range(2))
        known = next_actions * has.unsqueeze(-1)
        batch = Batch(normal(BATCH, OBS), actions, normal(BATCH), normal(BATCH, OBS), masks, known, has)
        noise = {key: draw(found) for key, found in stack.noise_spec(stack.config).items()}
        logs = {k: v.detach().clone() for k, v in stack.update(batch, noise, stack.phase(number)).items()}
        for run, one in enumerate(references):
            losses = one.update([x[run].double() for x in batch], {key: x[run].double() for key, x in noise.items()})
            for key, loss in losses.items():
                assert logs[key][run].item() == pytest.approx(loss.item(), rel=2e-3, abs=1e-4), (number, key)
        last |= logs
    return stack, references, last


@pytest.mark.parametrize("case", CASES)
def test_an_algorithm_follows_its_float64_reference(case: str) -> None:
    start = make(case)[0].actor.flat.detach()
    stack, references, logs = train(case)
    tolerance = 2e-4 if isinstance(references[0], IQL | BEAR) else 1e-5
    for run, one in enumerate(references):
        for part, theirs in one.parts().items():
            ours = getattr(stack, part)
            if isinstance(theirs, nn.Parameter):
                torch.testing.assert_close(ours.value[run].double(), theirs, rtol=0, atol=tolerance)
                continue
            for a, b in zip(networks(ours, run), theirs, strict=True):
                for p, q in zip(a.parameters(), b.parameters(), strict=True):
                    torch.testing.assert_close(p, q, rtol=0, atol=tolerance)
            # nothing moves what is there for alignment alone
            assert not ours.flat[..., sum(p.numel() for p in theirs[0].parameters()) :].any()
    assert (stack.actor.flat - start).abs().max() > 1e-3  # it did move
    if isinstance(references[0], BDB):
        assert 0.01 < logs["beta"][1].item() < 0.99  # the rule was at work, not at its bound
    if case == "bear":
        values = [one.log_multiplier.item() for one in references]
        assert values[0] > 0.01
        assert values[1] < -0.01  # held from both sides
    if case == "iql, other settings":
        assert references[0].limited  # weights of single samples reached their limit


@pytest.mark.parametrize("case", ["bc", *(case for case in CASES if case.endswith("other settings"))])
def test_networks_and_noise_have_the_sizes_of_the_settings(case: str) -> None:
    """The references take these sizes from the stack."""
    stack, (c, _), _ = make(case)
    hidden = dict.fromkeys(("actor", "critic", "value"), "hidden") | {"discriminator": "discriminator_hidden"}
    for name, setting in (hidden | {"encoder": "vae_hidden", "decoder": "vae_hidden"}).items():
        for network in networks(getattr(stack, name), 0) if hasattr(stack, name) else []:
            widths = [layer.out_features for layer in network.children() if isinstance(layer, nn.Linear)]
            assert tuple(widths[:-1]) == getattr(c, setting), name
    if hasattr(stack, "critic"):
        assert len(networks(stack.critic, 0)) == getattr(c, "critics", 2)
    samples = {"penalty_actions": ["uniform"], "num_actions": ["here", "there", "uniform"]}
    for setting, names in (samples | {"match_samples": ["data", "actor"], "target_samples": ["target"]}).items():
        for name in names if hasattr(c, setting) else []:
            assert stack.noise_spec(stack.config)[name].shape[:2] == (getattr(c, setting), BATCH), name


@pytest.mark.parametrize("name", algorithm_names())
def test_every_setting_of_an_algorithm_differs_from_its_default_in_some_case(name: str) -> None:
    configs = [config for case in CASES if case.partition(",")[0] == name for config in make(case)[1]]
    for field in dataclasses.fields(load_algorithm(name).Config):
        used = {getattr(config, field.name) for config in configs}
        assert field.name in NOT_IN_UPDATES or used - {field.default}, field.name
