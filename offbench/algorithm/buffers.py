"""Buffers of the forward and backward passes on a CPU."""

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
# float32 numbers of a vector register (64 bytes). Rows of buffers and the parameters of each run begin at multiples of
# it: vectorized loops round their last elements differently, and a run must be the same alone and in a stack.
ALIGNED = 16


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


def shared(use: str, make: Callable[[int, int], Buffer], batch: int, width: int) -> Buffer:
    """Return `make(batch, width)`, made once and shared by all passes of this thread, for values of a single pass."""
    arrays: dict[object, Buffer] = _BUFFERS.__dict__.setdefault("arrays", {})
    key = (use, make, batch, width)
    if key not in arrays:
        arrays[key] = make(batch, width)
    return arrays[key]
