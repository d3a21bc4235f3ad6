"""The passes of MLPs, written out and as PyTorch does them: against autograd in float64."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from offbench.algorithm.mlp import matmul_backend, mlp_forward
from offbench.algorithm.stacked import batched_forward

ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh}
SHAPES = [((5, 7, 6, 2), 11), ((14, 128, 96, 1), 128), ((3, 4), 1)]  # the last has no hidden layer


def reference(flat: Tensor, inputs: Sequence[Tensor], sizes: Sequence[int], activation: str) -> Tensor:
    """One perceptron after the other, layer by layer, for autograd."""
    x = torch.cat(list(inputs), -1)
    outputs = []
    for networks in flat:
        for weights, h in zip(networks, x, strict=True):
            first = 0
            for layer, (i, o) in enumerate(itertools.pairwise(sizes)):
                weight, bias = weights[first : first + i * o].view(i, o), weights[first + i * o : first + i * o + o]
                h, first = h @ weight + bias, first + i * o + o
                if layer < len(sizes) - 2:
                    h = ACTIVATIONS[activation](h)
            outputs.append(h)
    return torch.stack(outputs).view(*flat.shape[:2], x.shape[1], -1)


def made(sizes: Sequence[int], batch: int, copies: int, runs: int) -> tuple[Tensor, list[Tensor], Tensor]:
    """Weights, two inputs and the gradient of the outputs, in float64."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator)

    count = sum(i * o + o for i, o in itertools.pairwise(sizes)) + 3
    inputs = [normal(runs, batch, sizes[0] - 2), normal(runs, batch, 2)]
    return 0.2 * normal(copies, runs, count), inputs, normal(copies, runs, batch, sizes[-1])


def single(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensor.detach().float().requires_grad_() for tensor in tensors]


@pytest.mark.parametrize("passes", [mlp_forward, batched_forward])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("copies", "runs"), [(1, 1), (2, 3)])
@pytest.mark.parametrize(("sizes", "batch"), SHAPES)
def test_outputs_and_gradients_are_autograds(
    sizes: Sequence[int], batch: int, copies: int, runs: int, activation: str, passes: Callable[..., Tensor]
) -> None:
    flat, inputs, grad = made(sizes, batch, copies, runs)
    parts = [flat, *inputs]
    for part in parts:
        part.requires_grad_()
    wanted = reference(flat, inputs, sizes, activation)
    wanted_grads = torch.autograd.grad(wanted, parts, grad)
    ours = single(parts)
    outputs = passes(ours[0], ours[1:], sizes, activation)
    grads = torch.autograd.grad(outputs, ours, grad.float())
    for one, other in zip((outputs, *grads), (wanted, *wanted_grads), strict=True):
        torch.testing.assert_close(one.double(), other, rtol=2e-5, atol=2e-5 * other.abs().max().item())


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_bfloat16_is_near_float32_with_wide_layers(activation: str) -> None:
    sizes, batch = SHAPES[1]
    flat, inputs, grad = made(sizes, batch, 2, 2)
    exact = single([flat, *inputs])
    wanted = mlp_forward(exact[0], exact[1:], sizes, activation)
    wanted_grads = torch.autograd.grad(wanted, exact, grad.float())
    ours = single([flat, *inputs])
    with matmul_backend("bfloat16"):
        outputs = mlp_forward(ours[0], ours[1:], sizes, activation)
        grads = torch.autograd.grad(outputs, ours, grad.float())
    for one, other in zip((outputs, *grads), (wanted, *wanted_grads), strict=True):
        distance = ((one - other).norm() / other.norm()).item()
        assert 1e-4 < distance < 0.1  # rounded to 8 bits, more than once


def test_bfloat16_without_gradients_has_the_same_bits_whatever_the_shapes() -> None:
    """Without a backward pass buffers are shared, and here the inputs of a layer and its weights have one shape."""
    sizes, batch = (14, 127, 128, 1), 128
    flat, inputs, _ = made(sizes, batch, 2, 2)
    ours = single([flat, *inputs])
    with matmul_backend("bfloat16"):
        wanted = mlp_forward(ours[0], ours[1:], sizes, "relu")
        found = mlp_forward(ours[0].detach(), [x.detach() for x in ours[1:]], sizes, "relu")
    assert torch.equal(found, wanted)


def test_bfloat16_leaves_narrow_layers_in_float32() -> None:
    sizes, batch = SHAPES[0]
    flat, inputs, _ = made(sizes, batch, 2, 2)
    one = mlp_forward(flat.float(), [x.float() for x in inputs], sizes, "relu")
    with matmul_backend("bfloat16"):
        other = mlp_forward(flat.float(), [x.float() for x in inputs], sizes, "relu")
    assert torch.equal(one, other)


@pytest.mark.parametrize("asked", [0, 1, 2])
def test_a_gradient_that_nobody_asks_for_changes_nothing(asked: int) -> None:
    sizes, batch = SHAPES[1]
    flat, inputs, grad = made(sizes, batch, 2, 2)
    every = single([flat, *inputs])
    wanted = torch.autograd.grad(mlp_forward(every[0], every[1:], sizes, "relu"), every, grad.float())[asked]
    alone = [tensor.detach().requires_grad_(place == asked) for place, tensor in enumerate(every)]
    (one,) = torch.autograd.grad(mlp_forward(alone[0], alone[1:], sizes, "relu"), [alone[asked]], grad.float())
    assert torch.equal(one, wanted)


def test_a_call_changes_none_of_its_inputs() -> None:
    sizes, batch = SHAPES[1]
    flat, inputs, grad = made(sizes, batch, 2, 2)
    parts, grad = single([flat, *inputs]), grad.float()
    kept = [part.detach().clone() for part in (*parts, grad)]
    torch.autograd.grad(mlp_forward(parts[0], parts[1:], sizes, "tanh"), parts, grad)
    assert all(torch.equal(one, other) for one, other in zip((*parts, grad), kept, strict=True))


def test_the_gradient_of_a_sum_which_is_one_number_expanded_is_right() -> None:
    sizes, batch = SHAPES[0]
    flat, inputs, _ = made(sizes, batch, 2, 2)
    parts = single([flat, *inputs])
    ours = torch.autograd.grad(mlp_forward(parts[0], parts[1:], sizes, "relu").sum(), parts)
    theirs = torch.autograd.grad(reference(parts[0], parts[1:], sizes, "relu").sum(), parts)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)


def test_two_ways_back_from_one_pass_do_not_disturb_each_other() -> None:
    sizes, batch = SHAPES[0]
    flat, inputs, grad = made(sizes, batch, 2, 2)
    parts, grad = single([flat, *inputs]), grad.float()
    outputs = mlp_forward(parts[0], parts[1:], sizes, "relu")
    first = torch.autograd.grad(outputs, parts, grad, retain_graph=True)
    kept = [one.clone() for one in first]
    second = torch.autograd.grad(outputs, parts, 2 * grad)
    assert all(torch.equal(one, other) for one, other in zip(first, kept, strict=True))
    assert all(torch.equal(2 * one, other) for one, other in zip(first, second, strict=True))


def test_weights_that_changed_before_the_way_back_are_noticed() -> None:
    sizes, batch = SHAPES[0]
    flat, inputs, _ = made(sizes, batch, 1, 1)
    weights = flat.float().requires_grad_()
    outputs = mlp_forward(weights, [x.float() for x in inputs], sizes, "relu")
    with torch.no_grad():
        weights.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.grad(outputs.sum(), weights)


def test_one_of_many_is_the_same_as_alone() -> None:
    """On a CPU to the bit: every perceptron has products of its own."""
    sizes, batch = SHAPES[1]
    flat, inputs, _ = made(sizes, batch, 2, 3)
    together = mlp_forward(flat.float(), [x.float() for x in inputs], sizes, "relu")
    for run in range(3):
        own = slice(run, run + 1)
        alone = mlp_forward(flat[:, own].float(), [x[own].float() for x in inputs], sizes, "relu")
        assert torch.equal(together[:, own], alone)


def test_pytorch_sees_all_products_where_it_is_asked_to() -> None:
    from torch.utils.flop_counter import FlopCounterMode

    sizes, batch = SHAPES[1]
    flat, inputs, _ = made(sizes, batch, 1, 1)
    with matmul_backend("pytorch"), FlopCounterMode(display=False) as counter:
        mlp_forward(flat.float(), [x.float() for x in inputs], sizes, "relu")
    assert counter.get_total_flops() == 2 * batch * (14 * 128 + 128 * 96 + 96 * 1)
