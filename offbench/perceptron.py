"""The forward and backward pass of many equal perceptrons, written out.

Autograd would do the same, slower. On a CPU each product goes to the faster of PyTorch's two libraries: oneDNN, which
also applies the activation on its way, or what `@` calls (`make bench` compares them). Only gradients that somebody
asks for are computed. On a GPU all perceptrons are one batched product a layer.

    x [nets, batch, in],  flat [nets, P] = W0 [in, h] | b0 [h] | W1 [h, h] | b1 [h] | ... | 0  ->  [nets, batch, out]
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

# Which library is faster was measured over a range of shapes, on a processor of each kind. Processor and shape decide,
# never the clock: a run must be the same each time. Where PyTorch has AVX-512, oneDNN does the larger products in half
# the time on AMD's processors, on which the other library keeps to AVX2. Elsewhere the other one is ahead, but for
# products with very few columns.
WIDE: bool = torch.backends.cpu.get_cpu_capability().startswith("AVX512")
# Multiplications of a product below which a call of oneDNN costs more than it saves.
WORTH_IT, WORTH_IT_WHEN_NARROW, WORTH_IT_WHEN_COPIED = 2**17, 2**21, 2**22
FEW_COLUMNS = 8
# On a CPU a long batch goes through the layers in blocks that stay in the cache from one operation to the next: of so
# many numbers a layer, but of no fewer rows than pay for a block's own overhead.
BLOCK, BLOCK_ROWS = 2**19, 1024
Layer = tuple[Tensor, Tensor]  # weight [.., in, out], bias [.., out]
HAS_ONEDNN: bool = torch._C._has_mkldnn and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def perceptrons(flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str) -> Tensor:
    """Return the outputs [nets, batch, out] of perceptrons with layers of `sizes`, differentiable once.

    Args:
        flat: all weights and biases [nets, P]; what lies behind the last bias has no effect.
        x: inputs [nets, batch, in].
        activation: of the hidden layers, relu or tanh.
    """
    rows = max(BLOCK // max(sizes), BLOCK_ROWS)
    if x.shape[1] > rows and not _batched(x):
        return torch.cat([perceptrons(flat, block, sizes, activation) for block in torch.split(x, rows, 1)], 1)
    if torch.is_grad_enabled() and (flat.requires_grad or x.requires_grad):
        found: Tensor = _Perceptrons.apply(flat, x, tuple(sizes), activation)  # type: ignore[no-untyped-call]
        return found
    return _forward(flat, x, sizes, activation)[0]


def _forward(
    flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str
) -> tuple[Tensor, list[list[Layer]], list[Tensor]]:
    """Return the outputs, and what the way back needs: each group's layers, and what went into each of them."""
    outputs, nets, kept = [], [], []
    for own, h in zip(_each(flat), _each(x), strict=True):
        nets.append(layers := _layers(own, sizes))
        kept.append(h)
        for weight, bias in layers[:-1]:
            kept.append(h := affine(h, weight, bias, activation))
        outputs.append(affine(h, *layers[-1], "none"))
    return _together(outputs), nets, kept


class _Perceptrons(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, flat: Tensor, x: Tensor, sizes: tuple[int, ...], activation: str) -> Tensor:
        out, ctx.nets, kept = _forward(flat, x, sizes, activation)
        ctx.save_for_backward(flat, *kept)  # flat, whose views the layers are: autograd sees if it was changed
        ctx.sizes, ctx.activation = sizes, activation
        ctx.used = sum((i + 1) * o for i, o in itertools.pairwise(sizes))
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        flat, *kept = ctx.saved_tensors
        of_flat, of_x = ctx.needs_input_grad[:2]
        depth = len(kept) // len(ctx.nets)
        of_nets, x_grads = torch.empty_like(flat) if of_flat else None, list[Tensor]()
        if of_nets is not None:
            of_nets[..., ctx.used :] = 0
        for group, (layers, grad) in enumerate(zip(ctx.nets, _each(grads[0]), strict=True)):
            own = _layers(_each(of_nets)[group], ctx.sizes) if of_nets is not None else []
            for layer in reversed(range(depth)):
                weight, h = layers[layer][0], kept[group * depth + layer]
                if own:
                    product(h.mT, grad, out=own[layer][0])
                    torch.sum(grad, -2, out=own[layer][1])
                if layer:
                    grad = _before(product(grad, weight.mT), h, ctx.activation)
                elif of_x:
                    x_grads.append(product(grad, weight.mT))
        return of_nets, _together(x_grads) if of_x else None, None, None


def _batched(tensor: Tensor) -> bool:
    """On a GPU all nets at once; on a CPU one after the other, for one net's arrays stay in the cache."""
    return tensor.is_cuda


def _each(tensor: Tensor) -> Sequence[Tensor]:
    """Return what is computed together: all nets' part of a tensor, or each net's without its axis."""
    return (tensor,) if _batched(tensor) else tensor.unbind()


def _together(parts: list[Tensor]) -> Tensor:
    """Undo `_each`."""
    return parts[0] if _batched(parts[0]) else torch.stack(parts)


def _layers(flat: Tensor, sizes: Sequence[int]) -> list[Layer]:
    """Return each layer's weight and bias, views of `flat` [.., P]."""
    outer, strides, first = flat.shape[:-1], flat.stride()[:-1], flat.storage_offset()
    layers = []
    for i, o in itertools.pairwise(sizes):
        weight = flat.as_strided((*outer, i, o), (*strides, o, 1), first)
        layers.append((weight, flat.as_strided((*outer, o), (*strides, 1), first + i * o)))
        first += (i + 1) * o
    return layers


def affine(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """Return activation(x @ weight + bias) [.., batch, out]."""
    if _onednn(x, weight):
        return _linear(x, weight.mT, bias, activation)
    out = torch.addmm(bias, x, weight) if x.dim() == 2 else torch.baddbmm(bias.unsqueeze(1), x, weight)
    return out if activation == "none" else out.relu_() if activation == "relu" else out.tanh_()


def product(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """Return a @ b [.., m, n], in `out` if it is given."""
    if not _onednn(a, b):
        return torch.matmul(a, b, out=out)
    found = _linear(a, b.mT, None, "none")
    return found if out is None else out.copy_(found)


def _before(grad: Tensor, h: Tensor, activation: str) -> Tensor:
    """Turn the gradient of an activation's output h into that of its input, in place."""
    if activation == "relu":
        return torch.ops.aten.threshold_backward.grad_input(grad, h, 0, grad_input=grad)  # type: ignore[no-any-return]
    return torch.ops.aten.tanh_backward.grad_input(grad, h, grad_input=grad)  # type: ignore[no-any-return]


def _onednn(a: Tensor, b: Tensor) -> bool:
    if not HAS_ONEDNN or a.dim() > 2 or a.dtype != torch.float32 or a.is_cuda:
        return False
    (m, k), n = a.shape, b.shape[1]
    if n == 1 or (n > FEW_COLUMNS and not WIDE):
        return False
    if n > FEW_COLUMNS and not a.is_contiguous():  # the gradients of weights: PyTorch turns `a` round for oneDNN
        return m * k * n >= WORTH_IT_WHEN_COPIED
    return m * k * n >= (WORTH_IT if k >= 64 else WORTH_IT_WHEN_NARROW)


def _linear(a: Tensor, b: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    """Return oneDNN's activation(a @ b.T + bias) of one network: the operation that PyTorch's own compiler calls."""
    found: Tensor = torch.ops.mkldnn._linear_pointwise.default(a, b, bias, activation, [], "")
    return found
