"""Every variant of every algorithm trains the bits that it trained at commit 60faca9, before the files were rewritten.

tests/fixtures/earlier/variants.safetensors has what two runs of each case had learned after 24 updates there, on one
AMD EPYC. `python -m tests.training.test_bits_stay` writes it anew, which is right only where bits are meant to change.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from offbench.benchmarks.throughput import random_stack
from offbench.common.provenance import hardware
from offbench.common.settings import build
from offbench.envs.recipes import load_recipe
from offbench.training.devices import matmul_settings
from offbench.training.registry import load_algorithm

STORED = Path(__file__).parent.parent / "fixtures" / "earlier" / "variants.safetensors"
UPDATES = 24
SMALL = {"hidden": (8, 8), "batch_size": 16}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "bc": ("bc", {}),
    "bc of the best": ("bc", {"top": 0.5, "normalize": False}),
    "td3_bc": ("td3_bc", {}),
    "td3_bc otherwise": ("td3_bc", {"alpha": 1.0, "policy_freq": 3, "policy_noise": 0.5, "normalize": False}),
    "bdb": ("bdb", {}),
    "bdb fixed": ("bdb", {"beta": 0.3}),
    "bdb of the batch": ("bdb", {"beta_scope": "batch", "critics": 3, "discriminator_hidden": (8,)}),
    "bdb learned": ("bdb_plus", {"beta": "learned", "beta_learning_rate": 1e-2}),
    "bdb with a penalty": ("bdb_plus", {"critic_penalty": "cql", "penalty_weight": 2.0, "penalty_actions": 3}),
    "bdb_plus": ("bdb_plus", {}),
    "cql": ("cql", {"bc_steps": 12, "num_actions": 3}),
    "cql lagrange": ("cql", {"bc_steps": 0, "num_actions": 3, "lagrange": True, "eval_samples": 5, "alpha": 2.0}),
}


def processor() -> dict[str, str]:
    """Return what the last bits depend on: AMD's and Intel's processors round otherwise, with the same vectors too."""
    return {key: hardware()[key] for key in ("processor", "vectors")}


def learned(case: str) -> dict[str, Tensor]:
    """Return everything that two runs of a case have learned."""
    algorithm, settings = CASES[case]
    kind = load_algorithm(algorithm)
    small = SMALL | ({"discriminator_hidden": (8, 8)} if algorithm.startswith("bdb") else {})
    config = build(kind.Config, small | settings, case)
    stack = random_stack(kind, [config, config], load_recipe("hopper").env_spec())
    with matmul_settings("cpu"):
        stack.train(UPDATES)
    return {name: tensor.detach().clone() for name, tensor in stack.tensors().items() if name.endswith("flat")}


@pytest.mark.parametrize("case", CASES)
def test_a_variant_trains_the_same_bits(case: str) -> None:
    found = learned(case)
    with safe_open(STORED, "pt") as stored:
        same = stored.metadata() == processor()
        prefix = "bdb/" if case == "bdb_plus" else f"{case}/"  # by default the two are the same
        names = [name for name in stored.keys() if name.startswith(prefix)]  # noqa: SIM118 (not a dict)
        assert names
        for name in names:
            before, now = stored.get_tensor(name), found.get(name.removeprefix(prefix))
            if now is None:  # bdb stored a learned beta, which is bdb_plus's and moved in no run of bdb
                assert name.endswith("learned_beta.flat")
                assert not before.any()
                continue
            # other processors round otherwise
            torch.testing.assert_close(now, before, rtol=0, atol=0 if same else 1e-5, msg=f"{name} has changed")


if __name__ == "__main__":
    tensors = {f"{case}/{name}": tensor for case in CASES for name, tensor in learned(case).items()}
    save_file(tensors, STORED, metadata=processor())
