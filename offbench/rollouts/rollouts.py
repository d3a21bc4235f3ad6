"""Seeded episodes, by which datasets are recorded and policies are evaluated.

    episodes 0 1 2 3 ... --> tasks of a few episodes --> worker processes --> episodes in order
    in a worker: up to PARALLEL_EPISODES episodes advance together, with one forward pass of the policy for all

Episode i is reset with integer(seed, RESET, *stream, i) and acts with generator(seed, ACTION, *stream, i), so
it depends neither on the number of workers nor on its task. Workers never import PyTorch.
"""

from __future__ import annotations

import collections
import functools
import math
import multiprocessing
import os
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import SupportsFloat, TypeVar, TypeVarTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from offbench.common import seeds
from offbench.common.arrays import Array
from offbench.common.errors import SHOW_TRACEBACK, OffbenchError
from offbench.common.processes import closing, process_start, start_worker, uninterrupted_start
from offbench.common.scores import interval
from offbench.common.seeds import Purpose
from offbench.envs.environments import MAX_EPISODE_STEPS, Env, box, make_env, reason, time_limit
from offbench.rollouts.function_policy import FunctionPolicy
from offbench.rollouts.policy import Policy, from_bytes

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
PARALLEL_EPISODES = 16  # episodes that share one policy forward pass; also the most episodes of a task
LAST_TASK = 4  # smallest task near the end of a recording, where large ones would leave workers idle
NOISE_BLOCK = 1024  # actions whose noise is drawn at once


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        seed: seed of the environment's reset.
        observations: [T + 1, obs], in the environment's own precision; the last one has no action.
        actions: [T, act], in the environment's bounds and precision.
        rewards: [T] float64.
        terminated, truncated: how it ended, as in Gymnasium.
    """

    seed: int
    observations: Array
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float64]
    terminated: bool
    truncated: bool

    def __len__(self) -> int:
        return len(self.rewards)

    def cut(self, length: int) -> Episode:
        """Return the first `length` steps; an episode cut short is truncated, not terminated."""
        if length >= len(self):
            return self
        observations, actions, rewards = self.observations[: length + 1], self.actions[:length], self.rewards[:length]
        return Episode(self.seed, observations, actions, rewards, False, True)


@dataclass(frozen=True)
class EpisodeTask:
    """A few episodes of one policy: the unit of work of a worker.

    Attributes:
        env_spec: EnvSpec JSON.
        policy: the bytes of a policy file, or a function, which no worker process is given.
        seed, stream: with an episode's index, the seed of the episode.
        indices: episode indices.
    """

    env_spec: str
    policy: bytes | FunctionPolicy
    seed: int
    stream: tuple[int, ...]
    indices: tuple[int, ...]
    deterministic: bool


@dataclass(frozen=True)
class EpisodeStats:
    """The return and the length of an episode."""

    ret: float
    length: int


MEASURES = ("return", "low", "high", "length")


def summary(episode_stats: list[EpisodeStats], prefix: str = "") -> dict[str, float]:
    """Return mean `return`, its 95% interval `low` to `high` and mean `length`, keys prefixed with `prefix`."""
    mean, low, high = interval([stats.ret for stats in episode_stats])
    length = float(np.mean([stats.length for stats in episode_stats]))
    values = {"return": mean, "low": low, "high": high, "length": length}
    # four decimals, or five digits of a small number: rewards may be tiny
    return {prefix + k: round(v, 4) if abs(v) >= 1 else float(f"{v:.5g}") for k, v in values.items()}


class _RunningEpisode:
    """One environment in the middle of an episode."""

    def __init__(self, env: Env, policy: Policy | FunctionPolicy, task: EpisodeTask, slot: int) -> None:
        index = task.indices[slot]
        self.env, self.policy, self.slot = env, policy, slot
        self.seed = seeds.integer(task.seed, Purpose.RESET, *task.stream, index)
        self.rng = seeds.generator(task.seed, Purpose.ACTION, *task.stream, index)
        self.space = box(env.action_space, "actions")
        self.limit = time_limit(env.spec) or MAX_EPISODE_STEPS
        self.observations = [reset(env, self.seed)]
        self.actions: list[Array] = []
        self.rewards: list[float] = []
        self.noise: Array = np.empty((0, 0))

    def next_noise(self) -> Array:
        # fewer where an action takes many samples; the numbers do not depend on the block's size
        block = max(1, NOISE_BLOCK // getattr(self.policy, "samples", 1))
        position = len(self.actions) % block
        if position == 0:
            self.noise = self.policy.draw(self.rng, block)
        row: Array = self.noise[position]
        return row

    def step(self, action: Array) -> Episode | None:
        """Take one step; return the whole episode if it was the last one."""
        action = in_space(action, self.space)
        observation, reward, terminated, truncated = step(self.env, action.copy())  # it may change its copy
        self.observations.append(observation)
        self.actions.append(action)
        self.rewards.append(reward)
        if not (terminated or truncated):
            if len(self.rewards) > self.limit:
                raise OffbenchError(
                    f"an episode of {_name(self.env)} has not ended within {self.limit:,} steps; give the environment "
                    "a time limit (max_episode_steps)"
                )
            return None
        observations, rewards = np.array(self.observations), np.array(self.rewards)
        _check_finite(self.env, observations, rewards)
        # a step that both terminates and runs out of time has terminated: nothing is left to bootstrap from
        ends = (terminated, truncated and not terminated)
        return Episode(self.seed, observations, np.array(self.actions), rewards, *ends)


def in_space(action: Array, space: gym.spaces.Box) -> Array:
    """Return a copy of a policy's action [act] in the precision and the bounds of an action space."""
    action = action.astype(space.dtype)  # policies round to float32, which may be beyond other bounds
    return action if space.dtype == np.float32 else np.clip(action, space.low, space.high)


def reset(env: Env, seed: int | None) -> Array:
    """Return a copy of an episode's first observation. Raises OffbenchError if the environment fails; it is named."""
    try:
        return _observation(env, env.reset(seed=seed)[0])
    except (Exception, SystemExit) as error:
        raise _failed(env, error) from error


def step(env: Env, action: Array) -> tuple[Array, float, bool, bool]:
    """Return a copy of the next observation, the reward, whether it terminated and whether it was truncated.

    Raises:
        OffbenchError: the environment fails; it is named.
    """
    try:
        observation, reward, terminated, truncated, _ = env.step(action)
        return _observation(env, observation), scalar_reward(reward), bool(terminated), bool(truncated)
    except (Exception, SystemExit) as error:
        raise _failed(env, error) from error


def _observation(env: Env, observation: object) -> Array:
    copy = np.array(observation)  # environments may reuse their array
    if copy.shape != env.observation_space.shape:
        raise ValueError(f"an observation has shape {copy.shape}, its space {env.observation_space.shape}")
    return copy


def _check_finite(env: Env, observations: Array, rewards: Array | float) -> None:
    for name, values in (("observation", observations), ("reward", rewards)):
        if not np.isfinite(values).all():
            raise _failed(env, ValueError(f"{name} with NaN or infinite numbers"))


class ErrorReporting(gym.Wrapper[Array, Array, Array, Array]):
    """An environment that raises its failures, NaN values included, as OffbenchErrors with its name."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Array, dict[str, object]]:
        """Reset the environment; `options` are not used."""
        return reset(self.env, seed), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, object]]:
        """Take a step."""
        observation, reward, *ends = step(self.env, action)
        _check_finite(self.env, observation, reward)
        return observation, reward, *ends, {}  # type: ignore[return-value]


def scalar_reward(reward: SupportsFloat) -> float:
    """Return a reward as a number; an array of one element counts as one. Raises ValueError for any other."""
    if isinstance(reward, np.ndarray):
        if reward.size != 1:
            raise ValueError(f"the reward is an array of shape {reward.shape}, not a number")
        reward = reward.item()
    return float(reward)


def _failed(env: Env, error: BaseException) -> Exception:
    """Return what to raise for an exception of an environment."""
    if isinstance(error, OffbenchError | MemoryError):
        return error
    what = f"{type(error).__name__}: {reason(error)}"
    return OffbenchError(f"the environment {_name(env)} failed: {what} ({SHOW_TRACEBACK})")


def _name(env: Env) -> str:
    return env.spec.id if env.spec else type(env.unwrapped).__name__


def play(task: EpisodeTask) -> list[Episode]:
    """Play a task's episodes and return them in its order."""
    return _play(task, lambda episode: episode)


def play_stats(task: EpisodeTask) -> list[EpisodeStats]:
    """Play a task's episodes and return their returns and lengths, in its order."""
    return _play(task, lambda episode: EpisodeStats(float(episode.rewards.sum()), len(episode)))


def _play(task: EpisodeTask, keep: Callable[[Episode], T]) -> list[T]:
    policy = task.policy if isinstance(task.policy, FunctionPolicy) else _policy(task.policy)
    noisy = policy.needs_noise(task.deterministic)
    envs = cached_envs(task.env_spec, min(PARALLEL_EPISODES, len(task.indices)))
    waiting = iter(range(len(task.indices)))
    running = [_RunningEpisode(env, policy, task, slot) for env, slot in zip(envs, waiting, strict=False)]
    done: dict[int, T] = {}
    while running:
        if closing():
            raise CancelledError
        observations = np.array([running_episode.observations[-1] for running_episode in running])
        noise = np.array([running_episode.next_noise() for running_episode in running]) if noisy else None
        actions = policy.act(observations, noise)
        still_running = []
        for running_episode, action in zip(running, actions, strict=True):
            episode = running_episode.step(action)
            if episode is None:
                still_running.append(running_episode)
                continue
            done[running_episode.slot] = keep(episode)
            slot = next(waiting, None)
            if slot is not None:
                still_running.append(_RunningEpisode(running_episode.env, policy, task, slot))
        running = still_running
    return [done[slot] for slot in range(len(task.indices))]


@functools.lru_cache(maxsize=4)
def _policy(data: bytes) -> Policy:
    return from_bytes(data)


@functools.lru_cache(maxsize=4)
def _env_cache(env_spec: str) -> list[Env]:
    return []


def cached_envs(env_spec: str, count: int) -> list[Env]:
    """Return `count` environments of this process, made once and kept."""
    pool = _env_cache(env_spec)
    while len(pool) < count:
        try:
            pool.append(make_env(env_spec))
        except (Exception, SystemExit) as error:  # a worker may lack what the process that started it has
            raise OffbenchError(f"cannot make an environment in a worker process: {reason(error)}") from error
    return pool[:count]


class Rollouts:
    """Plays episodes of one environment, in this process (workers = 0) or in a pool of worker processes.

    Use as a context manager. Results do not depend on `workers`. A FunctionPolicy needs workers = 0.
    """

    def __init__(self, env_spec: str, workers: int = 0) -> None:
        self.env_spec, self.workers = env_spec, workers
        self._pool: ProcessPoolExecutor | None = None
        if workers:
            context = multiprocessing.get_context("spawn")
            with process_start():
                self._closing = context.RawValue("b", 0)  # no lock, which a killed worker could hold for ever
                self._pool = ProcessPoolExecutor(workers, context, start_worker, (os.getpid(), self._closing))

    def __enter__(self) -> Rollouts:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool:
            self._closing.value = 1  # workers stop their unfinished episodes
            self._pool.shutdown(wait=True, cancel_futures=True)

    def call(self, function: Callable[[*Ts], T], *arguments: *Ts) -> Future[T]:
        """Start a module's function in a worker process, or run it now if there is none."""
        if self._pool:
            with uninterrupted_start():
                try:
                    return self._pool.submit(function, *arguments)
                except BrokenProcessPool:
                    raise _worker_died() from None
        future: Future[T] = Future()
        future.set_result(function(*arguments))
        return future

    def episodes(
        self,
        policy: Policy | FunctionPolicy,
        seed: int,
        stream: tuple[int, ...] = (),
        transitions_needed: int | None = None,
    ) -> Generator[Episode, None, None]:
        """Yield episodes 0, 1, 2, ... of the sampling policy without end, in order. Close the iterator when done.

        Args:
            transitions_needed: the number of transitions that the caller needs: near it, tasks become small, and no
                episode starts that is unlikely to be needed.
        """
        ahead = 1 if not self._pool else 2 * self.workers + 1
        data = policy if isinstance(policy, FunctionPolicy) else policy.to_bytes()
        pending: collections.deque[Future[list[Episode]]] = collections.deque()
        begun = done = steps = 0
        try:
            while True:
                while len(pending) < ahead:
                    size = PARALLEL_EPISODES
                    if transitions_needed is not None and done:
                        # if all episodes are as long as those so far
                        wanted = (transitions_needed - steps) * done / steps - (begun - done)
                        if wanted <= 0 and pending:
                            break
                        size = min(size, max(LAST_TASK, math.ceil(wanted / ahead)))
                    indices = tuple(range(begun, begun + size))
                    pending.append(self.call(play, EpisodeTask(self.env_spec, data, seed, stream, indices, False)))
                    begun += size
                for episode in result(pending.popleft()):
                    done, steps = done + 1, steps + len(episode)
                    yield episode
        finally:
            for future in pending:
                future.cancel()

    def start_evaluation(
        self, policy: Policy, seed: int, stream: tuple[int, ...], count: int, deterministic: bool
    ) -> list[Future[list[EpisodeStats]]]:
        """Start `count` evaluation episodes; `gather` waits for their returns and lengths."""
        data, parts = policy.to_bytes(), max(1, min(self.workers, count // 2))  # a task per worker, if they suffice
        tasks = (
            EpisodeTask(self.env_spec, data, seed, stream, tuple(chunk.tolist()), deterministic)
            for chunk in np.array_split(np.arange(count), parts)
        )
        return [self.call(play_stats, task) for task in tasks]

    def evaluate(
        self, policy: Policy, seed: int, stream: tuple[int, ...], count: int, deterministic: bool
    ) -> list[EpisodeStats]:
        """Play `count` evaluation episodes; return their returns and lengths, in order."""
        return gather(self.start_evaluation(policy, seed, stream, count, deterministic))


def result(future: Future[T]) -> T:
    """Return a task's result. Raises OffbenchError if its worker process died."""
    try:
        return future.result()
    except BrokenProcessPool:
        raise _worker_died() from None


def gather(futures: Iterable[Future[list[T]]]) -> list[T]:
    """Return the results of several tasks, concatenated in order."""
    return [item for future in futures for item in result(future)]


def _worker_died() -> OffbenchError:
    return OffbenchError(
        "a worker process died (killed, or out of memory); run the same command again, with fewer --workers"
    )
