"""The hash of a dataset's content, which its metadata, runs and cards record."""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt

from offbench.common.arrays import Array


class ContentHash:
    """SHA-256 over the arrays of episodes in order: the same for the same data, whatever file holds them."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(
        self,
        observations: Array,
        actions: Array,
        rewards: Array,
        terminations: npt.ArrayLike,
        truncations: npt.ArrayLike,
    ) -> None:
        """Add one episode; dtype and shape of the arrays count too.

        Of the flags, the last ones count. Flags before those, which no sound episode has, count if any is set.
        """
        for array in (observations, actions, rewards):
            self._hash.update(f"{array.dtype.str}{array.shape}".encode())
            self._hash.update(np.ascontiguousarray(array).data)
        flags = np.array([terminations, truncations], bool)
        self._hash.update(flags[:, -1].tobytes())
        if flags[:, :-1].any():
            self._hash.update(flags.tobytes())

    def hexdigest(self) -> str:
        """Return the hash of all episodes so far."""
        return self._hash.hexdigest()
