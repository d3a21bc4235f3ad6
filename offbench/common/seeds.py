"""Every random number of offbench: SeedSequence([seed, purpose, *index]), never a global generator.

The purpose of a number is part of its seed, so episode i of a dataset depends on (seed, i) alone and is the same for
any number of workers and after any resume.
"""

from __future__ import annotations

import operator
from enum import IntEnum

import numpy as np

from offbench.common.errors import OffbenchError
from offbench.common.text import MAX_INT


class Purpose(IntEnum):
    """What random numbers are drawn for. Never renumber: recorded datasets depend on it.

    RUNG, MEASURE, REFERENCE and EVALUATION are only used as the first number of a stream: episode i of a stream is
    reset with the seed [seed, RESET, *stream, i] and acts with [seed, ACTION, *stream, i].
    """

    RESET = 1  # initial state of episode i
    ACTION = 2  # action noise of episode i
    SAC = 3  # segment i of a behaviour agent's training
    RUNG = 4  # the episodes that screen rung i
    MEASURE = 5  # the episodes that choose rungs
    REFERENCE = 6  # the episodes that a reference score is measured in
    WEIGHTS = 7  # initial weights of network i
    CHUNK = 8  # batches and noise of chunk i of a run
    EVALUATION = 9  # the episodes of a run's evaluation at step i
    # 10 was used by an earlier version
    SAMPLE = 11  # the transitions or episodes of a figure or a check
    BOOTSTRAP = 12  # the resampled seeds of a bootstrap interval


def check_seed(seed: object) -> int:
    """Return a user's seed as an int.

    Raises:
        OffbenchError: it is not a whole number from 0 to MAX_INT.
    """
    try:
        number = -1 if isinstance(seed, bool) else operator.index(seed)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if not 0 <= number <= MAX_INT:
        raise OffbenchError(f"a seed is a whole number from 0 to 2**63 - 1, not {seed!r:.60}")
    return number


def sequence(seed: int, purpose: Purpose, *index: int) -> np.random.SeedSequence:
    """Return the seed sequence of one purpose and index (all non-negative integers)."""
    return np.random.SeedSequence([seed, int(purpose), *index])


def generator(seed: int, purpose: Purpose, *index: int) -> np.random.Generator:
    """Return the NumPy generator of one purpose and index."""
    return np.random.default_rng(sequence(seed, purpose, *index))


def integer(seed: int, purpose: Purpose, *index: int) -> int:
    """Return a 63-bit seed for a generator that is not NumPy's (an environment, PyTorch)."""
    return int(sequence(seed, purpose, *index).generate_state(1, np.uint64)[0] >> np.uint64(1))
