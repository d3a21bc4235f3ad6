"""Stacked networks: one flat tensor holds a network's parameters for all runs.

    flat [ensemble, runs, P]        ensemble: 1 actor, or the M critics of a run
      = W0 [.., in, h] | b0 [.., h] | W1 [.., h, h] | b1 [.., h] | ... | 0      (x @ W + b)

One call computes all members and runs (offbench.algorithm.mlp), and Adam and Polyak averaging are one pass over one
tensor. Runs share nothing, so the gradient of the runs' summed losses is each run's own gradient.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.optim.adam import adam

from offbench.algorithm.buffers import ALIGNED
from offbench.algorithm.mlp import mlp_forward
from offbench.common import seeds
from offbench.common.errors import OffbenchError
from offbench.common.seeds import Purpose

Schedule = Callable[[Tensor], Tensor]  # takes the number of earlier steps, a tensor []; returns the learning rate


class NetworkOptions(TypedDict, total=False):
    """Arguments of `Network` that have a default in `Algorithm.network`."""

    hidden: Sequence[int]
    activation: Literal["relu", "tanh"]
    norm: Literal["none", "before", "after"]
    twice_differentiable: bool
    weight_decay: float


def cosine_decay(learning_rate: float, steps: int) -> Schedule:
    """Return a learning rate that falls from `learning_rate` to 0 over `steps` steps, along half a cosine."""
    return lambda step: 0.5 * learning_rate * (1 + torch.cos(math.pi * (step / steps).clamp(max=1)))


def linear_decay(learning_rate: float, steps: int) -> Schedule:
    """Return a learning rate that falls from `learning_rate` to 0 over `steps` steps, along a line."""
    return lambda step: learning_rate * (1 - (step / steps).clamp(max=1))


class Parameters:
    """A flat tensor [ensemble, runs, P] that Adam moves. Runs are axis 1, in every tensor of `tensors()`.

    Args:
        flat: the initial values, [ensemble, runs, P].
        learning_rate: Adam's; a number, or a function of the number of earlier steps (`cosine_decay`).
        weight_decay: decoupled weight decay of all parameters, as in AdamW.
        scalar: whether `value` is without its last axis.
    """

    def __init__(
        self, flat: Tensor, learning_rate: float | Schedule, *, weight_decay: float = 0.0, scalar: bool = False
    ) -> None:
        if isinstance(learning_rate, Tensor):
            raise OffbenchError("a learning rate is a number or a schedule; its setting cannot be per_run")
        self._spare = -flat.shape[-1] % ALIGNED
        self._whole = pad(flat, (0, self._spare)) if self._spare else flat
        self.flat = self._whole[..., : flat.shape[-1]].requires_grad_()
        self.learning_rate, self.weight_decay, self._scalar = learning_rate, weight_decay, scalar
        self.state: dict[str, Tensor] = {
            "step": torch.zeros((), dtype=torch.float32, device=flat.device),
            "exp_avg": torch.zeros_like(self._whole),
            "exp_avg_sq": torch.zeros_like(self._whole),
        }

    @property
    def value(self) -> Tensor:
        """The numbers of each run: [runs, P], or [runs] of a scalar."""
        return self.flat[0, :, 0] if self._scalar else self.flat[0]

    def minimize(self, loss: Tensor, retain_graph: bool = False) -> None:
        """Take one Adam step down the gradient of `loss` [runs], for these parameters only."""
        minimize(loss, self, retain_graph=retain_graph)

    @torch.no_grad()
    def adam_step(self, grad: Tensor) -> None:
        """Take one Adam step down a gradient [ensemble, runs, P], by PyTorch's function: its class is slower."""
        rate = self.learning_rate
        adam(
            [self._whole],
            [pad(grad, (0, self._spare)) if self._spare else grad],
            [self.state["exp_avg"]],
            [self.state["exp_avg_sq"]],
            [],
            [self.state["step"]],
            fused=True,
            decoupled_weight_decay=self.weight_decay > 0,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=rate(self.state["step"]) if callable(rate) else rate,
            weight_decay=self.weight_decay,
            eps=1e-8,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint keeps, each [ensemble, runs, P] except the step count."""
        return {"flat": self._whole, **self.state}


def minimize(loss: Tensor, *parts: Parameters, retain_graph: bool = False) -> None:
    """Take one Adam step of each part down the gradient of `loss`; all gradients come before the steps.

    Args:
        loss: one number for each run, [runs].
        parts: what is moved.
        retain_graph: as in `torch.autograd.grad`: keep the graph for another gradient.

    Raises:
        OffbenchError: `loss` has another shape.
    """
    if loss.shape != (runs := parts[0].flat.shape[1],):
        raise OffbenchError(
            f"a loss is one number for each run, [runs] = [{runs}], not {list(loss.shape)}: reduce the other axes"
        )
    grads = torch.autograd.grad(loss.sum(), [part.flat for part in parts], retain_graph=retain_graph)
    for part, grad in zip(parts, grads, strict=True):
        part.adam_step(grad)


class Network(Parameters):
    """MLPs of the same shape, with PyTorch's default initialization.

    Args:
        inputs: total width of the inputs, which are concatenated.
        hidden: widths of the hidden layers.
        outputs: width of the outputs; None for a single number without an axis of its own.
        run_seeds: one seed for each run; a run's weights depend only on its seed and on `index`.
        index: the network's number among those of an algorithm.
        learning_rate, weight_decay: as in `Parameters`.
        ensemble_size: MLPs for each run; None for a single one without an ensemble axis.
        activation: activation of the hidden layers, relu or tanh.
        norm: LayerNorm in the hidden layers, "before" or "after" the activation, or "none".
        twice_differentiable: whether gradients of gradients are needed (a gradient penalty); costs more on a CPU.
        device: where the parameters are.
    """

    def __init__(
        self,
        inputs: int,
        hidden: Sequence[int],
        outputs: int | None,
        run_seeds: Sequence[int],
        index: int,
        *,
        learning_rate: float | Schedule,
        ensemble_size: int | None = None,
        activation: Literal["relu", "tanh"] = "relu",
        norm: Literal["none", "before", "after"] = "none",
        twice_differentiable: bool = False,
        weight_decay: float = 0.0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.sizes = (inputs, *hidden, outputs or 1)
        self.ensemble_size = ensemble_size or 1
        self._squeezed = [axis for axis, size in ((-1, outputs), (0, ensemble_size)) if size is None]
        self.activation, self.norm, self.twice_differentiable = activation, norm, twice_differentiable
        self._shapes = list(itertools.pairwise(self.sizes))
        members = range(self.ensemble_size)
        flat = np.stack([[self._initial(seed, index, member) for seed in run_seeds] for member in members])
        super().__init__(torch.from_numpy(flat).to(device), learning_rate, weight_decay=weight_decay)

    def _initial(self, seed: int, index: int, member: int) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
        """Draw one network: U(-1/sqrt(fan_in), 1/sqrt(fan_in)) for weights and biases, as torch.nn.Linear."""
        rng = seeds.generator(seed, Purpose.WEIGHTS, index, member)
        parts = []
        for layer, (i, o) in enumerate(self._shapes):
            parts += [rng.uniform(-1 / math.sqrt(i), 1 / math.sqrt(i), n) for n in (i * o, o)]
            if self.norm != "none" and layer < len(self._shapes) - 1:
                parts += [np.ones(o), np.zeros(o)]
        parts.append(np.zeros(-sum(map(len, parts)) % ALIGNED))
        return np.concatenate(parts).astype(np.float32)

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the outputs for inputs [runs, batch, dim], concatenated.

        They are [ensemble, runs, batch, out], without the first axis if there is no ensemble, and without the last if
        each output is a single number.
        """
        return self.forward(self.flat, *inputs)

    def frozen(self, *inputs: Tensor, members: int | slice = slice(None)) -> Tensor:
        """Return the outputs as a call does, without gradients of the weights.

        Args:
            inputs: each [runs, batch, dim].
            members: index of one member (drops the ensemble axis), or a slice.
        """
        if isinstance(members, slice):
            return self.forward(self.flat.detach()[members], *inputs)
        outputs = self.forward(self.flat.detach()[members].unsqueeze(0), *inputs)
        return outputs if 0 in self._squeezed else outputs.squeeze(0)

    def forward(self, flat: Tensor, *inputs: Tensor) -> Tensor:
        """Return the outputs of networks whose parameters are `flat`."""
        shapes, runs = [list(x.shape) for x in inputs], flat.shape[1]
        fit = all(len(shape) == 3 and shape[:2] == [runs, shapes[0][1]] for shape in shapes)
        if not fit or sum(shape[2] for shape in shapes) != self.sizes[0]:
            raise OffbenchError(
                f"a network of {runs} runs takes inputs [runs, batch, dim] of {self.sizes[0]} dimensions in all, not "
                f"{' and '.join(map(str, shapes))}"
            )
        outputs = mlp_forward(flat, inputs, self.sizes, self.activation, self.norm, self.twice_differentiable)
        for axis in self._squeezed:
            outputs = outputs.squeeze(axis)
        return outputs

    def layers(self, run: int, member: int = 0) -> list[tuple[Tensor, Tensor]]:
        """Return (weight [in, out], bias [out]) of each layer of one network, on the CPU, for a policy file.

        Raises:
            OffbenchError: the network has LayerNorm, which a policy file cannot hold.
        """
        if self.norm != "none":
            raise OffbenchError("a policy file cannot hold a network with LayerNorm")
        widths = [n for i, o in self._shapes for n in (i * o, o)]
        parts = iter(torch.split(self.flat.detach()[member, run, : sum(widths)].cpu(), widths))
        return [(next(parts).view(i, o).clone(), next(parts).clone()) for i, o in self._shapes]


class Target:
    """A copy of a network that follows it slowly."""

    def __init__(self, source: Network) -> None:
        self.source = source
        self.flat = source.flat.detach().clone()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the copy's outputs, with the axes of the network's."""
        return self.source.forward(self.flat, *inputs)

    def polyak_update(self, tau: float) -> None:
        """Set target = (1 - tau) target + tau network."""
        self.flat.lerp_(self.source.flat.detach(), tau)

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint keeps."""
        return {"flat": self.flat}
