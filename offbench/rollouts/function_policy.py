"""A behaviour policy that calls a user's own function `module:function` with an observation."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from offbench.common.arrays import Array
from offbench.common.errors import SHOW_TRACEBACK, OffbenchError

TOLERANCE = 1e-5  # beyond the bounds, of float32 actions


@dataclass(frozen=True)
class FunctionPolicy:
    """Acts by calling a function once per observation, in this process: its copies would draw the same numbers.

    Attributes:
        name: `module:function`, importable from the current folder.
        low, high: [act], the bounds of the environment's action space.
    """

    name: str
    low: Array
    high: Array
    function: Callable[[Array], object]

    def needs_noise(self, deterministic: bool) -> bool:
        """Return False: the function draws what it needs itself."""
        return False

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return an empty array [count, 0]: the function takes no noise."""
        return np.zeros((count, 0))

    def act(self, observations: Array, noise: Array | None) -> npt.NDArray[np.float32]:
        """Return the actions [n, act] for observations [n, obs]. Raises OffbenchError for anything but an action."""
        actions = []
        for observation in observations:
            try:
                action = np.asarray(self.function(observation), np.float64).reshape(-1)
            except (Exception, SystemExit) as error:
                what = f"{type(error).__name__}: {error}"
                raise OffbenchError(f"the policy {self.name} failed: {what} ({SHOW_TRACEBACK})") from error
            if action.shape != self.low.shape or not np.isfinite(action).all():
                raise OffbenchError(f"the policy {self.name} returned {action}, not {len(self.low)} finite numbers")
            if (action < self.low - TOLERANCE).any() or (action > self.high + TOLERANCE).any():
                raise OffbenchError(
                    f"the policy {self.name} returned {action}, which is outside the bounds {self.low} to {self.high}"
                )
            actions.append(np.clip(action, self.low, self.high))
        return np.array(actions, np.float32).reshape(len(observations), len(self.low))

    def source(self) -> bytes:
        """Return the source of the module, and of the one that defines the function if it is another, for its hash."""
        paths = [getattr(sys.modules.get(self.name.partition(":")[0]), "__file__", None)]
        with contextlib.suppress(TypeError):  # a function in C and an object that is called have none
            paths.append(inspect.getsourcefile(inspect.unwrap(self.function)))
        files = [Path(path) for path in dict.fromkeys(paths) if path and os.path.isfile(path)]
        return b"".join(file.read_bytes() for file in files) or self.name.encode()


def function_policy(name: str, low: Array, high: Array) -> FunctionPolicy:
    """Import `module:function`, the current folder's modules included.

    Raises:
        OffbenchError: no such module or function, or the module fails.
    """
    module, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        function = getattr(importlib.import_module(module), attribute, None)
    except (Exception, SystemExit) as error:
        what = f"{type(error).__name__}: {error}"
        raise OffbenchError(f"cannot import the policy {name}: {what} ({SHOW_TRACEBACK})") from error
    if not callable(function):
        raise OffbenchError(f"the module {module} has no function {attribute!r}")
    return FunctionPolicy(name, low, high, function)
