"""`evaluate`: play a run or a policy file in its environment."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from offbench.agents.ladder import shipped_references
from offbench.common.errors import OffbenchError
from offbench.common.files import write_json
from offbench.common.processes import default_workers
from offbench.common.scores import interval, normalize
from offbench.common.seeds import Purpose, generator
from offbench.common.text import counted
from offbench.envs.contact_margin import ADDED, SINCE, without_margin
from offbench.envs.environments import checked_spec, env_spec, same_environment
from offbench.envs.recipes import d4rl_reference, load_recipe
from offbench.envs.trust import REMEDY, is_trusting
from offbench.rollouts.policy import Policy, load_policy
from offbench.rollouts.rollouts import Rollouts, result
from offbench.training.run import Run, RunConfig


@dataclass(frozen=True)
class Evaluation:
    """Returns of some episodes of one policy.

    Attributes:
        returns, lengths: of each episode.
        physics: "", or whose contact margins they were played with, in words.
        scores: mean normalised score by reference ("dataset", "d4rl"), those that are known.
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
        lines = [
            f"{self.policy} in {self.env_id}{self.physics}: {counted(len(self.returns), 'episode')}",
            f"return {mean:.1f} (95% interval {low:.1f} to {high:.1f}), std {np.std(self.returns):.1f}, "
            f"length {np.mean(self.lengths):.0f}",
        ]
        names = {"dataset": "own reference: random and expert of this environment", "d4rl": "D4RL's constants"}
        return lines + [f"normalized score {score:.1f} ({names[key]})" for key, score in self.scores.items()]


def evaluate(
    path: str | Path,
    *,
    env: str | None = None,
    episodes: int = 10,
    seed: int = 0,
    stochastic: bool = False,
    workers: int | None = None,
) -> Evaluation:
    """Play episodes of a run's policy, or of a policy file.

    Args:
        path: a run directory, or a policy file (.safetensors).
        env: a recipe's name or file, instead of the environment that the run or policy names.
        seed: of the episodes.
        stochastic: sample actions (policies that can) instead of taking the mode.
        workers: processes (default: one a core).

    Raises:
        OffbenchError: no run or policy there, or it does not fit the environment.
    """
    if episodes < 1:
        raise OffbenchError(f"episodes must be at least 1, not {episodes}")
    path = Path(path)
    policy, config, spec = open_policy(path, env)
    if stochastic and not policy.stochastic:
        raise OffbenchError(f"{path} cannot sample its actions; leave out --stochastic")
    workers = default_workers(workers)
    with Rollouts(spec, workers if workers > 1 else 0) as rollouts:
        future = rollouts.outcomes(policy, seed, (int(Purpose.REFERENCE), 2), episodes, not stochastic)
        outcomes = result(future)
    returns = [outcome.ret for outcome in outcomes]
    played = json.loads(spec)["id"]
    # a run's own references hold for its own environment alone
    if config is not None and same_environment(config.env_spec, spec):
        references = config.references
    else:
        references = {"dataset": shipped_references(spec), "d4rl": d4rl_reference(spec)}
    scores = {key: normalize(float(np.mean(returns)), *pair) for key, pair in references.items() if pair}
    physics = f" with contact margins as in MuJoCo {SINCE[ADDED]}" if without_margin(spec)[1] == ADDED else ""
    return Evaluation(str(path), played, returns, [o.length for o in outcomes], scores, physics)


def similarity(
    path: str | Path,
    *,
    tolerance: float = 0.05,
    action_tolerance: float = 0.1,
    samples: int = 2560,
    seed: int = 0,
) -> dict[str, Any]:
    """Return a run's similar score in both readings, in percent, and write it to the run's similarity.json.

    The BDB paper's Table 2 gives no formula; its numbers count samples of a batch of 256 that pass a yes/no test
    "based on the current Q-value". Our reading:

        q_similar       |Q1(s, pi(s)) - Q1(s, a)| <= tolerance |Q1(s, a)|
        action_similar  root mean square of pi(s) - a over the dimensions <= action_tolerance, actions in [-1, 1]

    Args:
        samples: transitions drawn from the run's dataset (ten batches of 256).

    Raises:
        OffbenchError: no run or checkpoint there, or the algorithm has no critic.
    """
    import torch  # `evaluate` alone does without

    from offbench.algorithm.networks import Network
    from offbench.training.train import restore

    run = Run(Path(path))
    stack = restore(run)
    critic = stack.algorithm.learned.get("critic")
    if not isinstance(critic, Network):
        raise OffbenchError(f"{path}: {run.config().algorithm} has no critic to compare by")
    rng = generator(seed, Purpose.SAMPLE)
    batch = stack.store.batch(torch.from_numpy(rng.integers(stack.store.sizes[0], size=(1, samples))))
    policy = stack.policy(0)
    dim, act = len(policy.observation_mean), len(policy.low)
    policy = dataclasses.replace(  # acts on normalised observations, in [-1, 1], as the critic sees them
        policy,
        observation_mean=np.zeros(dim, np.float32),
        observation_std=np.ones(dim, np.float32),
        low=-np.ones(act, np.float32),
        high=np.ones(act, np.float32),
    )
    noise = policy.draw(rng, samples) if policy.needs_noise(deterministic=True) else None
    pi = torch.from_numpy(policy.act(batch.observations[0].numpy(), noise)).unsqueeze(0)
    q_pi, q_data = (critic.frozen(batch.observations, a, members=0).flatten() for a in (pi, batch.actions))
    distance = (pi - batch.actions).square().mean(-1).sqrt().flatten()
    found = {
        "step": stack.step,
        "samples": samples,
        "q_similar": 100 * float(((q_pi - q_data).abs() <= tolerance * q_data.abs()).float().mean()),
        "tolerance": tolerance,
        "action_similar": 100 * float((distance <= action_tolerance).float().mean()),
        "action_tolerance": action_tolerance,
    }
    write_json(run.folder / "similarity.json", found)
    return found


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


def open_policy(path: Path, env: str | None = None) -> tuple[Policy, RunConfig | None, str]:
    """Return the policy of a run's folder or a policy file, the run's config (None for a file) and its EnvSpec.

    Args:
        env: a recipe's name or file, instead of the environment that the run or policy names.

    Raises:
        OffbenchError: no run or policy there, or it does not fit the environment.
    """
    config = None
    if path.is_dir():
        run = Run(path)
        config = run.config()
        if not run.policy_path.exists():
            raise OffbenchError(f"{path} has no policy yet; train it to its first checkpoint")
        policy = load_policy(run.policy_path)
    else:
        policy = load_policy(path)
    if env is not None:
        text = load_recipe(env).env_spec()
    elif config is not None and config.env_spec is not None:
        text = config.env_spec
    elif policy.env_id:
        text = env_spec(_registered(policy.env_id, path))
    else:
        raise OffbenchError(f"{path} names no environment; give one with --env")
    return policy, config, checked_spec(text, str(path), len(policy.observation_mean), policy.low, policy.high)
