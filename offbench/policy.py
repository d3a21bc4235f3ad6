"""The policy file: one safetensors file that says everything needed to act, and a NumPy forward that acts.

    W0 [obs, h]  b0 [h]  W1 [h, h]  b1 [h]  W2 [h, out]  b2 [out]        (x @ W + b, relu between)
    kind "tanh"               out = act          action = tanh(out)
    kind "squashed_gaussian"  out = 2 x act      action = tanh(mean + std * noise), log std clipped to [-20, 2]
    kind "uniform"            no weights         action = uniform in the bounds

The forward runs in float64 and rounds the action to float32 at its end. Matrix products differ in their last
bits between processors and batch sizes; the rounding hides that, so a recorded dataset is the same for any
number of workers and, but for rare ties, on any machine with the same physics.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load, save

from offbench.errors import OffbenchError
from offbench.files import write_bytes

Array = npt.NDArray[Any]
KINDS = ("tanh", "squashed_gaussian", "uniform")
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # Stable-Baselines3's bounds, and CQL's


@dataclass(frozen=True)
class Policy:
    """A policy that acts in NumPy.

    Attributes:
        kind: one of KINDS.
        layers: (weight [in, out], bias [out]) of each linear layer, float32.
        observation_mean, observation_std: [obs], the normalisation before the first layer.
        low, high: [act], the bounds of the environment's action space.
        env_id: the environment it was trained for.
        origin: provenance, anything JSON: algorithm, training step, dataset, seed.
    """

    kind: str
    layers: tuple[tuple[Array, Array], ...]
    observation_mean: Array
    observation_std: Array
    low: Array
    high: Array
    env_id: str
    origin: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Prepare the float64 copies that `act` uses, once."""
        double = tuple((w.astype(np.float64), b.astype(np.float64)) for w, b in self.layers)
        object.__setattr__(self, "_double", double)
        object.__setattr__(self, "_low", self.low.astype(np.float64))
        object.__setattr__(self, "_span", (self.high.astype(np.float64) - self._low) / 2)  # type: ignore[attr-defined]

    @property
    def stochastic(self) -> bool:
        """True if `act` can use noise."""
        return self.kind != "tanh"

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return the noise of `count` actions, [count, act]: normal, or uniform in [-1, 1]."""
        shape = (count, len(self.low))
        return rng.uniform(-1.0, 1.0, shape) if self.kind == "uniform" else rng.standard_normal(shape)

    def act(self, observations: Array, noise: Array | None) -> npt.NDArray[np.float32]:
        """Return the actions [n, act] for observations [n, obs], in the environment's bounds.

        Args:
            noise: [n, act] from `draw`, or None to act deterministically (the mode; uniform has none: zeros).
        """
        span: Array = self._span  # type: ignore[attr-defined]
        low: Array = self._low  # type: ignore[attr-defined]
        squashed = self._squashed(observations, noise)
        # +1 before scaling keeps both ends exact: tanh = -1 gives low, tanh = 1 gives high
        return np.clip(low + (squashed + 1.0) * span, self.low, self.high).astype(np.float32)

    def _squashed(self, observations: Array, noise: Array | None) -> Array:
        if self.kind == "uniform":
            return np.zeros((len(observations), len(self.low))) if noise is None else noise
        x = (np.asarray(observations, np.float64) - self.observation_mean) / self.observation_std
        layers: tuple[tuple[Array, Array], ...] = self._double  # type: ignore[attr-defined]
        for weight, bias in layers[:-1]:
            x = x @ weight
            x += bias
            np.maximum(x, 0.0, out=x)
        weight, bias = layers[-1]
        x = x @ weight + bias
        if self.kind == "tanh":
            return np.tanh(x)
        mean, log_std = np.split(x, 2, axis=-1)
        if noise is not None:
            mean = mean + np.exp(np.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)) * noise
        return np.tanh(mean)

    def to_bytes(self) -> bytes:
        """Return the policy file's content."""
        tensors: dict[str, Array] = {"low": self.low, "high": self.high}
        tensors |= {"observation_mean": self.observation_mean, "observation_std": self.observation_std}
        for i, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
        header = {
            "format": "offbench-policy-1",
            "kind": self.kind,
            "env_id": self.env_id,
            "origin": self.origin,
        }
        arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()}
        return bytes(save(arrays, metadata={"offbench": json.dumps(header, sort_keys=True)}))

    def save(self, path: Path) -> None:
        """Write the policy file, whole or not at all."""
        write_bytes(path, self.to_bytes())


def uniform(low: Array, high: Array, observation_dim: int, env_id: str) -> Policy:
    """Return the policy that draws actions uniformly in the bounds, as D4RL's random level did."""
    zeros, ones = np.zeros(observation_dim, np.float32), np.ones(observation_dim, np.float32)
    return Policy("uniform", (), zeros, ones, low, high, env_id, {"algorithm": "uniform"})


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Read a policy file. Raises OffbenchError if it is not one, or is damaged."""
    try:
        return from_bytes(Path(path).read_bytes())
    except FileNotFoundError:
        raise OffbenchError(f"no policy file {path}") from None
    except (OSError, ValueError) as error:
        raise OffbenchError(f"{path} is not a readable policy file: {error}") from None


def from_bytes(data: bytes) -> Policy:
    """Read a policy from a file's content. Raises ValueError saying what is wrong with it."""
    try:
        tensors = load(data)
    except SafetensorError as error:
        raise ValueError(f"not safetensors ({error})") from None
    header = _header(data)
    kind = header.get("kind")
    if header.get("format") != "offbench-policy-1" or kind not in KINDS:
        raise ValueError(f"unknown format {header.get('format')!r} or kind {kind!r}")
    count = sum(name.endswith(".weight") for name in tensors)
    names = [f"layers.{i}.{part}" for i in range(count) for part in ("weight", "bias")]
    wanted = {*names, "low", "high", "observation_mean", "observation_std"}
    if set(tensors) != wanted:
        raise ValueError(f"tensors {sorted(wanted.symmetric_difference(tensors))} are missing or too many")
    layers = tuple((tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]) for i in range(count))
    env_id, origin = header.get("env_id"), header.get("origin")
    if not isinstance(env_id, str) or not isinstance(origin, dict):
        raise ValueError("its header lacks env_id or origin")
    mean, std, low, high = (tensors[name] for name in ("observation_mean", "observation_std", "low", "high"))
    _check_shapes(kind, layers, mean, std, low, high)
    return Policy(kind, layers, mean, std, low, high, env_id, origin)


def _header(data: bytes) -> dict[str, Any]:
    """Return the JSON that the safetensors header carries for us ({} if there is none)."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(json.loads(data[8 : 8 + length]).get("__metadata__", {}).get("offbench", "{}"))
    except (json.JSONDecodeError, AttributeError, TypeError, RecursionError):
        return {}
    return header if isinstance(header, dict) else {}


def _check_shapes(
    kind: str, layers: tuple[tuple[Array, Array], ...], mean: Array, std: Array, low: Array, high: Array
) -> None:
    arrays = [mean, std, low, high, *(a for pair in layers for a in pair)]
    if any(a.dtype != np.float32 for a in arrays):
        raise ValueError("every tensor must be float32")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("it holds NaN or infinite numbers")
    if any(a.ndim != 1 for a in (mean, std, low, high)) or mean.shape != std.shape or low.shape != high.shape:
        raise ValueError("the shapes of bounds or normalisation do not agree")
    if kind == "uniform":
        return
    if (std <= 0).any() or (high <= low).any() or not layers:
        raise ValueError("it has no layers, a std that is not positive, or bounds out of order")
    width = len(mean)
    for weight, bias in layers:
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or weight.shape[0] != width:
            raise ValueError(f"a layer of shape {weight.shape} does not follow {width} inputs")
        width = weight.shape[1]
    if width != len(low) * (2 if kind == "squashed_gaussian" else 1):
        raise ValueError(f"{width} outputs do not fit {len(low)} actions")
