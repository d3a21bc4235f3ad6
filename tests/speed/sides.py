"""offbench's sides and those of the libraries it is built on. Run as `python -m tests.speed.sides NAME key=value`."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.speed.side import Work, serve

if TYPE_CHECKING:
    from offbench.training.stack import Stack

ENV = "hopper"
ARITHMETIC = contextlib.ExitStack()  # what trainings set; left as this process ends


def train(
    algorithm: str, runs: str = "1", rows: str = "100000", hidden: str = "256,256", precision: str = "float32"
) -> Work:
    """Updates of a stack; a unit is one run's update."""
    stack = stack_of(algorithm, int(runs), int(rows), hidden, precision)
    few = 5 if algorithm == "cql" else 100

    def work() -> int:
        stack.train(stack.step + few)
        return few * len(stack.specs)

    return work


def stack_of(
    algorithm: str, runs: int = 1, rows: int = 100_000, hidden: str = "256,256", precision: str = "float32"
) -> Stack:
    """A stack on random transitions of hopper's shapes."""
    from offbench.benchmarks.throughput import random_stack
    from offbench.common.settings import build
    from offbench.envs.recipes import load_recipe
    from offbench.training.devices import matmul_settings
    from offbench.training.registry import load_algorithm

    ARITHMETIC.enter_context(matmul_settings("cpu", precision))
    kind = load_algorithm(algorithm)
    config: Any = build(kind.Config, {"hidden": hidden} | ({"bc_steps": 0} if algorithm == "cql" else {}), algorithm)
    return random_stack(kind, [config] * runs, load_recipe(ENV).env_spec(), rows=rows)


def record(workers: str) -> Work:
    """`offbench collect`, from the command to the Minari dataset; a unit is one transition."""
    from offbench.data.collect import collect

    def work() -> int:
        collect(ENV, "medium", steps=200_000, workers=int(workers), overwrite=True)
        return 200_000

    return work


def sb3_collector() -> Work:
    """A loop of SB3's predict over Minari's DataCollector, the same policy; a unit is one transition."""
    import gymnasium as gym
    from minari import DataCollector

    model = sb3_model("medium")
    env = DataCollector(gym.make("Hopper-v5"))
    numbers = itertools.count()

    def work() -> int:
        done = 0
        while done < 3000:
            observation, _ = env.reset(seed=next(numbers))
            over = False
            while not over:
                action, _ = model.predict(observation, deterministic=False)
                observation, _, terminated, truncated, _ = env.step(action)
                done, over = done + 1, terminated or truncated
        name = f"loop{next(numbers)}-v0"
        env.create_dataset(dataset_id=name, algorithm_name="SAC", description="a loop", eval_env="Hopper-v5")
        shutil.rmtree(Path(os.environ["MINARI_DATASETS_PATH"]) / name)
        return done

    return work


def sb3_model(level: str) -> Any:
    """An SB3 agent with the weights of a shipped policy."""
    import torch
    from stable_baselines3 import SAC

    from offbench.agents.ladder import read_ladder
    from offbench.envs.recipes import load_recipe

    torch.set_num_threads(1)
    recipe = load_recipe(ENV)
    assert recipe.folder is not None
    ladder = read_ladder(recipe.folder / "behaviour")
    assert ladder is not None
    policy = ladder.load(ladder.role(level))
    model = SAC("MlpPolicy", recipe.env_id, buffer_size=10, policy_kwargs={"net_arch": [256, 256]}, device="cpu")
    actor: Any = model.policy.actor
    *hidden, (weight, bias) = policy.layers
    halves = [(weight[:, :3], bias[:3]), (weight[:, 3:], bias[3:])]
    with torch.no_grad():
        for layer, (w, b) in zip(
            [actor.latent_pi[0], actor.latent_pi[2], actor.mu, actor.log_std], [*hidden, *halves], strict=True
        ):
            layer.weight.copy_(torch.tensor(w).T)
            layer.bias.copy_(torch.tensor(b))
    return model


def physics(workers: str) -> Work:
    """mj_step alone, in so many processes, along recorded episodes; a unit is one step of the environment."""
    from offbench.data.collect import collect

    name = collect(ENV, "medium", steps=2000, workers=1, overwrite=True, dataset_id="physics-v0")
    count = int(workers)
    go, done = multiprocessing.Semaphore(0), multiprocessing.Queue()  # type: ignore[var-annotated]
    for _ in range(count):
        multiprocessing.Process(target=_physics, args=(name, go, done), daemon=True).start()

    def work() -> int:
        for _ in range(count):
            go.release()
        return sum(done.get() for _ in range(count))

    return work


def _physics(name: str, go: Any, done: Any) -> None:
    import gymnasium as gym
    import minari
    import mujoco

    env: Any = gym.make("Hopper-v5").unwrapped
    model, data = env.model, env.data
    episodes = list(minari.load_dataset(name).iterate_episodes())
    while go.acquire():
        steps = 0
        for episode in episodes:
            env.reset(seed=int(episode.seed) if hasattr(episode, "seed") else 0)
            for action in episode.actions:
                data.ctrl[:] = action
                mujoco.mj_step(model, data, nstep=env.frame_skip)
            steps += len(episode.actions)
        done.put(steps)


def load_cached(dataset_id: str) -> Work:
    """offbench.load of a dataset that is in the cache, every number read; a unit is one load."""
    import offbench

    def work() -> int:
        data = offbench.load(dataset_id)
        for array in (data.observations, data.rows, data.actions, data.rewards, data.masks):
            array.sum()
        return 1

    return work


def load_unchecked(dataset_id: str) -> Work:
    """The same without what notices a changed cache and a dataset that is replaced while it is read."""
    from offbench.data import file_stamps, transitions

    def unchecked(_: object, recorded: dict[str, object]) -> dict[str, object]:
        return recorded

    known = file_stamps.dataset_stamps(dataset_id)
    file_stamps.dataset_stamps = lambda _: known
    transitions.check_files = unchecked  # type: ignore[assignment]
    return load_cached(dataset_id)


def load_minari(dataset_id: str) -> Work:
    """Minari's iterate_episodes over the same dataset, every number read; a unit is one load."""
    import minari

    def work() -> int:
        for episode in minari.load_dataset(dataset_id).iterate_episodes():
            for array in (episode.observations, episode.actions, episode.rewards, episode.terminations):
                array.sum()
        return 1

    return work


def evaluate(workers: str, episodes: str = "20") -> Work:
    """offbench's evaluation of the expert; a unit is one episode."""
    from offbench.agents.ladder import read_ladder
    from offbench.envs.recipes import load_recipe
    from offbench.rollouts.rollouts import Rollouts, gather

    recipe = load_recipe(ENV)
    assert recipe.folder is not None
    ladder = read_ladder(recipe.folder / "behaviour")
    assert ladder is not None
    policy = ladder.load(ladder.role("expert"))
    rollouts = Rollouts(recipe.env_spec(), int(workers))
    numbers = itertools.count()

    def work() -> int:
        return len(gather(rollouts.start_evaluation(policy, next(numbers), (0,), int(episodes), True)))

    return work


def sb3_evaluate(episodes: str = "5") -> Work:
    """SB3's evaluate_policy of the same expert; a unit is one episode."""
    import gymnasium as gym
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    model, env = sb3_model("expert"), Monitor(gym.make("Hopper-v5"))

    def work() -> int:
        evaluate_policy(model, env, n_eval_episodes=int(episodes))
        return int(episodes)

    return work


SIDES: dict[str, Callable[..., Work]] = {
    side.__name__: side
    for side in (
        train,
        record,
        sb3_collector,
        physics,
        load_cached,
        load_unchecked,
        load_minari,
        evaluate,
        sb3_evaluate,
    )
}

if __name__ == "__main__":
    serve(SIDES[sys.argv[1]])
