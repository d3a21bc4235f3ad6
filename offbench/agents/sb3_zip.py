"""The policy in a zip that Stable-Baselines3 saved: SAC, TD3, DDPG, PPO and A2C with MLP policies.

Such a zip holds pickled data, which can run any code when it is loaded. Only two members are read here: policy.pth, by
`torch.load(weights_only=True)`, which loads only tensors, and `data`, as JSON text, for the name of the activation and
the bounds of the actions.
"""

from __future__ import annotations

import io
import json
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, open_regular, read_errors
from offbench.rollouts.policy import ACTIVATIONS, Layers, Policy, check_networks

MAX_MEMBER_SIZE = 2**30  # bytes of a member, unpacked
FLATTEN = "<class 'stable_baselines3.common.torch_layers.FlattenExtractor'>"  # leaves vectors as they are


def read_sb3_zip(path: Path, low: Array, high: Array, env_id: str) -> Policy:
    """Return the policy of an SB3 agent; only its tensors are read.

    Args:
        low, high: [act], the bounds of the environment's actions, used if the zip does not hold them.

    Raises:
        OffbenchError: not such a zip, a damaged or malicious one, a policy that is not an MLP's, or one for
            observations that VecNormalize has normalized (recognized for PPO and A2C only).
    """
    try:
        with read_errors(str(path), "is not a readable zip of Stable-Baselines3", "save the agent again"):
            tensors, settings = _read(path)
    except FileNotFoundError:
        raise OffbenchError(f"no file {path}") from None
    if settings.get("use_sde") is True:
        raise OffbenchError(f"{path} uses gSDE exploration, which offbench does not play")
    extractor = _policy_argument(settings, "features_extractor_class")
    if extractor not in ("", FLATTEN) or any("features_extractor." in name for name in tensors):
        raise OffbenchError(
            f"{path} has a features extractor of its own, which offbench does not play; "
            "give --policy module:function, a function that calls the agent"
        )
    kind, layers, algorithm, default = _layers(path, tensors)
    activation = _activation(path, settings, default)
    if any(not np.isfinite(array).all() for pair in layers for array in pair):
        raise OffbenchError(f"{path} contains NaN or infinite weights")
    if kind == "gaussian" and settings.get("_last_original_obs") is not None:  # SAC and TD3 always set it
        raise OffbenchError(
            f"{path} was trained with VecNormalize, whose statistics are not in the zip; "
            "give --policy module:function, a function that normalizes observations (unless norm_obs=False) and acts"
        )
    actions = len(layers[-1][1]) // (1 if kind == "tanh" else 2)
    low, high = _bounds(settings, "low", low, actions), _bounds(settings, "high", high, actions)
    zeros = np.zeros(layers[0][0].shape[0], np.float32)
    origin = {"algorithm": f"{algorithm} (Stable-Baselines3)"}
    policy = Policy(kind, layers, zeros, zeros + 1, low, high, env_id, origin, activation=activation)
    try:
        check_networks(policy, len(zeros), actions)
    except ValueError as error:
        raise OffbenchError(f"{path} is not an MLP policy as SB3 saves it: {error}") from None
    return policy


def _read(path: Path) -> tuple[dict[str, Array], JsonObject]:
    """Return the tensors of policy.pth and the plain settings of data.

    Raises:
        OffbenchError: policy.pth contains more than tensors.
        Exception: whatever zipfile and torch raise for damaged bytes.
    """
    import torch

    with open(path, "rb", opener=open_regular) as file, zipfile.ZipFile(file) as archive:
        for name in ("policy.pth", "data"):
            if archive.getinfo(name).file_size > MAX_MEMBER_SIZE:
                raise ValueError(f"{name} is larger than {MAX_MEMBER_SIZE:,} bytes")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about old formats: their content is checked below
            try:
                weights = torch.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
            except (pickle.UnpicklingError, RecursionError):
                raise OffbenchError(f"{path} is refused: its policy.pth contains more than tensors") from None
        settings = json.loads(archive.read("data"))
    if not isinstance(weights, Mapping) or not isinstance(settings, dict):
        raise ValueError("its policy.pth or data are not what SB3 writes")
    tensors = {}
    for name, value in weights.items():
        if isinstance(value, torch.Tensor) and value.layout == torch.strided and not value.is_quantized:
            tensors[str(name)] = value.detach().to(torch.float32).numpy()
    return tensors, settings


def _layers(path: Path, tensors: Mapping[str, Array]) -> tuple[str, Layers, str, str]:
    """Return kind, layers, name of the algorithm and its default activation."""
    try:
        if "actor.latent_pi.0.weight" in tensors or "actor.mu.weight" in tensors:
            return "squashed_gaussian", sac_layers(tensors), "SAC", "relu"
        if "actor.mu.0.weight" in tensors:
            return "tanh", _sequence(tensors, "actor.mu"), "TD3 or DDPG", "relu"
        if "action_net.weight" in tensors:
            weight, bias = _layer(tensors, "action_net")
            if "log_std" not in tensors:
                raise OffbenchError(f"{path} has discrete actions; offbench records environments with continuous ones")
            std = tensors["log_std"]
            if std.shape != bias.shape:
                raise KeyError("log_std")
            head = _joined([(weight, bias), (np.zeros_like(weight), std)])
            return "gaussian", (*_sequence(tensors, "mlp_extractor.policy_net"), head), "PPO or A2C", "tanh"
    except (KeyError, ValueError, IndexError) as error:
        raise OffbenchError(f"{path} is not an MLP policy as SB3 saves it: {error}") from None
    raise OffbenchError(f"{path} contains no policy of SAC, TD3, DDPG, PPO or A2C with an MLP")


def sac_layers(tensors: Mapping[str, Array]) -> Layers:
    """Return the layers of a SAC actor, the last of which has the means and the log stds, from a policy's tensors."""
    head = _joined([_layer(tensors, "actor.mu"), _layer(tensors, "actor.log_std")])
    return (*_sequence(tensors, "actor.latent_pi"), head)


def _layer(tensors: Mapping[str, Array], name: str) -> tuple[Array, Array]:
    weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
    if weight.ndim != 2 or bias.shape != weight.shape[:1]:
        raise ValueError(f"{name} has shapes {weight.shape} and {bias.shape}")
    return np.ascontiguousarray(weight.T), bias


def _joined(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    return np.concatenate([weight for weight, _ in parts], 1), np.concatenate([bias for _, bias in parts])


def _sequence(tensors: Mapping[str, Array], name: str) -> Layers:
    """Return the linear layers of a torch.nn.Sequential, in order."""
    matches = (re.fullmatch(rf"{re.escape(name)}\.(\d+)\.weight", key) for key in tensors)
    return tuple(_layer(tensors, f"{name}.{index}") for index in sorted(int(match[1]) for match in matches if match))


def _bounds(settings: JsonObject, name: str, default: Array, actions: int) -> Array:
    """Return [actions], the lower or upper action bounds, parsed from SB3's text of the action space."""
    space = settings.get("action_space")
    text = str(space.get(name, "")) if isinstance(space, dict) else ""
    numbers = re.findall(r"-?\d+(?:\.\d*)?(?:e[+-]?\d+)?", text)
    with np.errstate(over="ignore"):
        values = np.array([float(number) for number in numbers]).astype(np.float32)
    return values if len(values) == actions else np.resize(default, actions)


def _policy_argument(settings: JsonObject, name: str) -> str:
    """Return SB3's text of one of policy_kwargs, "" if it is not given."""
    arguments = settings.get("policy_kwargs")
    return str(arguments.get(name, "")) if isinstance(arguments, dict) else ""


def _activation(path: Path, settings: JsonObject, default: str) -> str:
    """Return the activation, parsed from SB3's text of policy_kwargs."""
    text = _policy_argument(settings, "activation_fn")
    name = re.sub(r"^<class '(?:\w+\.)*(\w+)'>$", r"\1", text).lower() or default
    if name not in ACTIVATIONS:
        raise OffbenchError(f"{path} has the activation {text:.60}; offbench plays {', '.join(ACTIVATIONS)}")
    return name
