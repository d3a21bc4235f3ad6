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
        if keep:
            self._bf16_h, self._bf16_weight = _bf16_buffer(batch, rows), _bf16_buffer(rows, columns)
            self._bf16_grad = shared("gradient", _bf16_buffer, batch, columns)
            self._bf16_grad_weight = shared("product", _bf16_buffer, rows, columns)
            self._bf16_grad_h = shared("product", _bf16_buffer, batch, rows - 1)
        else:
            self._bf16_h = shared("inputs", _bf16_buffer, batch, rows)
            self._bf16_weight = shared("weights", _bf16_buffer, rows, columns)
        self._bf16_out = shared("product", _bf16_buffer, batch, columns)

    def forward(self) -> None:
        """Compute `out`."""
        self._bf16_h.copy_(self._h)
        self._bf16_weight.copy_(self._weight)
        torch.mm(self._bf16_h, self._bf16_weight, out=self._bf16_out)
        self._out.copy_(self._bf16_out)

    def load(self, gradient: Tensor) -> None:
        """Set the gradient of `out`, [batch, out], from which the other gradients are computed."""
        self._bf16_grad.copy_(gradient)

    def grad_weight(self, out: Tensor) -> None:
        """Compute the gradient of `weight`."""
        torch.mm(self._bf16_h.T, self._bf16_grad, out=self._bf16_grad_weight)
        out.copy_(self._bf16_grad_weight)

    def grad_h(self, out: Tensor) -> None:
        """Compute the gradient of `h` without its ones, [batch, in]."""
        torch.mm(self._bf16_grad, self._bf16_weight[:-1].T, out=self._bf16_grad_h)
        out.copy_(self._bf16_grad_h)


def _bf16_buffer(rows: int, columns: int) -> Tensor:
    return torch.empty(rows, columns, dtype=torch.bfloat16)
