"""The array type, and a hash of named arrays."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def arrays_sha256(arrays: Mapping[str, Array], state: Mapping[str, object]) -> str:
    """Return the SHA-256 of named arrays and of a JSON state, which detects any changed bit."""
    plain = json.loads(json.dumps(state))  # the form in which it is read back: lists for tuples, text for keys
    content = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name in sorted(arrays):
        content.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
        content.update(np.ascontiguousarray(arrays[name]).tobytes())
    return content.hexdigest()
