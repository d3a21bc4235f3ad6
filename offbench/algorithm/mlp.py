"""The forward and backward pass of many MLPs of the same shape.

    flat [ensemble, runs, P] = W0 [in, h] | b0 [h] | W1 [h, h] | b1 [h] | ... | 0
    inputs [runs, batch, dim], concatenated to x [runs, batch, in]   ->   outputs [ensemble, runs, batch, out]

On a GPU, one batched matrix product computes a layer of all MLPs, and autograd the gradients (`batched_forward`).

On a CPU, the MLPs are computed one after the other, so that their arrays stay in the cache, and the passes are written
out (`ForwardPass`): buffers are kept between calls, NumPy (OpenBLAS) writes products into them, and unused gradients
are not computed. A layer's weights and bias are adjacent in memory, so they are one matrix, and the inputs of each
layer have a last column of ones:

    [h | 1] [batch, in + 1]  @  [W; b] [in + 1, out]          one product gives h W + b,
    [h | 1].T @ gradient                                      and one the gradients of W and b

In bfloat16 the wide layers (`Bfloat16Layer`) round their factors and products; everything else stays in float32.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbench.algorithm.bfloat16_layer import Bfloat16Layer
from offbench.algorithm.buffers import Array, rows, rows_with_ones, shared
from offbench.algorithm.cpu_capture import Call, one_call
from offbench.algorithm.stacked import batched_forward, layers_of, sequential_forward
from offbench.common.errors import OffbenchError

_BACKEND = ContextVar("backend", default="numpy")
NARROW = 64  # a product with fewer inputs or outputs gains nothing from bfloat16 on a CPU


def mlp_forward(
    flat: Tensor,
    inputs: Sequence[Tensor],
    sizes: Sequence[int],
    activation: str,
    norm: str = "none",
    twice_differentiable: bool = False,
) -> Tensor:
    """Return the outputs [ensemble, runs, batch, out] of MLPs with layers of `sizes`.

    Args:
        flat: all weights and biases [ensemble, runs, P]; values after the last bias have no effect.
        inputs: each [runs, batch, dim].
        activation: activation of the hidden layers, relu or tanh.
        norm: LayerNorm of the hidden layers: none, before or after the activation. `flat` then has a gain and a shift
            after each hidden layer's bias.
        twice_differentiable: whether the outputs must be differentiable twice. The passes written out for a CPU are
            differentiable once; such networks, and those with LayerNorm, use PyTorch's operations, which are slower.
    """
    backend = _BACKEND.get()
    bf16 = backend == "bfloat16"
    if flat.device.type != "cpu" or flat.dtype != torch.float32 or backend == "pytorch":
        return batched_forward(flat, inputs, sizes, activation, norm, torch.bfloat16 if bf16 else None)
    if norm != "none" or twice_differentiable:
        return sequential_forward(flat, inputs, sizes, activation, norm, torch.bfloat16 if bf16 else None)
    outputs: Tensor = _MLPs.apply(flat, tuple(sizes), activation, bf16, *inputs)  # type: ignore[no-untyped-call]
    return outputs


@contextmanager
def matmul_backend(backend: str) -> Iterator[None]:
    """Choose what computes the matrix products of `mlp_forward`.

    Args:
        backend: `numpy` on a CPU, the default; `pytorch`, for tools of PyTorch that do not see NumPy's products; or
            `bfloat16`.
    """
    token = _BACKEND.set(backend)
    try:
        yield
    finally:
        _BACKEND.reset(token)


class _MLPs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, sizes: tuple[int, ...], activation: str, bf16: bool, *inputs: Tensor
    ) -> Tensor:
        keep = any(ctx.needs_input_grad)
        with one_call() as trace:
            ctx.forward_pass = forward = ForwardPass(flat, inputs, sizes, activation, keep, bf16)
            forward.run()
        if trace:
            trace.add(("forward", sizes, activation, keep, bf16), (flat, inputs), forward.outputs, forward.run)
        ctx.save_for_backward(flat)  # so that autograd raises if it is changed before the backward pass
        return forward.outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: this pass would count as a constant
            raise OffbenchError("a gradient of a gradient needs a network made with twice_differentiable=True")
        (flat,) = ctx.saved_tensors
        needs = ctx.needs_input_grad[0], ctx.needs_input_grad[4:]
        with one_call() as trace:
            backward = BackwardPass(ctx.forward_pass, flat, grads[0], *needs)
            backward.run()
        gradients = (backward.grad_flat, *backward.grad_inputs)
        if trace:
            writes = [gradient for gradient in gradients if gradient is not None]
            trace.add(("backward", needs), (ctx.forward_pass.outputs, grads[0]), writes, backward.run)
        return gradients[0], None, None, None, *gradients[1:]


class ForwardPass:
    """A forward pass on the CPU, with buffers of its own.

    Args:
        keep: whether a backward pass may follow, so that the layers' activations must not be overwritten.
        bf16: whether wide products are in bfloat16.
    """

    def __init__(
        self,
        flat: Tensor,
        inputs: Sequence[Tensor],
        sizes: Sequence[int],
        activation: str,
        keep: bool,
        bf16: bool = False,
    ) -> None:
        self.sizes, self.activation = sizes, activation
        self.shape = (flat.shape[0], *inputs[0].shape[:2])  # ensemble, runs, batch
        ensemble, runs, batch = self.shape
        self.widths = [x.shape[-1] for x in inputs]
        self.outputs = torch.empty(*self.shape, sizes[-1])
        x = [rows_with_ones(batch, sizes[0]) for _ in range(runs)]
        starts = [0, *itertools.accumulate(self.widths)]
        self.calls: list[Call] = [
            partial(np.copyto, x[run][:, start:end], part[run])
            for start, end, part in zip(starts, starts[1:], (_array(part) for part in inputs), strict=False)
            for run in range(runs)
        ]
        self.layers = [_array(layer) for layer, _ in layers_of(flat, sizes)]  # each [ensemble, runs, in + 1, out]
        self.layer_inputs: dict[tuple[int, int], list[Array]] = {}  # by (member, run): each [batch, in + 1]
        self.bfloat16_layers: dict[tuple[int, int, int], Bfloat16Layer] = {}  # by (member, run, layer)
        outputs = _array(self.outputs)
        for member, run in itertools.product(range(ensemble), range(runs)):
            h, self.layer_inputs[member, run] = x[run], [x[run]]
            for layer, width in enumerate(sizes[1:-1]):
                if keep:
                    layer_output = rows_with_ones(batch, width)
                else:
                    layer_output = shared(f"layer {layer}", rows_with_ones, batch, width)
                weight = self.layers[layer][member, run]
                if bf16 and min(sizes[layer], width) >= NARROW:
                    bf16_layer = Bfloat16Layer(h, weight, layer_output[:, :-1], keep)
                    self.bfloat16_layers[member, run, layer] = bf16_layer
                    self.calls.append(bf16_layer.forward)
                else:
                    self.calls.append(partial(np.matmul, h, weight, layer_output[:, :-1]))
                hidden = torch.from_numpy(layer_output[:, :-1])
                self.calls.append(hidden.relu_ if activation == "relu" else hidden.tanh_)
                h = layer_output
                self.layer_inputs[member, run].append(layer_output)
            self.calls.append(partial(np.matmul, h, self.layers[-1][member, run], outputs[member, run]))

    def run(self) -> None:
        """Compute `outputs`."""
        for call in self.calls:
            call()


class BackwardPass:
    """The backward pass of a forward pass.

    Attributes:
        grad_flat, grad_inputs: the gradients; None where not needed.
    """

    def __init__(
        self, forward: ForwardPass, flat: Tensor, grad: Tensor, needs_flat: bool, needs_inputs: Sequence[bool]
    ) -> None:
        ensemble, runs, batch = forward.shape
        sizes, widths = forward.sizes, forward.widths
        self.grad_flat = torch.zeros_like(flat) if needs_flat else None
        grad_layers = None
        if self.grad_flat is not None:
            grad_layers = [_array(layer) for layer, _ in layers_of(self.grad_flat, sizes)]
        self.grad_inputs = [
            torch.empty(runs, batch, width) if needed else None
            for width, needed in zip(widths, needs_inputs, strict=True)
        ]
        self.calls: list[Call] = []
        last = _array(grad)
        if not grad.is_contiguous():
            last = np.empty(grad.shape, np.float32)
            self.calls.append(partial(np.copyto, last, _array(grad)))
        for member, run in itertools.product(range(ensemble), range(runs)):
            g = last[member, run]
            for layer in reversed(range(len(sizes) - 1)):
                h, weight = forward.layer_inputs[member, run][layer], forward.layers[layer][member, run][:-1]
                bf16_layer = forward.bfloat16_layers.get((member, run, layer))
                if bf16_layer is not None:
                    self.calls.append(partial(bf16_layer.load, torch.from_numpy(g)))
                if grad_layers is not None:
                    grad_layer = grad_layers[layer][member, run]
                    if bf16_layer is None:
                        self.calls.append(partial(np.matmul, h.T, g, grad_layer))
                    else:
                        self.calls.append(partial(bf16_layer.grad_weight, torch.from_numpy(grad_layer)))
                if layer:
                    before = shared(f"gradient {layer % 2}", rows, batch, sizes[layer])
                    if bf16_layer is None:
                        self._product(g, weight.T, before)
                    else:
                        self.calls.append(partial(bf16_layer.grad_h, torch.from_numpy(before)))
                    self.calls.append(_activation_backward(forward.activation, before, h[:, :-1]))
                    g = before
                    continue
                start = 0
                for width, gradient in zip(widths, self.grad_inputs, strict=True):
                    if gradient is not None:
                        part, grad_input = weight[start : start + width].T, _array(gradient)[run]
                        if member == 0:
                            self._product(g, part, grad_input)
                        else:
                            other = shared("gradient of an input", rows, batch, width)
                            self._product(g, part, other)
                            self.calls.append(partial(np.add, grad_input, other, grad_input))
                    start += width

    def _product(self, a: Array, b: Array, out: Array) -> None:
        """Add the call of a @ b; NumPy is slow at outer products, those of a layer with one output."""
        if a.shape[1] == 1:
            self.calls.append(partial(torch.mul, torch.from_numpy(a), torch.from_numpy(b), out=torch.from_numpy(out)))
        else:
            self.calls.append(partial(np.matmul, a, b, out))

    def run(self) -> None:
        """Compute `grad_flat` and `grad_inputs`."""
        for call in self.calls:
            call()


def _activation_backward(activation: str, gradient: Array, h: Array) -> Call:
    """Return the call that turns the gradient of an activation's output h into that of its input, in place."""
    g, output = torch.from_numpy(gradient), torch.from_numpy(h)
    if activation == "relu":
        return partial(torch.ops.aten.threshold_backward.grad_input, g, output, 0, grad_input=g)
    return partial(torch.ops.aten.tanh_backward.grad_input, g, output, grad_input=g)


def _array(tensor: Tensor) -> Array:
    """Return a NumPy array that shares a tensor's memory."""
    array: Array = tensor.detach().numpy()
    return array
