"""A user's own behaviour policy for `collect`: an SB3 zip, a run, a policy file, or a function."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offbench.agents.sb3_zip import read_sb3_zip
from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import sha256
from offbench.common.terminal import warn
from offbench.data.levels import FRACTION, LEVELS
from offbench.rollouts.function_policy import FunctionPolicy, function_policy
from offbench.rollouts.policy import Policy, read_policy_file

POLICY_FILE = "policy.safetensors"  # file name in a run's folder


@dataclass(frozen=True)
class BehaviourPolicy:
    """A policy to record with.

    Attributes:
        policy: acts in the environment's bounds.
        source: as the user named it, without folders.
        algorithm: the algorithm that trained it, for the metadata.
        sha256: of the policy, or of the module of a function.
    """

    policy: Policy | FunctionPolicy
    source: str
    algorithm: str
    sha256: str


def read_behaviour_policy(source: str, low: Array, high: Array, observation_dim: int, env_id: str) -> BehaviourPolicy:
    """Read what `--policy` names.

    Args:
        source: `agent.zip` of Stable-Baselines3, a run's folder, a policy file, or `module:function`.
        low, high: [act], the bounds of the environment's actions.

    Raises:
        OffbenchError: nothing there, unreadable, or for other observations or actions.
    """
    path = Path(source)
    if re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", source) and not path.exists():
        function = function_policy(source, low, high)
        return BehaviourPolicy(function, source, source, sha256(function.source()))
    if path.suffix.lower() == ".zip":
        policy = read_sb3_zip(path, low, high, env_id)
    else:
        policy = read_policy_file(path / POLICY_FILE if path.is_dir() else path)
    shapes = (len(policy.observation_mean), len(policy.low))
    if shapes != (observation_dim, len(low)):
        raise OffbenchError(
            f"{source} takes observations ({shapes[0]},) and gives actions ({shapes[1]},), "
            f"but {env_id} has ({observation_dim},) and ({len(low)},)"
        )
    if not (np.allclose(policy.low, low) and np.allclose(policy.high, high)):
        raise OffbenchError(f"{source} acts in {policy.low} to {policy.high}, but {env_id} in {low} to {high}")
    if policy.env_id and _task(policy.env_id) != _task(env_id):
        warn(f"{source} was trained for {policy.env_id}, and is recorded in {env_id}")
    algorithm = str(policy.origin.get("algorithm", "unknown"))
    return BehaviourPolicy(policy, path.name or source, algorithm, sha256(policy.to_bytes()))


def _task(env_id: str) -> str:
    """Return an environment's id without the module that registers it and without its version."""
    return re.sub(r"-v\d+$", "", env_id.rpartition(":")[2])


def level_name(name: str | None, source: str) -> str:
    """Return the level of a dataset recorded by a policy: the given name, or one from the policy's own.

    Raises:
        OffbenchError: the name of a level that a ladder defines, or one that no dataset id may hold.
    """
    own = re.sub(r"[^a-z0-9]+", "-", Path(source.rpartition(":")[2]).stem.lower()).strip("-")
    level = name or own or "policy"
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", level):
        raise OffbenchError(f"--name can contain a-z, 0-9 and single hyphens, not {level!r}")
    if level in LEVELS or re.fullmatch(FRACTION, level):
        raise OffbenchError(f"{level!r} is a level of offbench's own agents; give another --name")
    return level
