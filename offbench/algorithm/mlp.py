"""The forward and backward pass of many equal perceptrons.

    flat [ensemble, runs, P] = W0 [in, h] | b0 [h] | W1 [h, h] | b1 [h] | ... | 0
    inputs [runs, batch, dim], concatenated to x [runs, batch, in]   ->   outputs [ensemble, runs, batch, out]

On a GPU a layer of all perceptrons is one batched product, and autograd computes the gradients (`stacked`).

On a CPU perceptrons are computed one after the other, so that their arrays stay in the cache, and the passes are
written out (`Pass`): buffers are kept between calls, NumPy (OpenBLAS) writes products into them, and unused gradients
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
from offbench.algorithm.stacked import layers_of, one_by_one, stacked
from offbench.common.errors import OffbenchError

_WAY = ContextVar("way", default="numpy")
NARROW = 64  # a product with fewer inputs or outputs gains nothing from bfloat16 on a CPU


def perceptrons(
    flat: Tensor,
    inputs: Sequence[Tensor],
    sizes: Sequence[int],
    activation: str,
    norm: str = "none",
    twice: bool = False,
) -> Tensor:
    """Return the outputs [ensemble, runs, batch, out] of perceptrons with layers of `sizes`.

    Args:
        flat: all weights and biases [ensemble, runs, P]; what lies behind the last bias has no effect.
        inputs: each [runs, batch, dim].
        activation: of the hidden layers, relu or tanh.
        norm: LayerNorm of the hidden layers: none, before or after the activation. `flat` then has a gain and a shift
            behind each hidden layer's bias.
        twice: whether the outputs must be differentiable twice. The passes written out for a CPU are differentiable
            once; these networks, and those with LayerNorm, are PyTorch's own operations, which cost more.
    """
    way = _WAY.get()
    half = way == "bfloat16"
    if flat.device.type != "cpu" or flat.dtype != torch.float32 or way == "pytorch":
        return stacked(flat, inputs, sizes, activation, norm, torch.bfloat16 if half else None)
    if norm != "none" or twice:
        return one_by_one(flat, inputs, sizes, activation, norm, torch.bfloat16 if half else None)
    outputs: Tensor = _Perceptrons.apply(flat, tuple(sizes), activation, half, *inputs)  # type: ignore[no-untyped-call]
    return outputs


@contextmanager
def products_by(way: str) -> Iterator[None]:
    """Choose how `perceptrons` multiplies.

    Args:
        way: `numpy` on a CPU, the default; `pytorch`, whose tools do not see NumPy's products; or `bfloat16`.
    """
    token = _WAY.set(way)
    try:
        yield
    finally:
        _WAY.reset(token)


class _Perceptrons(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, sizes: tuple[int, ...], activation: str, half: bool, *inputs: Tensor
    ) -> Tensor:
        keep = any(ctx.needs_input_grad)
        with one_call() as recording:
            ctx.made = made = Pass(flat, inputs, sizes, activation, keep, half)
            made.run()
        if recording:
            recording.add(("forward", sizes, activation, keep, half), (flat, inputs), made.outputs, made.run)
        ctx.save_for_backward(flat)  # autograd sees if it was changed since
        return made.outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: this pass would count as a constant
            raise OffbenchError("a gradient of a gradient needs a network made with twice_differentiable=True")
        (flat,) = ctx.saved_tensors
        needs = ctx.needs_input_grad[0], ctx.needs_input_grad[4:]
        with one_call() as recording:
            back = PassBack(ctx.made, flat, grads[0], *needs)
            back.run()
        gradients = (back.of_flat, *back.of_inputs)
        if recording:
            reads, writes = (ctx.made.outputs, grads[0]), [gradient for gradient in gradients if gradient is not None]
            recording.add(("backward", needs), reads, writes, back.run)
        return gradients[0], None, None, None, *gradients[1:]


class Pass:
    """A forward pass on the CPU, with buffers of its own.

    Args:
        keep: whether a backward pass may follow, so that the layers' activations must not be overwritten.
        half: whether wide products are in bfloat16.
    """

    def __init__(
        self,
        flat: Tensor,
        inputs: Sequence[Tensor],
        sizes: Sequence[int],
        activation: str,
        keep: bool,
        half: bool = False,
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
        # what goes into each layer, [batch, in + 1], of each perceptron
        self.into: dict[tuple[int, int], list[Array]] = {}
        self.bfloat16_layers: dict[tuple[int, int, int], Bfloat16Layer] = {}  # of each perceptron
        outputs = _array(self.outputs)
        for member, run in itertools.product(range(ensemble), range(runs)):
            h, self.into[member, run] = x[run], [x[run]]
            for layer, width in enumerate(sizes[1:-1]):
                make = rows_with_ones if keep else shared(f"layer {layer}", rows_with_ones)
                into = make(batch, width)
                weight = self.layers[layer][member, run]
                if half and min(sizes[layer], width) >= NARROW:
                    product = self.bfloat16_layers[member, run, layer] = Bfloat16Layer(h, weight, into[:, :-1], keep)
                    self.calls.append(product.forward)
                else:
                    self.calls.append(partial(np.matmul, h, weight, into[:, :-1]))
                hidden = torch.from_numpy(into[:, :-1])
                self.calls.append(hidden.relu_ if activation == "relu" else hidden.tanh_)
                h = into
                self.into[member, run].append(into)
            self.calls.append(partial(np.matmul, h, self.layers[-1][member, run], outputs[member, run]))

    def run(self) -> None:
        """Compute `outputs`."""
        for call in self.calls:
            call()


class PassBack:
    """The backward pass of a forward pass.

    Attributes:
        of_flat, of_inputs: the gradients; None where not needed.
    """

    def __init__(
        self, forward: Pass, flat: Tensor, grad: Tensor, needs_flat: bool, needs_inputs: Sequence[bool]
    ) -> None:
        ensemble, runs, batch = forward.shape
        sizes, widths = forward.sizes, forward.widths
        self.of_flat = torch.zeros_like(flat) if needs_flat else None
        of_layers = None
        if self.of_flat is not None:
            of_layers = [_array(layer) for layer, _ in layers_of(self.of_flat, sizes)]
        self.of_inputs = [
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
                h, weight = forward.into[member, run][layer], forward.layers[layer][member, run][:-1]
                half = forward.bfloat16_layers.get((member, run, layer))
                if half is not None:
                    self.calls.append(partial(half.load, torch.from_numpy(g)))
                if of_layers is not None:
                    of_layer = of_layers[layer][member, run]
                    if half is None:
                        self.calls.append(partial(np.matmul, h.T, g, of_layer))
                    else:
                        self.calls.append(partial(half.of_weight, torch.from_numpy(of_layer)))
                if layer:
                    before = shared(f"gradient {layer % 2}", rows)(batch, sizes[layer])
                    if half is None:
                        self._product(g, weight.T, before)
                    else:
                        self.calls.append(partial(half.of_h, torch.from_numpy(before)))
                    self.calls.append(_through(forward.activation, before, h[:, :-1]))
                    g = before
                    continue
                start = 0
                for width, gradient in zip(widths, self.of_inputs, strict=True):
                    if gradient is not None:
                        part, of_input = weight[start : start + width].T, _array(gradient)[run]
                        if member == 0:
                            self._product(g, part, of_input)
                        else:
                            other = shared("gradient of an input", rows)(batch, width)
                            self._product(g, part, other)
                            self.calls.append(partial(np.add, of_input, other, of_input))
                    start += width

    def _product(self, a: Array, b: Array, out: Array) -> None:
        """Add the call of a @ b; NumPy is slow at outer products, those of a layer with one output."""
        if a.shape[1] == 1:
            self.calls.append(partial(torch.mul, torch.from_numpy(a), torch.from_numpy(b), out=torch.from_numpy(out)))
        else:
            self.calls.append(partial(np.matmul, a, b, out))

    def run(self) -> None:
        """Compute `of_flat` and `of_inputs`."""
        for call in self.calls:
            call()


def _through(activation: str, gradient: Array, h: Array) -> Call:
    """Return the call that turns the gradient of an activation's output h into that of its input, in place."""
    g, output = torch.from_numpy(gradient), torch.from_numpy(h)
    if activation == "relu":
        return partial(torch.ops.aten.threshold_backward.grad_input, g, output, 0, grad_input=g)
    return partial(torch.ops.aten.tanh_backward.grad_input, g, output, grad_input=g)


def _array(tensor: Tensor) -> Array:
    """Return a NumPy array that shares a tensor's memory."""
    array: Array = tensor.detach().numpy()
    return array
