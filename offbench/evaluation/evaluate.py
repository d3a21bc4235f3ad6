"""`evaluate`: the returns of a run's policy or a policy file in its environment."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np

from offbench.agents.ladder import shipped_references
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.common.processes import blocking_workers, default_workers
from offbench.common.scores import interval, mean_std, normalize
from offbench.common.seeds import Purpose, check_seed
from offbench.common.settings import check_count
from offbench.common.terminal import warn
from offbench.common.text import counted
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import check_spec, env_spec, same_environment
from offbench.envs.margin_rule import MUJOCO_VERSIONS, SUM_RULE, without_margin
from offbench.envs.recipes import d4rl_reference_of_env, load_recipe
from offbench.envs.trust import REMEDY, is_trusting
from offbench.evaluation.policies import load_policy
from offbench.rollouts.policy import Policy
from offbench.rollouts.rollouts import Rollouts
from offbench.training.run import Run
from offbench.training.run_config import RunConfig


@dataclass(frozen=True)
class Evaluation:
    """The returns of a policy's episodes.

    Attributes:
        policy: the path of the run or policy file.
        returns, lengths: return and length of each episode.
        scores: mean normalized score by each reference there is: "dataset", "d4rl".
        physics: the contact margins, if they are not offbench's default.
    """

    policy: str
    env_id: str
    returns: list[float]
    lengths: list[int]
    scores: dict[str, float]
    physics: str = ""

    def lines(self) -> list[str]:
        """Return the evaluation as text."""
        mean, low, high = interval(self.returns)
        _, std = mean_std(self.returns)
        spread = "" if std is None else f" (95% interval {low:.1f} to {high:.1f}), std {std:.1f}"
        lines = [
            f"{self.policy} in {self.env_id}{self.physics}: {counted(len(self.returns), 'episode')}",
            f"return {mean:.1f}{spread}, length {np.mean(self.lengths):.0f}",
        ]
        names = {"dataset": "own reference: random and expert of this environment", "d4rl": "D4RL's constants"}
        return lines + [f"normalized score {score:z.1f} ({names[key]})" for key, score in self.scores.items()]


def evaluate(
    path: str | Path,
    *,
    env: str | Path | None = None,
    episodes: int = 10,
    seed: int = 0,
    stochastic: bool = False,
    workers: int | None = None,
) -> Evaluation:
    """Play episodes of a run's policy, or of a policy file.

    Args:
        path: a run folder, or a policy file (.safetensors).
        env: a recipe's name or file, instead of the environment that the run or policy names.
        seed: seed of the episodes.
        stochastic: sample actions (policies that can) instead of taking the mode.
        workers: processes (default: one per core).

    Raises:
        OffbenchError: there is no run or policy, or it does not fit the environment.
    """
    path, seed, episodes = Path(path), check_seed(seed), check_count("episodes", episodes)
    policy, config, spec = open_policy(path, env)
    if stochastic and not policy.stochastic:
        raise OffbenchError(f"{path} is a deterministic policy; leave out --stochastic")
    with Rollouts(spec, blocking_workers(default_workers(workers))) as rollouts:
        episode_stats = rollouts.evaluate(policy, seed, (int(Purpose.REFERENCE), 2), episodes, not stochastic)
    returns = [episode.ret for episode in episode_stats]
    env_id = json.loads(spec)["id"]
    # a run's own references are of its own environment
    if config is not None and same_environment(config.env_spec, spec):
        references = config.references
    else:
        references = {"dataset": shipped_references(spec), "d4rl": d4rl_reference_of_env(spec)}
    scores = {key: normalize(float(np.mean(returns)), *pair) for key, pair in references.items() if pair}
    physics = (
        f" with contact margins as in MuJoCo {MUJOCO_VERSIONS[SUM_RULE]}"
        if without_margin(spec)[1] == SUM_RULE
        else ""
    )
    return Evaluation(str(path), env_id, returns, [episode.length for episode in episode_stats], scores, physics)


def _registered(env_id: str, path: Path) -> str:
    """Return a policy file's `env_id` without the module before its colon, which Gymnasium would import."""
    module, _, name = env_id.rpartition(":")
    if module and is_trusting():
        return env_id
    if module and name not in gym.registry:
        raise OffbenchError(
            f"{path} names its environment as {env_id!r}, and a module that a file names is not imported; "
            f"give the recipe of the environment with --env, or {REMEDY}"
        )
    return name


def open_policy(path: Path, env: str | Path | None = None) -> tuple[Policy, RunConfig | None, str]:
    """Return the policy of a run's folder or a policy file, the run's config and the policy's EnvSpec.

    The config is None for a policy file that is not in a run's folder.

    Args:
        env: a recipe's name or file, instead of the environment that the run or policy names.

    Raises:
        OffbenchError: there is no run or policy, or it does not fit the environment.
    """
    policy, run = load_policy(path), Run(path if path.is_dir() else path.parent)
    of_run = path.is_dir() or (path == run.policy_path and run.config_path.exists())
    config = run.config() if of_run else None
    if env is not None:
        spec = load_recipe(env).env_spec()
    elif config is not None and config.env_spec is not None:
        spec = config.env_spec
    elif policy.env_id:
        spec = env_spec(_registered(policy.env_id, path))
    else:
        raise OffbenchError(f"{path} names no environment; give one with --env")
    dim = len(policy.observation_mean)
    check_spec(spec, str(path), dim, policy.low, policy.high, from_recipe=env is not None)
    if env is None and config and (changed := describe_changes(config.env_code, environment_code(spec))):
        warn(f"the code of {path}'s environment has changed since it was trained: {changed}")
    return policy, config, spec
