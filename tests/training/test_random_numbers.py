"""Distributions of a run's random numbers, by the tests of scipy.stats: batches, noise and initial weights.

The seeds are fixed, so that the p-values are always the same.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scipy import stats

from offbench.algorithm import Network, NoiseSpec, normal, uniform
from offbench.training.batches import CHUNK, draw_chunk

RUNS, BATCH = [3, 4], 1000  # seeds of two runs, and CHUNK * BATCH = 1e5 draws of each


def draw(size: int = 50, noise: NoiseSpec | None = None, chunk: int = 0) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return a chunk's indices [runs, draws] and noise {name: [runs, draws]}."""
    indices, found = draw_chunk(RUNS, [size] * 2, BATCH, noise or {}, chunk, torch.device("cpu"))
    assert indices.shape == (CHUNK, 2, BATCH)
    return by_run(indices), {name: by_run(values) for name, values in found.items()}


def by_run(values: torch.Tensor) -> np.ndarray:
    """Return values [CHUNK, runs, batch] as [runs, draws]."""
    return values.transpose(0, 1).reshape(2, -1).numpy()


@pytest.mark.parametrize("size", [7, 50, 1000])
def test_every_transition_is_equally_likely_in_a_batch(size: int) -> None:
    """The counts differ by as much as chance lets them: not more, and not less, as in shuffled epochs."""
    for indices in draw(size)[0]:
        counts = np.bincount(indices, minlength=size)
        assert len(counts) == size
        assert 1e-3 < stats.chisquare(counts).pvalue < 0.999


def test_the_transitions_of_a_batch_are_drawn_independently() -> None:
    """Each pair of one draw and the next, 1e5 of them, is equally likely: draws are with replacement."""
    for indices in draw(10)[0]:
        pairs = np.bincount(10 * indices[:-1] + indices[1:], minlength=100)
        assert 1e-3 < stats.chisquare(pairs).pvalue < 0.999


def test_runs_and_chunks_draw_independent_batches() -> None:
    (first, second), (later, _) = draw()[0], draw(chunk=1)[0]
    for a, b in ((first, second), (first, later), (second, later)):
        assert stats.pearsonr(a, b).pvalue > 1e-3
        assert stats.binomtest(int((a == b).sum()), len(a), 1 / 50).pvalue > 1e-3


def test_noise_has_the_distribution_of_its_name() -> None:
    _, noise = draw(noise={"normal": normal(BATCH), "uniform": uniform(BATCH)})
    for distribution, values in ((stats.norm(), noise["normal"]), (stats.uniform(-1, 2), noise["uniform"])):
        assert all(stats.kstest(run, distribution.cdf).pvalue > 1e-3 for run in values)
        assert stats.pearsonr(*values).pvalue > 1e-3


def network(index: int = 0) -> Network:
    return Network(17, (64, 256), None, RUNS, index, learning_rate=1e-3, ensemble_size=2)


def test_initial_weights_are_uniform_within_one_over_the_root_of_the_inputs() -> None:
    made = network()
    for weights in made.flat.detach().reshape(4, -1).double().numpy():  # of two members and two runs
        start = 0
        for inputs, outputs in itertools.pairwise(made.sizes):
            bound = 1 / math.sqrt(inputs)
            for count in (inputs * outputs, outputs):  # weights, then biases
                part, start = weights[start : start + count], start + count
                assert np.abs(part).max() <= bound
                assert stats.kstest(part, stats.uniform(-bound, 2 * bound).cdf).pvalue > 1e-3
        assert not weights[start:].any()  # there for alignment alone


def test_initial_weights_of_members_runs_and_networks_are_independent() -> None:
    parts = [part for made in (network(0), network(1)) for part in made.flat.detach().reshape(4, -1).numpy()]
    for a, b in itertools.combinations(parts, 2):
        count = 17 * 64  # weights of the first layer, all of the same distribution
        assert stats.pearsonr(a[:count], b[:count]).pvalue > 1e-3
