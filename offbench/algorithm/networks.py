"""Stacked networks: every parameter of one network of all runs lies in one flat tensor.

    flat [copies, runs, P]          copies: 1 actor, or the M critics of a run
      = W0 [.., in, h] | b0 [.., h] | W1 [.., h, h] | b1 [.., h] | ... | 0      (x @ W + b)

One call serves all copies and runs (offbench.algorithm.mlp), and Adam and Polyak are one pass over one tensor. Runs
share nothing, so the gradient of the runs' summed losses is each run's own gradient.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.optim.adam import adam

from offbench.algorithm.mlp import perceptrons
from offbench.common import seeds
from offbench.common.seeds import Purpose

# What a run learns is stored in multiples of this many numbers, so that each run begins where a processor's wide
# registers do: loops round what is left at their end differently, and a run must be the same alone and in a stack.
ALIGNED = 16


class Learned:
    """A flat tensor [copies, runs, P] that Adam moves. Runs are axis 1, in every tensor of `tensors()`."""

    def __init__(self, flat: Tensor, learning_rate: float) -> None:
        self._spare = -flat.shape[-1] % ALIGNED
        self._whole = pad(flat, (0, self._spare)) if self._spare else flat
        self.flat = self._whole[..., : flat.shape[-1]].requires_grad_()
        self.learning_rate = learning_rate
        self.state: dict[str, Tensor] = {
            "step": torch.zeros((), dtype=torch.float32, device=flat.device),
            "exp_avg": torch.zeros_like(self._whole),
            "exp_avg_sq": torch.zeros_like(self._whole),
        }

    def minimize(self, loss: Tensor, retain_graph: bool = False) -> None:
        """Take one Adam step down the gradient of `loss` (runs summed), for these parameters alone."""
        (grad,) = torch.autograd.grad(loss, [self.flat], retain_graph=retain_graph)
        self.descend(grad)

    @torch.no_grad()
    def descend(self, grad: Tensor) -> None:
        """Take one Adam step down a gradient [copies, runs, P]: torch's function, its class costs twice the time."""
        adam(
            [self._whole],
            [pad(grad, (0, self._spare)) if self._spare else grad],
            [self.state["exp_avg"]],
            [self.state["exp_avg_sq"]],
            [],
            [self.state["step"]],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint keeps, each [copies, runs, P] but for the step count."""
        return {"flat": self._whole, **self.state}


class Network(Learned):
    """Multilayer perceptrons of one shape, `copies` for each run, with PyTorch's default initial weights.

    Args:
        sizes: widths of all layers, inputs first.
        run_seeds: one seed a run; a run's weights depend on its seed and on `index` alone.
        index: tells an algorithm's networks apart.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        run_seeds: Sequence[int],
        index: int,
        *,
        learning_rate: float,
        copies: int = 1,
        activation: str = "relu",
        device: torch.device | str = "cpu",
    ) -> None:
        self.sizes, self.copies, self.runs = tuple(sizes), copies, len(run_seeds)
        self.activation = activation
        self._shapes = list(itertools.pairwise(self.sizes))
        self._splits = [n for i, o in self._shapes for n in (i * o, o)]
        flat = np.stack([[self._initial(seed, index, copy) for seed in run_seeds] for copy in range(copies)])
        super().__init__(torch.from_numpy(flat).to(device), learning_rate)

    def _initial(self, seed: int, index: int, copy: int) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
        """Draw one network: U(-1/sqrt(fan_in), 1/sqrt(fan_in)) for weights and biases, as torch.nn.Linear."""
        rng = seeds.generator(seed, Purpose.WEIGHTS, index, copy)
        bounds = [1 / math.sqrt(i) for i, o in self._shapes for _ in range(2)]
        parts = [rng.uniform(-b, b, n) for b, n in zip(bounds, self._splits, strict=True)]
        parts.append(np.zeros(-sum(self._splits) % ALIGNED))
        return np.concatenate(parts).astype(np.float32)

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the outputs [copies, runs, batch, out] for inputs [runs, batch, dim], concatenated."""
        return self.forward(self.flat, *inputs)

    def frozen(self, *inputs: Tensor, first: int = 0, copies: int | None = None) -> Tensor:
        """Like a call, with no gradient to the weights, of the copies from `first` up to `copies` alone."""
        return self.forward(self.flat.detach()[first:copies], *inputs)

    def forward(self, flat: Tensor, *inputs: Tensor) -> Tensor:
        """Return the outputs [copies, runs, batch, out] of the networks in `flat`."""
        return perceptrons(flat, inputs, self.sizes, self.activation)

    def layers(self, run: int) -> list[tuple[Tensor, Tensor]]:
        """Return (weight [in, out], bias [out]) of each layer of one run's first copy, on the CPU."""
        parts = iter(torch.split(self.flat.detach()[0, run, : sum(self._splits)].cpu(), self._splits))
        return [(next(parts).view(i, o).clone(), next(parts).clone()) for i, o in self._shapes]


class Target:
    """A slowly following copy of a network."""

    def __init__(self, source: Network) -> None:
        self.source = source
        self.flat = source.flat.detach().clone()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the copy's outputs [copies, runs, batch, out]."""
        return self.source.forward(self.flat, *inputs)

    def follow(self, tau: float) -> None:
        """Polyak: target <- (1 - tau) target + tau source."""
        self.flat.lerp_(self.source.flat.detach(), tau)

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint keeps."""
        return {"flat": self.flat}
