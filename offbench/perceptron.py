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

# Below these sizes a call of oneDNN costs more than it saves.
LEAST_WIDTH = 8
LEAST_PRODUCTS = 2**20
HAS_ONEDNN: bool = torch._C._has_mkldnn and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def perceptrons(flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str) -> Tensor:
    """Return the outputs [nets, batch, out] of perceptrons with layers of `sizes`, differentiable once.

    Args:
        flat: all weights and biases [nets, P].
        x: inputs [nets, batch, in].
        activation: of the hidden layers, relu or tanh.
    """
    if x.is_cuda or len(x) == 1:
        return _call(flat, x, sizes, activation)
    each = zip(torch.split(flat, 1), torch.split(x, 1), strict=True)
    return torch.cat([_call(*one, sizes, activation) for one in each])


def _call(flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str) -> Tensor:
    found: Tensor = _Perceptrons.apply(flat, x, tuple(sizes), activation)  # type: ignore[no-untyped-call]
    return found


class _Perceptrons(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, flat: Tensor, x: Tensor, sizes: tuple[int, ...], activation: str) -> Tensor:
        entered, layers = [x], _layers(flat, sizes)
        for weight, bias in layers[:-1]:
            entered.append(affine(entered[-1], weight, bias, activation))
        ctx.save_for_backward(flat, *entered)
        ctx.sizes, ctx.activation = sizes, activation
        return affine(entered[-1], *layers[-1], "none")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        flat, *entered = ctx.saved_tensors
        of_flat, of_x = ctx.needs_input_grad[:2]
        grad, parts = grads[0], []
        for (weight, _), h in zip(reversed(_layers(flat, ctx.sizes)), reversed(entered), strict=True):
            if of_flat:
                parts += [grad.sum(1), product(h.transpose(1, 2), grad).flatten(1)]
            if h is not entered[0]:
                grad = _before(product(grad, weight.transpose(1, 2)), h, ctx.activation)
            elif of_x:
                grad = product(grad, weight.transpose(1, 2))
        return torch.cat(parts[::-1], 1) if of_flat else None, grad if of_x else None, None, None


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
    fits = HAS_ONEDNN and nets == 1 and a.dtype == torch.float32 and not a.is_cuda
    return fits and min(m, k, n) >= LEAST_WIDTH and m * k * n >= LEAST_PRODUCTS


def _linear(a: Tensor, b: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    """oneDNN's activation(a @ b + bias) of one network: the operation that PyTorch's own compiler calls."""
    found: Tensor = torch.ops.mkldnn._linear_pointwise(a[0], b[0].t(), bias, activation, [], "")
    return found.unsqueeze(0)
