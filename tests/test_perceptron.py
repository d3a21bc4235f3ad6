"""The written-out passes of perceptrons: against autograd in float64, on both kinds of matrix products."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from offbench import perceptron
from offbench.perceptron import perceptrons

ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh}
SMALL, LARGE = ((5, 7, 6, 2), 11), ((14, 128, 96, 1), 128)  # the large one's middle layer is oneDNN's, with AVX-512
FEW = ((14, 128, 8), 128)  # without AVX-512 oneDNN does its last layer, which has few columns


def reference(flat: Tensor, x: Tensor, sizes: Sequence[int], activation: str) -> Tensor:
    """One perceptron after the other, layer by layer, for autograd."""
    outputs = []
    for own, h in zip(flat, x, strict=True):
        place = 0
        for layer, (i, o) in enumerate(itertools.pairwise(sizes)):
            weight, bias = own[place : place + i * o].view(i, o), own[place + i * o : place + i * o + o]
            h, place = h @ weight + bias, place + i * o + o
            if layer < len(sizes) - 2:
                h = ACTIVATIONS[activation](h)
        outputs.append(h)
    return torch.stack(outputs)


def made(sizes: Sequence[int], batch: int, nets: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights, inputs and the gradient of the outputs, in float64."""
    torch.manual_seed(0)
    count = sum(i * o + o for i, o in itertools.pairwise(sizes))
    return (
        0.2 * torch.randn(nets, count, dtype=torch.float64),
        torch.randn(nets, batch, sizes[0], dtype=torch.float64),
        torch.randn(nets, batch, sizes[-1], dtype=torch.float64),
    )


@pytest.mark.parametrize(
    "way", ["as on a GPU", "one by one", "in blocks", "one by one with AVX-512", "one by one with AVX2"]
)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("nets", [1, 3])
@pytest.mark.parametrize(("sizes", "batch"), [SMALL, LARGE, FEW])
def test_outputs_and_gradients_are_autograds(
    sizes: Sequence[int], batch: int, nets: int, activation: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perceptron, "HAS_ONEDNN", perceptron.HAS_ONEDNN and "AVX" in way)
    monkeypatch.setattr(perceptron, "WIDE", way.endswith("AVX-512"))
    monkeypatch.setattr(perceptron, "_batched", lambda _: way == "as on a GPU")
    if way == "in blocks":
        monkeypatch.setattr(perceptron, "BLOCK_ROWS", batch // 2 - 1)  # two and a bit
        monkeypatch.setattr(perceptron, "BLOCK", 0)
    flat, x, grad = (part.requires_grad_() for part in made(sizes, batch, nets))
    wanted = reference(flat, x, sizes, activation)
    wanted_grads = torch.autograd.grad(wanted, [flat, x], grad)
    ours, inputs = flat.detach().float().requires_grad_(), x.detach().float().requires_grad_()
    found = perceptrons(ours, inputs, sizes, activation)
    grads = torch.autograd.grad(found, [ours, inputs], grad.detach().float())
    for one, other in zip((found, *grads), (wanted, *wanted_grads), strict=True):
        torch.testing.assert_close(one.double(), other, rtol=2e-5, atol=2e-5 * other.abs().max().item())


@pytest.mark.parametrize(("of_flat", "of_x"), [(True, False), (False, True)])
def test_a_gradient_that_nobody_asks_for_changes_nothing(of_flat: bool, of_x: bool) -> None:
    flat, x, grad = (part.float() for part in made(*LARGE, 2))
    both = [flat.clone().requires_grad_(), x.clone().requires_grad_()]
    wanted = torch.autograd.grad(perceptrons(*both, LARGE[0], "relu"), both, grad)[of_x]
    alone = [flat.clone().requires_grad_(of_flat), x.clone().requires_grad_(of_x)]
    (found,) = torch.autograd.grad(perceptrons(*alone, LARGE[0], "relu"), [alone[of_x]], grad)
    assert torch.equal(found, wanted)


def test_a_call_changes_none_of_its_inputs() -> None:
    flat, x, grad = (part.float() for part in made(*LARGE, 2))
    kept = [part.clone() for part in (flat, x, grad)]
    inputs = [flat.requires_grad_(), x.requires_grad_()]
    torch.autograd.grad(perceptrons(*inputs, LARGE[0], "tanh"), inputs, grad)
    assert all(torch.equal(one, other) for one, other in zip((flat, x, grad), kept, strict=True))


def test_one_of_many_is_the_same_as_alone() -> None:
    """On a CPU to the bit: every perceptron has products of its own."""
    flat, x, _ = (part.float() for part in made(*LARGE, 3))
    together = perceptrons(flat, x, LARGE[0], "relu")
    for place in range(3):
        alone = perceptrons(flat[place : place + 1], x[place : place + 1], LARGE[0], "relu")
        assert torch.equal(together[place : place + 1], alone)


@pytest.mark.parametrize(
    ("wide", "wanted"), [(True, [True, True, False, True, False]), (False, [False, True, False, False, False])]
)
def test_the_library_follows_from_processor_and_shape(
    wide: bool, wanted: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large, few columns, a single column; never from the clock, or a run would not be the same twice.

    And gradients of weights, a large and a small one, whose first factor is turned round: oneDNN would copy it.
    """
    monkeypatch.setattr(perceptron, "HAS_ONEDNN", True)
    monkeypatch.setattr(perceptron, "WIDE", wide)
    shapes = [((256, 256), (256, 256)), ((256, 256), (256, 3)), ((256, 256), (256, 1))]
    pairs = [(torch.zeros(a), torch.zeros(b)) for a, b in shapes]
    pairs += [(torch.zeros(256, i).mT, torch.zeros(256, 256)) for i in (256, 14)]
    assert [perceptron._onednn(a, b) for a, b in pairs] == wanted
