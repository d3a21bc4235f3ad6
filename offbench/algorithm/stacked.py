"""The forward pass of many MLPs of the same shape in plain PyTorch operations, differentiable any number of times.

    flat [ensemble, runs, P] = W0 [in, h] | b0 [h] | gain0 [h] | shift0 [h] | W1 [h, h] | ... | 0

Gains and shifts are LayerNorm's; without LayerNorm there are none.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import layer_norm


def batched_forward(
    flat: Tensor,
    inputs: Sequence[Tensor],
    sizes: Sequence[int],
    activation: str,
    norm: str = "none",
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Return the outputs of all MLPs, with one batched matrix product per layer.

    Args:
        dtype: data type of the hidden layers' products, by default that of `flat`. The last layer always has that of
            `flat`: a Q of 300 needs more than bfloat16's 8 bits.
    """
    x = torch.cat(list(inputs), -1)
    ensemble, (runs, batch, width) = flat.shape[0], x.shape
    h = x.expand(ensemble, runs, batch, width).reshape(ensemble * runs, batch, width)
    *hidden, last = layers_of(flat.reshape(ensemble * runs, -1), sizes, norm)
    for layer, scale in hidden:
        cast = layer.to(dtype or flat.dtype)
        h = torch.baddbmm(cast[:, -1:], h.to(cast.dtype), cast[:, :-1])
        if norm == "before":
            h = _normalize(h.to(flat.dtype), scale)
        h = h.relu() if activation == "relu" else h.tanh()
        if norm == "after":
            h = _normalize(h.to(flat.dtype), scale)
    layer, _ = last
    return torch.baddbmm(layer[:, -1:], h.to(layer.dtype), layer[:, :-1]).view(ensemble, runs, batch, -1)


def sequential_forward(
    flat: Tensor, inputs: Sequence[Tensor], sizes: Sequence[int], activation: str, norm: str, dtype: torch.dtype | None
) -> Tensor:
    """Return what `batched_forward` does, one MLP after the other: a run has the same bits alone and in a stack."""
    ensemble, runs = flat.shape[:2]
    outputs = [
        batched_forward(
            flat[member, run][None, None], [x[run : run + 1] for x in inputs], sizes, activation, norm, dtype
        )
        for member, run in itertools.product(range(ensemble), range(runs))
    ]
    return torch.cat(outputs).view(ensemble, runs, *outputs[0].shape[2:])


def _normalize(h: Tensor, scale: Tensor) -> Tensor:
    """Return LayerNorm of h [networks, batch, width] with gains and shifts [networks, 2, width]."""
    return layer_norm(h, h.shape[-1:]) * scale[:, :1] + scale[:, 1:]


def layers_of(flat: Tensor, sizes: Sequence[int], norm: str = "none") -> list[tuple[Tensor, Tensor]]:
    """Return views of `flat` [.., P]: each layer's weights and bias [.., in + 1, out], and its gain and shift.

    Gains and shifts are [.., 2, out]; [.., 0, out] for the last layer and where there is no LayerNorm.
    """
    layers, first = [], 0
    for number, (i, o) in enumerate(itertools.pairwise(sizes)):
        rows = 2 if norm != "none" and number < len(sizes) - 2 else 0
        matrix, end = flat[..., first : first + (i + 1) * o], first + (i + 1 + rows) * o
        scale = flat[..., first + (i + 1) * o : end]
        layers.append((matrix.view(*flat.shape[:-1], i + 1, o), scale.view(*flat.shape[:-1], rows, o)))
        first = end
    return layers
