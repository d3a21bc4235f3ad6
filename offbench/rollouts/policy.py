"""The policy file: one safetensors file with everything needed to act, and its forward pass in NumPy.

    W0 [obs, h]  b0 [h]  W1 [h, h]  b1 [h]  W2 [h, out]  b2 [out]        (x @ W + b, activation between)
    kind "tanh"               out = act          action = tanh(out)
    kind "squashed_gaussian"  out = 2 x act      action = tanh(mean + std * noise), log std clipped to [-20, 2]
    kind "gaussian"           out = 2 x act      action = clip(mean + std * noise), not scaled: SB3's PPO and A2C
    kind "best_by_q"          the squashed Gaussian's best of `samples` actions by Q(observation, action in [-1, 1])
    kind "uniform"            no weights         action = uniform in the bounds

The forward pass runs in float64 and rounds the action to float32 at its end. Matrix products differ in their last
bits between processors and batch sizes; the rounding hides that, so a recorded dataset is the same for any
number of workers and, but for rare ties, on any machine with the same physics.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load, save

from offbench.common.arrays import Array, arrays_sha256
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, read_bytes, read_errors, write_bytes

if TYPE_CHECKING:
    from torch import Tensor

    from offbench.algorithm.interface import PolicyParts  # imports PyTorch, which rollout workers do not need

KINDS = ("tanh", "squashed_gaussian", "gaussian", "best_by_q", "uniform")
Layers = tuple[tuple[Array, Array], ...]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {  # they work in place
    "relu": lambda x: np.maximum(x, 0.0, out=x),
    "tanh": lambda x: np.tanh(x, out=x),
}
NETWORKS = ("layers", "critic")
MAX_SAMPLES = 10_000  # actions to choose from; more would fill the memory
MAX_CRITIC_VALUES = 4_000_000  # samples times the width of the critic
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # Stable-Baselines3's bounds, and CQL's


class _Double(NamedTuple):
    """A policy's arrays in float64."""

    actor: Layers
    critic: Layers
    mean: Array
    std: Array
    low: Array
    high: Array


@dataclass(frozen=True, repr=False)
class Policy:
    """A policy that acts in NumPy: `policy(observation)` is the action for `env.step`.

    Attributes:
        kind: one of KINDS.
        layers: (weight [in, out], bias [out]) of each linear layer, float32.
        observation_mean, observation_std: [obs], the normalization before the first layer.
        low, high: [act], the bounds of the environment's action space.
        env_id: the environment it was trained for.
        origin: provenance, anything JSON: algorithm, training step, dataset, seed.
        activation: between layers, a key of ACTIVATIONS.
        critic, samples: only for the kind `best_by_q`: layers of Q, and the number of actions to choose from.
    """

    kind: str
    layers: Layers
    observation_mean: Array
    observation_std: Array
    low: Array
    high: Array
    env_id: str
    origin: JsonObject = dataclasses.field(default_factory=dict)
    critic: Layers = ()
    samples: int = 1
    activation: str = "relu"

    def __repr__(self) -> str:
        """Return kind, sizes and environment."""
        sizes = [len(self.observation_mean), *(weight.shape[1] for weight, _ in self.layers[:-1]), len(self.low)]
        return f"Policy({self.kind}, {' -> '.join(map(str, sizes))}, {self.env_id})"

    def __call__(self, observation: Array, rng: np.random.Generator | None = None) -> npt.NDArray[np.float32]:
        """Return the action [act] for an observation [obs], or the actions [n, act] for observations [n, obs].

        Args:
            rng: None for the best action (the mode); a generator to sample. Policies that have no single best action
                (uniform, best_by_q) draw from a generator of their own without it.

        Raises:
            OffbenchError: the observation has another shape.
        """
        batch, size = np.atleast_2d(np.asarray(observation)), len(self.observation_mean)
        if batch.ndim != 2 or batch.shape[1] != size:
            raise OffbenchError(f"the policy takes observations ({size},), not {np.shape(observation)}")
        noise = self.draw(rng or self._rng, len(batch)) if self.needs_noise(rng is None) else None
        actions = self.act(batch, noise)
        return actions if np.ndim(observation) == 2 else actions[0]

    @functools.cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(0)

    @functools.cached_property
    def _double(self) -> _Double:
        """The arrays in float64, converted once."""
        actor, critic = (
            tuple((w.astype(np.float64), b.astype(np.float64)) for w, b in net) for net in (self.layers, self.critic)
        )
        parts = (self.observation_mean, self.observation_std, self.low, self.high)
        return _Double(actor, critic, *(part.astype(np.float64) for part in parts))

    @property
    def stochastic(self) -> bool:
        """True if its actions can be sampled."""
        return self.kind in ("squashed_gaussian", "gaussian", "uniform")

    def needs_noise(self, deterministic: bool) -> bool:
        """Return whether `act` must be given noise: to sample, or if the policy has no single best action."""
        return self.kind in ("best_by_q", "uniform") or (self.stochastic and not deterministic)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return the noise of `count` actions, [count, act]: normal, or uniform in [-1, 1].

        For `best_by_q` it is [count, samples, act].
        """
        shape = (count, len(self.low))
        if self.kind == "uniform":
            return rng.uniform(-1.0, 1.0, shape)
        return rng.standard_normal((count, self.samples, len(self.low)) if self.kind == "best_by_q" else shape)

    def act(self, observations: Array, noise: Array | None) -> npt.NDArray[np.float32]:
        """Return the actions [n, act] for observations [n, obs], in the environment's bounds.

        Args:
            noise: from `draw`, or None to act deterministically (the mode; the middle of the bounds if uniform).
        """
        double = self._double
        if self.kind == "gaussian":
            mean, std = self._gaussian(self._normalized(observations))
            return _clip(mean if noise is None else mean + std * noise, double.low, double.high).astype(np.float32)
        squashed = self._squashed(observations, noise)
        # +1 before scaling keeps both ends exact: tanh = -1 gives low, tanh = 1 gives high
        actions = double.low + (squashed + 1.0) * ((double.high - double.low) / 2)
        return _clip(actions, double.low, double.high).astype(np.float32)

    def _squashed(self, observations: Array, noise: Array | None) -> Array:
        if self.kind == "uniform":
            return np.zeros((len(observations), len(self.low))) if noise is None else noise
        x = self._normalized(observations)
        if self.kind == "tanh":
            return np.asarray(np.tanh(_forward(self._double.actor, x, self.activation)))
        mean, std = self._gaussian(x)
        if noise is None or self.kind == "squashed_gaussian":
            return np.asarray(np.tanh(mean if noise is None else mean + std * noise))
        actions = np.tanh(mean[:, None] + std[:, None] * noise)  # [n, samples, act]
        repeated = np.broadcast_to(x[:, None], (*actions.shape[:2], x.shape[1]))
        q = _forward(self._double.critic, np.concatenate([repeated, actions], -1), self.activation)[..., 0]
        chosen: Array = actions[np.arange(len(actions)), q.argmax(1)]
        return chosen

    def _normalized(self, observations: Array) -> Array:
        normalized: Array = (np.asarray(observations, np.float64) - self._double.mean) / self._double.std
        return normalized

    def _gaussian(self, x: Array) -> tuple[Array, Array]:
        """Return mean and std [n, act] of the actions before tanh or the bounds."""
        out = _forward(self._double.actor, x, self.activation)
        mean, log_std = out[:, : len(self.low)], out[:, len(self.low) :]
        if self.kind != "gaussian":
            log_std = _clip(log_std, LOG_STD_MIN, LOG_STD_MAX)
        return mean, np.exp(log_std)

    def to_bytes(self) -> bytes:
        """Return the policy file's content."""
        tensors: dict[str, Array] = {"low": self.low, "high": self.high}
        tensors |= {"observation_mean": self.observation_mean, "observation_std": self.observation_std}
        for net, layers in zip(NETWORKS, (self.layers, self.critic), strict=True):
            for i, (weight, bias) in enumerate(layers):
                tensors |= {f"{net}.{i}.weight": weight, f"{net}.{i}.bias": bias}
        header = {
            "format": "offbench-policy-1",
            "kind": self.kind,
            "env_id": self.env_id,
            "origin": self.origin,
            "samples": self.samples,
            "activation": self.activation,
        }
        arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()}
        header["sha256"] = arrays_sha256(arrays, header)
        return bytes(save(arrays, metadata={"offbench": json.dumps(header, sort_keys=True)}))

    def save(self, path: Path) -> None:
        """Write the policy file, whole or not at all."""
        write_bytes(path, self.to_bytes())


def _clip(x: Array, low: Array | float, high: Array | float) -> Array:
    """Clip as `np.clip` does, without its checks, which dominate the time for small arrays."""
    clipped: Array = np.minimum(np.maximum(x, low), high)
    return clipped


def _forward(layers: Layers, x: Array, activation: str) -> Array:
    """Return the last layer's output."""
    for weight, bias in layers[:-1]:
        x = x @ weight
        x += bias
        ACTIVATIONS[activation](x)
    weight, bias = layers[-1]
    out: Array = x @ weight + bias
    return out


def uniform_policy(low: Array, high: Array, observation_dim: int, env_id: str) -> Policy:
    """Return the policy that draws actions uniformly in the bounds, as D4RL's random level did."""
    zeros, ones = np.zeros(observation_dim, np.float32), np.ones(observation_dim, np.float32)
    return Policy("uniform", (), zeros, ones, low, high, env_id, {"algorithm": "uniform"})


def read_policy_file(path: str | os.PathLike[str]) -> Policy:
    """Read a policy file. Raises OffbenchError if it is not one, or is damaged."""
    try:
        with read_errors(str(path), "is not a readable policy file", "give another, or write it again"):
            return from_bytes(read_bytes(Path(path)))
    except FileNotFoundError:
        raise OffbenchError(f"no run or policy file {path}") from None


def from_bytes(data: bytes) -> Policy:
    """Read a policy from a file's content. Raises ValueError saying what is wrong with it."""
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, TypeError) as error:  # KeyError: a dtype that NumPy lacks
        raise ValueError(f"not safetensors ({error})") from None
    header = _header(data)
    recorded = header.pop("sha256", None)  # older files have none
    if recorded is not None and recorded != arrays_sha256(tensors, header):
        raise ValueError("its content is not what was written (SHA-256)")
    if header.get("format") != "offbench-policy-1":
        raise ValueError(f"unknown format {header.get('format')!r}")
    sizes = {net: sum(n.startswith(f"{net}.") and n.endswith(".weight") for n in tensors) for net in NETWORKS}
    names = [f"{net}.{i}.{part}" for net, n in sizes.items() for i in range(n) for part in ("weight", "bias")]
    wanted = {*names, "low", "high", "observation_mean", "observation_std"}
    if set(tensors) != wanted:
        raise ValueError(f"tensors {sorted(wanted.symmetric_difference(tensors))} are missing or too many")
    env_id, origin = header.get("env_id"), header.get("origin")
    if not isinstance(env_id, str) or not isinstance(origin, dict):
        raise ValueError("its header lacks env_id or origin")
    layers, critic = (
        tuple((tensors[f"{net}.{i}.weight"], tensors[f"{net}.{i}.bias"]) for i in range(n)) for net, n in sizes.items()
    )
    mean, std, low, high = (tensors[name] for name in ("observation_mean", "observation_std", "low", "high"))
    options = {key: header.get(key, default) for key, default in (("samples", 1), ("activation", "relu"))}
    policy = Policy(str(header.get("kind")), layers, mean, std, low, high, env_id, origin, critic, **options)
    _check_shapes(policy)
    return policy


def _header(data: bytes) -> JsonObject:
    """Return offbench's JSON in the safetensors header ({} if there is none)."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(json.loads(data[8 : 8 + length]).get("__metadata__", {}).get("offbench", "{}"))
    except (json.JSONDecodeError, AttributeError, TypeError, RecursionError):
        return {}
    return header if isinstance(header, dict) else {}


def _check_shapes(p: Policy) -> None:
    arrays = [p.observation_mean, p.observation_std, p.low, p.high, *(a for pair in p.layers + p.critic for a in pair)]
    if any(a.dtype != np.float32 for a in arrays):
        raise ValueError("every tensor must be float32")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("it contains NaN or infinite numbers")
    dim, act = p.observation_mean.shape, p.low.shape
    if any(a.ndim != 1 for a in arrays[:4]) or dim != p.observation_std.shape or act != p.high.shape:
        raise ValueError("the shapes of bounds or normalization do not agree")
    check_networks(p, dim[0], act[0])
    if p.kind != "uniform" and ((p.observation_std <= 0).any() or (p.high <= p.low).any()):
        raise ValueError("a std is not positive, or bounds are out of order")


def check_networks(parts: Policy | PolicyParts, observations: int, actions: int) -> None:
    """Raise ValueError if the kind is unknown, or the layers do not map observations to its outputs."""
    if parts.kind not in KINDS:
        raise ValueError(f"unknown kind {parts.kind!r}; the kinds are {', '.join(KINDS)}")
    if not isinstance(parts.activation, str) or parts.activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation {parts.activation!r}; the activations are {', '.join(ACTIVATIONS)}")
    if not isinstance(parts.samples, int) or not 1 <= parts.samples <= MAX_SAMPLES:
        raise ValueError(f"samples must be a whole number from 1 to {MAX_SAMPLES}, not {parts.samples!r}")
    if parts.kind == "uniform":
        return
    _check_layers(parts.layers, observations, actions * (1 if parts.kind == "tanh" else 2))
    if parts.kind == "best_by_q":
        _check_layers(parts.critic, observations + actions, 1)
        widest = max(len(bias) for _, bias in parts.critic)
        if parts.samples * widest > MAX_CRITIC_VALUES:
            raise ValueError(f"{parts.samples} samples for a critic of width {widest} would fill the memory")


def _check_layers(layers: Sequence[tuple[Array, Array] | tuple[Tensor, Tensor]], inputs: int, outputs: int) -> None:
    if not layers:
        raise ValueError("it has no layers")
    width = inputs
    for weight, bias in layers:
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or weight.shape[0] != width:
            raise ValueError(f"a layer of shape {tuple(weight.shape)} does not follow {width} inputs")
        width = weight.shape[1]
    if width != outputs:
        raise ValueError(f"{width} outputs where {outputs} are needed")
