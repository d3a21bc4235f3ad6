"""Batches: the transitions on the device, and the random numbers that choose among them.

    chunk of CHUNK updates:  per run, from (run seed, chunk):  indices [CHUNK, runs, batch], noise [CHUNK, runs, ...]

A run's random numbers depend only on its own seed, the chunk and the type of device. So a run is the same alone and
in a stack, and a resume needs no generator state.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from offbench.algorithm.interface import NOT_LOADED, Batch, NoiseSpec
from offbench.common import seeds
from offbench.common.arrays import Array
from offbench.common.seeds import Purpose
from offbench.data.transitions import Transitions
from offbench.training.spec import RunSpec

CHUNK = 100  # updates whose random numbers are drawn together; part of the definition of a seed: never change it


class StackData:
    """The datasets of all runs of a stack on the device, concatenated.

    Args:
        specs: the runs.
        datasets: by the names that `specs` give them.
    """

    def __init__(
        self,
        specs: Sequence[RunSpec],
        datasets: Mapping[str, Transitions],
        normalize_observations: bool,
        device: torch.device,
        next_actions: bool = False,
    ) -> None:
        starts, count, row = {}, 0, 0
        parts: dict[str, list[Tensor]] = {k: [] for k in ("observations", "rows", "actions", "rewards", "masks")}
        used = {spec.dataset: datasets[spec.dataset] for spec in specs}
        for name, data in used.items():
            starts[name] = count
            for key, tensors in parts.items():
                array = getattr(data, key)
                tensors.append(_tensor(array + row if key == "rows" and row else array))
            count, row = count + len(data), row + len(data.observations)
        whole = {key: (t[0] if len(t) == 1 else torch.cat(t)).to(device) for key, t in parts.items()}
        self.observations, self.rows = whole["observations"], whole["rows"]
        self.actions, self.rewards, self.masks = whole["actions"], whole["rewards"], whole["masks"]
        self.sizes = [len(used[spec.dataset]) for spec in specs]
        offsets = [starts[spec.dataset] for spec in specs]
        self.selected: Tensor | None = None  # where runs train on a part: the transitions of each, concatenated
        shares = [getattr(spec.config, "top", 1.0) for spec in specs]
        if min(shares) < 1:
            parts_of_runs = [
                used[spec.dataset].best(top) + offset for spec, top, offset in zip(specs, shares, offsets, strict=True)
            ]
            self.sizes = [len(part) for part in parts_of_runs]
            offsets = [sum(self.sizes[:i]) for i in range(len(specs))]
            self.selected = torch.from_numpy(np.concatenate(parts_of_runs)).to(device)
        self.offsets = torch.tensor(offsets, device=device).view(-1, 1)
        dim = self.observations.shape[1]
        identity = (np.zeros(dim, np.float32), np.ones(dim, np.float32))
        normalizers = {name: data.normalizer() if normalize_observations else identity for name, data in used.items()}
        self.normalizers = [normalizers[spec.dataset] for spec in specs]  # (mean, std) of each run
        self.mean = torch.from_numpy(np.stack([mean for mean, _ in self.normalizers])).to(device).unsqueeze(1)
        self.std = torch.from_numpy(np.stack([std for _, std in self.normalizers])).to(device).unsqueeze(1)
        self.normalize = normalize_observations
        self.next_index: Tensor | None = None  # [N], index of the next transition; at an episode's end its own index
        if next_actions:
            has_next = torch.zeros(count, dtype=torch.bool, device=device)
            has_next[:-1] = self.rows[1:] == self.rows[:-1] + 1  # rows of different episodes are not consecutive
            self.next_index = torch.arange(count, device=device) + has_next
            self.has_next = has_next.float()

    def batch(self, indices: Tensor) -> Batch:
        """Return the transitions at `indices` [runs, batch], each run's counted from its own first."""
        flat = (indices + self.offsets).flatten()
        if self.selected is not None:
            flat = self.selected.index_select(0, flat)
        rows = self.rows.index_select(0, flat)
        shape = (*indices.shape, -1)
        observations = self.observations.index_select(0, rows).view(shape)
        next_observations = self.observations.index_select(0, rows + 1).view(shape)
        if self.normalize:
            observations = (observations - self.mean) / self.std
            next_observations = (next_observations - self.mean) / self.std
        next_actions = next_action_masks = NOT_LOADED
        if self.next_index is not None:
            next_action_masks = self.has_next.index_select(0, flat).view(indices.shape)
            next_actions = self.actions.index_select(0, self.next_index.index_select(0, flat)).view(shape)
            next_actions = next_actions * next_action_masks.unsqueeze(-1)
        return Batch(
            observations,
            self.actions.index_select(0, flat).view(shape),
            self.rewards.index_select(0, flat).view(indices.shape),
            next_observations,
            self.masks.index_select(0, flat).view(indices.shape),
            next_actions,
            next_action_masks,
        )


def _tensor(array: Array) -> Tensor:
    with warnings.catch_warnings():
        # PyTorch warns that the cache is mapped read-only; nothing here writes to it
        warnings.simplefilter("ignore", UserWarning)
        return torch.from_numpy(array)


def draw_chunk(
    run_seeds: Sequence[int],
    sizes: Sequence[int],
    batch_size: int,
    noise_spec: NoiseSpec,
    chunk: int,
    device: torch.device,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return a chunk's batch indices [CHUNK, runs, batch] and noise {name: [CHUNK, runs, *shape]}."""
    indices: list[Tensor] = []
    noise: dict[str, list[Tensor]] = {name: [] for name in noise_spec}
    for seed, size in zip(run_seeds, sizes, strict=True):
        generator = torch.Generator(device).manual_seed(seeds.integer(seed, Purpose.CHUNK, chunk))
        indices.append(torch.randint(size, (CHUNK, batch_size), generator=generator, device=device))
        for name, distribution in noise_spec.items():
            shape = (CHUNK, *distribution.shape)
            if distribution.name == "normal":
                noise[name].append(torch.randn(shape, generator=generator, device=device))
            else:
                noise[name].append(torch.rand(shape, generator=generator, device=device) * 2 - 1)
    return torch.stack(indices, 1), {name: torch.stack(parts, 1) for name, parts in noise.items()}
