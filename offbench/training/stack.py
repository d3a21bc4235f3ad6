"""A stack: runs that train together as one program, with their policies, logs and checkpoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from offbench.algorithm.interface import Algorithm, PolicyParts, check_noise_spec, stack_configs
from offbench.algorithm.networks import Network
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.settings import short_repr
from offbench.data.transitions import Transitions
from offbench.rollouts.policy import Policy, check_networks
from offbench.training.batches import CHUNK, StackData, draw_chunk
from offbench.training.captured_update import CapturedUpdate, random_states
from offbench.training.spec import RunSpec, settings_json

Layers = Sequence[tuple[Tensor, Tensor]]


class Stack:
    """The learning state of a stack of runs: everything but files and evaluations."""

    def __init__(
        self,
        algorithm_class: type[Algorithm],
        specs: Sequence[RunSpec],
        datasets: Mapping[str, Transitions],
        device: str,
    ) -> None:
        self.specs, self.device = list(specs), torch.device(device)
        self.data = [datasets[spec.dataset] for spec in specs]
        self.seeds = [spec.seed for spec in specs]
        config = stack_configs([spec.config for spec in specs], self.device)
        dims = {(data.observations.shape[1], data.actions.shape[1]) for data in self.data}
        if len(dims) != 1:
            raise OffbenchError(f"datasets of one stack must have the same shapes, not {sorted(dims)}")
        observation_dim, action_dim = dims.pop()
        before = random_states(self.device)
        self.algorithm = algorithm_class(config, observation_dim, action_dim, self.seeds, self.device)
        if random_states(self.device) != before:
            raise OffbenchError(
                f"{algorithm_class.__name__}.setup draws random numbers that do not depend on a run's seed alone; use "
                "self.network and self.parameters, or generators seeded by self.run_seeds"
            )
        _check_policy(self.algorithm, observation_dim, action_dim)
        if not self.algorithm.learned:
            raise OffbenchError(
                f"{algorithm_class.__name__} has no networks among its attributes: a checkpoint would be empty"
            )
        self.batch_size: int = config.batch_size
        self.store = StackData(specs, datasets, config.normalize, self.device, self.algorithm.uses_next_actions)
        self.noise_spec = self.algorithm.noise_spec(self.algorithm.config)
        check_noise_spec(self.noise_spec, f"{algorithm_class.__name__}.noise_spec")
        _check_phase(self.algorithm)
        self.captured_update = CapturedUpdate(self.algorithm, self.store)
        self.step = 0

    def train(self, until: int) -> None:
        """Update up to step `until`."""
        for _ in self.train_in_chunks(until):
            pass

    def train_in_chunks(self, until: int) -> Iterator[int]:
        """Update up to step `until`; yields the step after every chunk (and at the end)."""
        while self.step < until:
            chunk, first = divmod(self.step, CHUNK)
            drawn = draw_chunk(self.seeds, self.store.sizes, self.batch_size, self.noise_spec, chunk, self.device)
            self.captured_update.load(*drawn, first)
            for _ in range(first, min(CHUNK, first + until - self.step)):
                self.captured_update.run(self.algorithm.phase(self.step))
                self.step += 1
            yield self.step

    def policy(self, run: int) -> Policy:
        """Return one run's policy as it is now, for the NumPy rollouts and the policy file."""
        data, policy = self.data[run], self.normalized_policy(run)
        mean, std = self.store.normalizers[run]
        layers = policy.layers
        if policy.kind == "gaussian":  # such a policy file does not scale its actions: its last layer does
            (weight, bias), half = layers[-1], (data.high - data.low) / 2
            scale = np.concatenate([half, np.ones_like(half)])
            shift = np.concatenate([(data.high + data.low) / 2, np.log(half)])
            layers = (*layers[:-1], (weight * scale, bias * scale + shift))
        return replace(policy, layers=layers, observation_mean=mean, observation_std=std, low=data.low, high=data.high)

    def normalized_policy(self, run: int) -> Policy:
        """Return one run's policy as the algorithm sees it: observations normalized, actions in [-1, 1]."""
        data, parts = self.data[run], self.algorithm.policy(run)
        actor, critic = (tuple((w.numpy(), b.numpy()) for w, b in p) for p in (parts.layers, parts.critic))
        zeros, ones = (np.full_like(self.store.normalizers[run][0], value) for value in (0, 1))
        return Policy(
            parts.kind,
            actor,
            zeros,
            ones,
            -np.ones_like(data.low),
            np.ones_like(data.high),
            data.env_id,
            {"step": self.step, **self.policy_origin(run)},
            critic=critic,
            samples=parts.samples,
            activation=parts.activation,
        )

    def policy_origin(self, run: int) -> JsonObject:
        """Return a run's algorithm, seed and dataset, for its policy file."""
        spec, data = self.specs[run], self.data[run]
        return {
            "algorithm": spec.algorithm,
            "seed": spec.seed,
            "dataset": data.dataset_id,
            "dataset_sha256": data.content_sha256,
        }

    def checkpoint_origin(self, run: int) -> JsonObject:
        """Return a run's algorithm, seed, dataset and settings, for its checkpoints."""
        return self.policy_origin(run) | settings_json(self.specs[run].config)

    def tensors(self) -> dict[str, Tensor]:
        """Return everything learned; runs are axis 1 (a step count has none)."""
        return {
            f"{name}.{key}": value
            for name, part in self.algorithm.learned.items()
            for key, value in part.tensors().items()
        }

    def run_tensors(self, run: int) -> dict[str, Tensor]:
        """Return the tensors of one run's checkpoint: its slice of all learned tensors."""
        return slice_of(self.tensors(), run)

    def load(self, run: int, tensors: Mapping[str, Tensor], state: JsonObject) -> None:
        """Load one run's checkpoint. Raises OffbenchError if it does not fit, or is of another run."""
        check_origin(self.specs[run].folder, state, self.checkpoint_origin(run))
        for name, tensor in self.run_tensors(run).items():
            saved = tensors.get(name)
            if saved is None or saved.shape != tensor.shape:
                raise OffbenchError(f"the checkpoint in {self.specs[run].folder} does not fit; delete the run")
            with torch.no_grad():
                tensor.copy_(saved)

    def diverged(self) -> dict[int, str]:
        """Return the runs that contain NaN or infinity, each with the name of such a tensor."""
        names: dict[int, str] = {}
        for name, tensor in self.tensors().items():
            if tensor.dim():
                bad = (~torch.isfinite(tensor)).transpose(0, 1).flatten(1).any(1).nonzero()
                names |= {int(run): name for run in bad}
        return names


def _check_phase(algorithm: Algorithm) -> None:
    phase = algorithm.phase(0)
    try:
        hash(phase)
    except TypeError:
        name = type(algorithm).__name__
        raise OffbenchError(f"{name}.phase must return a number, text or tuple, not {phase!r:.60}") from None


def _check_policy(algorithm: Algorithm, observation_dim: int, action_dim: int) -> None:
    """Raise OffbenchError now, not at the first evaluation, if no policy file can hold the algorithm's policies."""
    where, parts = f"{type(algorithm).__name__}.policy", algorithm.policy(0)
    if not isinstance(parts, PolicyParts):
        raise OffbenchError(f"{where} must return PolicyParts, not a {type(parts).__name__}")
    try:
        check_networks(parts, observation_dim, action_dim)
        ready = not any(x.requires_grad or x.is_cuda for layer in [*parts.layers, *parts.critic] for x in layer)
    except (ValueError, TypeError, AttributeError) as error:  # the last two: layers that are not pairs of tensors
        raise OffbenchError(f"{where}: {error}") from None
    if not ready:
        raise OffbenchError(f"{where}: layers must be detached and on the CPU, as `Network.layers` returns them")
    for name, network in vars(algorithm).items():
        if isinstance(network, Network) and network.norm == "none" and network.activation != parts.activation:
            for layers in (parts.layers, parts.critic):
                if _equal(layers, network.layers(0)):
                    raise OffbenchError(
                        f"{where}: the layers of {name} have the activation {network.activation}, the policy "
                        f"{parts.activation}; give PolicyParts(..., activation={network.activation!r})"
                    )


def _equal(layers: Layers, others: Layers) -> bool:
    return len(layers) == len(others) and all(
        a.shape == b.shape and torch.equal(a, b)
        for one, other in zip(layers, others, strict=True)
        for a, b in zip(one, other, strict=True)
    )


def slice_of(tensors: Mapping[str, Tensor], run: int) -> dict[str, Tensor]:
    """Return one run's part of a stack's tensors."""
    return {name: value if value.dim() == 0 else value[:, run : run + 1] for name, value in tensors.items()}


def check_origin(folder: Path, state: JsonObject, expected: JsonObject) -> None:
    """Raise OffbenchError if a checkpoint belongs to another run, or to other settings."""
    recorded = state.get("origin", {})  # earlier versions wrote none, or not all of it
    for key, value in expected.items():
        if (old := recorded.get(key, value)) != value:
            raise OffbenchError(
                f"the checkpoint in {folder} is of another run: its {key} is {short_repr(old)}, "
                f"not {short_repr(value)}; put the run's own back, or delete the run to repeat it"
            )
