"""The forward and backward pass of many equal perceptrons, written out.

Autograd would do the same; written out it is half the time. On a CPU every product goes to oneDNN, which on some
processors is twice as fast as what `@` calls (on AMD's: 200 against 88 Gflop/s) and applies the activation on its way,
no pass over an array is made twice, and only the gradients that somebody asks for are computed. On a GPU all
perceptrons are one batched product a layer.

    x [nets, batch, in],  flat [nets, P] = W0 [in, h] | b0 [h] | W1 [h, h] | b1 [h] | ...  ->  [nets, batch, out]
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

# Multiplications of a product below which a call of oneDNN costs more than it saves, measured over a range of shapes.
WORTH_IT, WORTH_IT_WHEN_NARROW = 2**17, 2**21
HAS_ONEDNN: bool = torch._C._has_mkldnn and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def perceptrons(flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str) -> Tensor:
    """Return the outputs [nets, batch, out] of perceptrons with layers of `sizes`, differentiable once.

    Args:
        flat: all weights and biases [nets, P].
        x: inputs [nets, batch, in].
        activation: of the hidden layers, relu or tanh.
    """
    found: Tensor = _Perceptrons.apply(flat, x, tuple(sizes), activation)  # type: ignore[no-untyped-call]
    return found


class _Perceptrons(torch.autograd.Function):
    """On a GPU all nets at once; on a CPU one after the other, whose arrays stay in the cache."""

    @staticmethod
    def forward(ctx: Any, flat: Tensor, x: Tensor, sizes: tuple[int, ...], activation: str) -> Tensor:
        outputs, kept = [], [flat]
        for own, h in _groups(flat, x):
            *hidden, last = _layers(own, sizes)
            kept.append(h)
            for weight, bias in hidden:
                kept.append(h := affine(h, weight, bias, activation))
            outputs.append(affine(h, *last, "none"))
        ctx.save_for_backward(*kept)
        ctx.sizes, ctx.activation = sizes, activation
        return torch.cat(outputs) if len(outputs) > 1 else outputs[0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        flat, *kept = ctx.saved_tensors
        of_flat, of_x = ctx.needs_input_grad[:2]
        layers = len(ctx.sizes) - 1
        flat_grads: list[Tensor] = []
        x_grads: list[Tensor] = []
        for place, (own, grad) in enumerate(_groups(flat, grads[0])):
            entered, parts = kept[place * layers : (place + 1) * layers], []
            for layer, (weight, _) in reversed(list(enumerate(_layers(own, ctx.sizes)))):
                h = entered[layer]
                if of_flat:
                    parts += [grad.sum(1), product(h.transpose(1, 2), grad).flatten(1)]
                if layer:
                    grad = _before(product(grad, weight.transpose(1, 2)), h, ctx.activation)
                elif of_x:
                    x_grads.append(product(grad, weight.transpose(1, 2)))
            flat_grads += parts[::-1]
        of_nets = _joined(flat_grads, flat.shape) if of_flat else None
        return of_nets, torch.cat(x_grads) if of_x else None, None, None


def _groups(flat: Tensor, x: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return the nets that are computed together, with what belongs to them."""
    if x.is_cuda or len(x) == 1:
        return [(flat, x)]
    return [(flat[net : net + 1], x[net : net + 1]) for net in range(len(x))]


def _joined(parts: list[Tensor], shape: torch.Size) -> Tensor:
    """Return pieces of gradients, each [nets of a group, numbers], as one tensor [nets, P]."""
    return torch.cat(parts, 1).view(shape)  # one group of all nets, or groups of one net end to end


def _layers(flat: Tensor, sizes: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
    """Return (weight [nets, in, out], bias [nets, out]) of each layer, views of `flat`."""
    shapes = list(itertools.pairwise(sizes))
    parts = iter(torch.split(flat, [n for i, o in shapes for n in (i * o, o)], dim=1))
    return [(next(parts).view(-1, i, o), next(parts)) for i, o in shapes]


def affine(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """Return activation(x @ weight + bias) [nets, batch, out]."""
    if _onednn(x, weight):
        return _linear(x, weight, bias[0], activation)
    out = torch.baddbmm(bias.unsqueeze(1), x, weight)
    return out if activation == "none" else out.relu_() if activation == "relu" else out.tanh_()


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return a @ b [nets, m, n]."""
    return _linear(a, b, None, "none") if _onednn(a, b) else torch.bmm(a, b)


def _before(grad: Tensor, h: Tensor, activation: str) -> Tensor:
    """Turn the gradient of an activation's output h into that of its input, in place."""
    if activation == "relu":
        return torch.ops.aten.threshold_backward(grad, h, 0, grad_input=grad)  # type: ignore[no-any-return]
    return torch.ops.aten.tanh_backward(grad, h, grad_input=grad)  # type: ignore[no-any-return]


def _onednn(a: Tensor, b: Tensor) -> bool:
    (nets, m, k), n = a.shape, b.shape[2]
    if not HAS_ONEDNN or nets > 1 or n == 1 or a.dtype != torch.float32 or a.is_cuda:
        return False
    return m * k * n >= (WORTH_IT if k >= 64 else WORTH_IT_WHEN_NARROW)


def _linear(a: Tensor, b: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    """oneDNN's activation(a @ b + bias) of one network: the operation that PyTorch's own compiler calls."""
    found: Tensor = torch.ops.mkldnn._linear_pointwise(a[0], b[0].t(), bias, activation, [], "")
    return found.unsqueeze(0)
