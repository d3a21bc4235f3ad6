"""Episodes by seed: the one mechanism that records datasets and evaluates policies.

    episodes 0 1 2 3 ... --> tasks of a few episodes --> worker processes --> episodes in order
    in a worker: up to LANES episodes step in turn, so one policy forward serves them all

Episode i is reset with integer(seed, RESET, *stream, i) and acts with generator(seed, ACTION, *stream, i), so
neither the number of workers nor the task it fell into can change it. Workers never import PyTorch.
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
from offbench.common.processes import closing, quiet_start, start_errors, start_worker
from offbench.common.scores import interval
from offbench.common.seeds import Purpose
from offbench.envs.environments import LONGEST, Env, make_env, reason, time_limit
from offbench.rollouts.function_policy import MARK, FunctionPolicy, from_mark
from offbench.rollouts.policy import Policy, from_bytes

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
LANES = 16  # episodes that share a policy forward, and of a task
LAST_TASK = 4  # near the end of a recording, where large tasks would leave workers idle
NOISE_BLOCK = 1024  # actions whose noise is drawn at once


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        seed: what the environment was reset with.
        observations: [T + 1, obs], in the environment's own precision; the last one has no action.
        actions: [T, act] float32, in the environment's bounds.
        rewards: [T] float64.
        terminated, truncated: how it ended, Gymnasium's meaning.
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
class Task:
    """A few episodes of one policy, as a worker gets them."""

    spec: str
    policy: bytes
    seed: int
    stream: tuple[int, ...]
    indices: tuple[int, ...]
    deterministic: bool


@dataclass(frozen=True)
class Outcome:
    """What evaluations keep of an episode."""

    ret: float
    length: int


MEASURES = ("return", "low", "high", "length")


def summary(outcomes: list[Outcome], prefix: str = "") -> dict[str, float]:
    """Return mean return, its 95% interval and mean length."""
    mean, low, high = interval([o.ret for o in outcomes])
    length = float(np.mean([o.length for o in outcomes]))
    values = {"return": mean, "low": low, "high": high, "length": length}
    return {prefix + key: round(value, 4) for key, value in values.items()}


class _Lane:
    """One environment in the middle of an episode."""

    def __init__(self, env: Env, policy: Policy | FunctionPolicy, task: Task, slot: int) -> None:
        index = task.indices[slot]
        self.env, self.policy, self.slot = env, policy, slot
        self.seed = seeds.integer(task.seed, Purpose.RESET, *task.stream, index)
        self.rng = seeds.generator(task.seed, Purpose.ACTION, *task.stream, index)
        self.limit = time_limit(env.spec) or LONGEST
        self.observations = [reset(env, self.seed)]
        self.actions: list[Array] = []
        self.rewards: list[float] = []
        self.noise: Array = np.empty((0, 0))

    def next_noise(self) -> Array:
        # fewer where each takes many numbers, which are the same in blocks of any size
        block = max(1, NOISE_BLOCK // getattr(self.policy, "samples", 1))
        position = len(self.actions) % block
        if position == 0:
            self.noise = self.policy.draw(self.rng, block)
        row: Array = self.noise[position]
        return row

    def step(self, action: Array) -> Episode | None:
        """Take one step; return the whole episode if it was the last one."""
        observation, reward, terminated, truncated = step(self.env, action)
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


def reset(env: Env, seed: int | None) -> Array:
    """Return a copy of an episode's first observation. Raises OffbenchError if the environment fails; it is named."""
    try:
        return _observation(env, env.reset(seed=seed)[0])
    except Exception as error:
        raise _failed(env, error) from error


def step(env: Env, action: Array) -> tuple[Array, float, bool, bool]:
    """Return a copy of the next observation, the reward, whether it terminated and whether it was truncated.

    Raises:
        OffbenchError: the environment fails; it is named.
    """
    try:
        observation, reward, terminated, truncated, _ = env.step(action)
        return _observation(env, observation), number(reward), bool(terminated), bool(truncated)
    except Exception as error:
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


class Named(gym.Wrapper[Array, Array, Array, Array]):
    """An environment whose failures, NaN among them, are OffbenchErrors that name it."""

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


def number(reward: SupportsFloat) -> float:
    """Return a reward as a number; an array of one element counts as one. Raises ValueError for any other."""
    if isinstance(reward, np.ndarray):
        if reward.size != 1:
            raise ValueError(f"the reward is an array of shape {reward.shape}, not a number")
        reward = reward.item()
    return float(reward)


def _failed(env: Env, error: Exception) -> Exception:
    """Return what to raise for an exception of an environment."""
    if isinstance(error, OffbenchError | MemoryError):
        return error
    what = f"{type(error).__name__}: {reason(error)}"
    return OffbenchError(f"the environment {_name(env)} failed: {what} ({SHOW_TRACEBACK})")


def _name(env: Env) -> str:
    return env.spec.id if env.spec else type(env.unwrapped).__name__


def play(task: Task) -> list[Episode]:
    """Play a task's episodes and return them in its order."""
    return _play(task, lambda episode: episode)


def play_outcomes(task: Task) -> list[Outcome]:
    """Play a task's episodes and return what evaluations keep of them."""
    return _play(task, lambda episode: Outcome(float(episode.rewards.sum()), len(episode)))


def _play(task: Task, keep: Callable[[Episode], T]) -> list[T]:
    policy = _policy(task.policy)
    noisy = policy.needs_noise(task.deterministic)
    envs = kept_envs(task.spec, min(LANES, len(task.indices)))
    waiting = iter(range(len(task.indices)))
    lanes = [_Lane(env, policy, task, slot) for env, slot in zip(envs, waiting, strict=False)]
    done: dict[int, T] = {}
    while lanes:
        if closing():
            raise CancelledError
        observations = np.array([lane.observations[-1] for lane in lanes])
        noise = np.array([lane.next_noise() for lane in lanes]) if noisy else None
        actions = policy.act(observations, noise)
        going = []
        for lane, action in zip(lanes, actions, strict=True):
            episode = lane.step(action)
            if episode is None:
                going.append(lane)
                continue
            done[lane.slot] = keep(episode)
            slot = next(waiting, None)
            if slot is not None:
                going.append(_Lane(lane.env, policy, task, slot))
        lanes = going
    return [done[slot] for slot in range(len(task.indices))]


@functools.lru_cache(maxsize=4)
def _policy(data: bytes) -> Policy | FunctionPolicy:
    return from_mark(data) if data.startswith(MARK) else from_bytes(data)


@functools.lru_cache(maxsize=4)
def _pool_of_envs(spec: str) -> list[Env]:
    return []


def kept_envs(spec: str, count: int) -> list[Env]:
    """Return `count` environments of this process, made once and kept."""
    pool = _pool_of_envs(spec)
    while len(pool) < count:
        try:
            pool.append(make_env(spec))
        except Exception as error:  # a worker may lack what the process that started it has
            raise OffbenchError(f"cannot make an environment in a worker process: {reason(error)}") from error
    return pool[:count]


class Rollouts:
    """Plays episodes of one environment, in this process (workers = 0) or in a pool of worker processes.

    Use as a context manager. Results do not depend on `workers`.
    """

    def __init__(self, spec: str, workers: int = 0) -> None:
        self.spec, self.workers = spec, workers
        self._pool: ProcessPoolExecutor | None = None
        if workers:
            context = multiprocessing.get_context("spawn")
            with start_errors():
                self._closing = context.RawValue("b", 0)  # no lock, which a killed worker could hold for ever
                self._pool = ProcessPoolExecutor(workers, context, start_worker, (os.getpid(), self._closing))

    def __enter__(self) -> Rollouts:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool:
            self._closing.value = 1  # saves a second of episodes that are not needed
            self._pool.shutdown(wait=True, cancel_futures=True)

    def call(self, function: Callable[[*Ts], T], *arguments: *Ts) -> Future[T]:
        """Start a module's function in a worker process, or run it now if there is none."""
        if self._pool:
            with quiet_start():
                try:
                    return self._pool.submit(function, *arguments)
                except BrokenProcessPool:
                    raise _worker_died() from None
        future: Future[T] = Future()
        future.set_result(function(*arguments))
        return future

    def episodes(
        self, policy: Policy | FunctionPolicy, seed: int, stream: tuple[int, ...] = (), enough: int | None = None
    ) -> Generator[Episode, None, None]:
        """Yield episodes 0, 1, 2, ... of the sampling policy without end, in order. Close the iterator when done.

        Args:
            enough: the number of transitions that the caller needs: near it, tasks become small, and no episode
                starts that is unlikely to be needed.
        """
        data, ahead = policy.to_bytes(), 1 if not self._pool else 2 * self.workers + 1
        pending: collections.deque[Future[list[Episode]]] = collections.deque()
        begun = done = steps = 0
        try:
            while True:
                while len(pending) < ahead:
                    size = LANES
                    if enough is not None and done:
                        wanted = (enough - steps) * done / steps - (begun - done)  # if all are as long as those so far
                        if wanted <= 0 and pending:
                            break
                        size = min(size, max(LAST_TASK, math.ceil(wanted / ahead)))
                    indices = tuple(range(begun, begun + size))
                    pending.append(self.call(play, Task(self.spec, data, seed, stream, indices, False)))
                    begun += size
                for episode in result(pending.popleft()):
                    done, steps = done + 1, steps + len(episode)
                    yield episode
        finally:
            for future in pending:
                future.cancel()

    def outcomes(
        self, policy: Policy | FunctionPolicy, seed: int, stream: tuple[int, ...], count: int, deterministic: bool
    ) -> list[Future[list[Outcome]]]:
        """Start `count` evaluation episodes; `gathered` waits for their returns and lengths, in order."""
        data, parts = policy.to_bytes(), max(1, min(self.workers, count // 2))  # a task per worker, if they suffice
        tasks = (
            Task(self.spec, data, seed, stream, tuple(chunk.tolist()), deterministic)
            for chunk in np.array_split(np.arange(count), parts)
        )
        return [self.call(play_outcomes, task) for task in tasks]


def result(future: Future[T]) -> T:
    """Return a task's result; a worker that was killed becomes a clear line."""
    try:
        return future.result()
    except BrokenProcessPool:
        raise _worker_died() from None


def gathered(futures: Iterable[Future[list[T]]]) -> list[T]:
    """Return the results of several tasks, end to end."""
    return [item for future in futures for item in result(future)]


def _worker_died() -> OffbenchError:
    return OffbenchError(
        "a worker process died (killed, or out of memory); run the same command again, with fewer --workers"
    )
