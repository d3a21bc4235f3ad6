"""Arrays that the passes of networks on a CPU compute in."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[np.float32]
Buffer = TypeVar("Buffer", Array, Tensor)
ALIGNED = 16  # float32 numbers of 64 bytes: rows of buffers begin where a processor's wide registers do


def rows(batch: int, width: int) -> Array:
    """Return an array [batch, width] whose rows are aligned."""
    padded = -(-width // ALIGNED) * ALIGNED
    return torch.zeros(batch, padded).numpy()[:, :width]


def rows_with_ones(batch: int, width: int) -> Array:
    """Return an array [batch, width + 1] whose last column is 1."""
    array = rows(batch, width + 1)
    array[:, -1] = 1
    return array


_BUFFERS = threading.local()


def shared(use: str, make: Callable[[int, int], Buffer]) -> Callable[[int, int], Buffer]:
    """Return `make` whose arrays all passes of this thread share, for what is used up within one pass."""

    def make_once(batch: int, width: int) -> Buffer:
        arrays: dict[object, Buffer] = _BUFFERS.__dict__.setdefault("arrays", {})
        key = (use, make, batch, width)
        if key not in arrays:
            arrays[key] = make(batch, width)
        return arrays[key]

    return make_once
