"""A layer in bfloat16 on a CPU, faster than in float32 where the processor has instructions for it (AVX-512, AMX)."""

from __future__ import annotations

import torch
from torch import Tensor

from offbench.algorithm.buffers import Array, shared


class Bfloat16Layer:
    """The product h @ [W; b] of one layer in bfloat16, and its gradients: factors and results are rounded.

    Args:
        h: [batch, in + 1], its last column ones.
        weight: [in + 1, out].
        out: [batch, out].
        keep: whether a backward pass may follow.
    """

    def __init__(self, h: Array, weight: Array, out: Array, keep: bool) -> None:
        self._h, self._weight, self._out = map(torch.from_numpy, (h, weight, out))
        batch, (rows, columns) = len(h), weight.shape
        self._half_h = (_halves if keep else shared("inputs", _halves))(batch, rows)
        self._half_weight = (_halves if keep else shared("weights", _halves))(rows, columns)
        self._half_out = shared("product", _halves)(batch, columns)
        if keep:
            self._half_gradient = shared("gradient", _halves)(batch, columns)
            self._half_of_weight = shared("product", _halves)(rows, columns)
            self._half_of_h = shared("product", _halves)(batch, rows - 1)

    def forward(self) -> None:
        """Compute `out`."""
        self._half_h.copy_(self._h)
        self._half_weight.copy_(self._weight)
        torch.mm(self._half_h, self._half_weight, out=self._half_out)
        self._out.copy_(self._half_out)

    def load(self, gradient: Tensor) -> None:
        """Take the gradient of `out`, [batch, out], of which the other gradients follow."""
        self._half_gradient.copy_(gradient)

    def of_weight(self, out: Tensor) -> None:
        """Compute the gradient of `weight`."""
        torch.mm(self._half_h.T, self._half_gradient, out=self._half_of_weight)
        out.copy_(self._half_of_weight)

    def of_h(self, out: Tensor) -> None:
        """Compute the gradient of `h` without its ones, [batch, in]."""
        torch.mm(self._half_gradient, self._half_weight[:-1].T, out=self._half_of_h)
        out.copy_(self._half_of_h)


def _halves(rows: int, columns: int) -> Tensor:
    return torch.empty(rows, columns, dtype=torch.bfloat16)
