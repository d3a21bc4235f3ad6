"""The matrix products of one update of each algorithm, counted by hand from its equations.

A product (copies, m, k, n) is `copies` times [m, k] @ [k, n]. For a layer i -> o and a batch B,
    forward    [B, i] @ [i, o]
    backward   weights  [i, B] @ [B, o]     inputs  [B, o] @ [o, i]  (not for the first layer, unless a gradient
                                                                      with respect to the network's inputs is asked)
What these alone take, back to back on preallocated arrays, is the bound that an update is measured against.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

Product = tuple[int, int, int, int]


def forward(sizes: tuple[int, ...], batch: int, copies: int = 1) -> Iterator[Product]:
    """Products of the outputs."""
    for i, o in itertools.pairwise(sizes):
        yield copies, batch, i, o


def weights(sizes: tuple[int, ...], batch: int, copies: int = 1) -> Iterator[Product]:
    """Products of the gradient with respect to the weights, the error of the hidden layers among them."""
    for layer, (i, o) in enumerate(itertools.pairwise(sizes)):
        yield copies, i, batch, o
        if layer:
            yield copies, batch, o, i


def inputs(sizes: tuple[int, ...], batch: int, copies: int = 1) -> Iterator[Product]:
    """Products of the gradient with respect to the inputs alone, weights fixed."""
    for i, o in itertools.pairwise(sizes):
        yield copies, batch, o, i


def td3_bc(obs: int, act: int, batch: int, hidden: tuple[int, ...]) -> Iterator[tuple[float, Product]]:
    """Yield (how often an update, product)."""
    actor, critic = (obs, *hidden, act), (obs + act, *hidden, 1)
    every = [*forward(actor, batch), *forward(critic, batch, 2)]  # the targets
    every += [*forward(critic, batch, 2), *weights(critic, batch, 2)]
    second = [*forward(actor, batch), *forward(critic, batch), *inputs(critic, batch), *weights(actor, batch)]
    yield from ((1.0, product) for product in every)
    yield from ((0.5, product) for product in second)


def bdb(obs: int, act: int, batch: int, hidden: tuple[int, ...]) -> Iterator[tuple[float, Product]]:
    """TD3+BC, whose pi(s) and Q1 serve here too; every second update the discriminator, its gradient, and Q2."""
    yield from td3_bc(obs, act, batch, hidden)
    critic, judge = (obs + act, *hidden, 1), (obs + act, 64, 64, 1)
    second = [*forward(judge, 2 * batch), *weights(judge, 2 * batch)]
    second += [*forward(judge, batch), *inputs(judge, batch), *forward(critic, batch)]  # Q2, for max - min
    yield from ((0.5, product) for product in second)


def cql(obs: int, act: int, batch: int, hidden: tuple[int, ...], actions: int = 10) -> Iterator[tuple[float, Product]]:
    """SAC's update, and the critics at 3 x `actions` actions of every observation, forward and backward."""
    actor, critic = (obs, *hidden, 2 * act), (obs + act, *hidden, 1)
    wide = 3 * actions * batch
    every = [*forward(actor, batch), *forward(critic, batch, 2)]  # the target
    every += [*forward(critic, batch, 2), *weights(critic, batch, 2)]
    every += [*forward(actor, batch), *forward(actor, batch)]  # pi(s), pi(s')
    every += [*forward(critic, wide, 2), *weights(critic, wide, 2)]
    every += [*forward(actor, batch), *forward(critic, batch, 2), *inputs(critic, batch, 2), *weights(actor, batch)]
    yield from ((1.0, product) for product in every)


ALGORITHMS = {"td3_bc": td3_bc, "bdb": bdb, "cql": cql}
