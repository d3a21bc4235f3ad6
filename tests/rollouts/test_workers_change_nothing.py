"""Recording: the same content for any number of workers, and after any cut."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

import offbench
from offbench.common import seeds
from offbench.common.errors import OffbenchError
from offbench.common.processes import uninterrupted_start
from offbench.common.seeds import Purpose
from offbench.data import minari_store
from offbench.data.recording import cut_at
from offbench.envs.environments import env_spec, make_env
from offbench.rollouts.policy import uniform_policy
from offbench.rollouts.rollouts import (
    PARALLEL_EPISODES,
    Episode,
    EpisodeStats,
    EpisodeTask,
    Rollouts,
    gather,
    play,
    summary,
)

SUMS_MARGINS = tuple(map(int, mujoco.__version__.split(".")[:2])) >= (3, 5)
POLE = env_spec("InvertedPendulum-v5")
BOUNDS = np.full(3, -1, np.float32), np.full(3, 1, np.float32)


def test_content_is_the_same_for_any_number_of_workers(tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    hashes = []
    for workers in (1, 2, 3):
        name = offbench.collect(
            recipe, "expert", steps=3000, behaviour_dir=behaviour_dir, workers=workers, dataset_id=f"w{workers}-v0"
        )
        hashes.append(minari_store.read_provenance(minari_store.read_metadata(name)).content_sha256)
    assert len(set(hashes)) == 1


def test_another_seed_gives_other_content(tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    hashes = {
        minari_store.read_provenance(
            minari_store.read_metadata(
                offbench.collect(
                    recipe, "expert", seed=seed, behaviour_dir=behaviour_dir, workers=1, dataset_id=f"s{seed}-v0"
                )
            )
        ).content_sha256
        for seed in (0, 1)
    }
    assert len(hashes) == 2


def plain(env_id: str) -> gym.Env:
    """Return Gymnasium's environment, contact margins halved where MuJoCo adds those of two geoms."""
    env = gym.make(env_id)
    if SUMS_MARGINS and hasattr(env.unwrapped, "model"):
        env.unwrapped.model.geom_margin *= 0.5
    return env


def test_an_episode_equals_one_played_by_hand_with_gymnasium() -> None:
    """Episode 11 of a task of 20, replayed alone in an environment of its own from its seeds."""
    spec, policy = env_spec("Hopper-v5"), uniform_policy(*BOUNDS, 11, "Hopper-v5")
    episodes = play(EpisodeTask(spec, policy.to_bytes(), 5, (2,), tuple(range(20)), False))
    episode = episodes[11]
    assert isinstance(episode, Episode)
    env = plain("Hopper-v5")
    observation, _ = env.reset(seed=seeds.integer(5, Purpose.RESET, 2, 11))
    rng = seeds.generator(5, Purpose.ACTION, 2, 11)
    noise = rng.uniform(-1, 1, (len(episode), 3))
    np.testing.assert_array_equal(observation, episode.observations[0])
    for t, action in enumerate(noise.astype(np.float32)):
        observation, reward, terminated, truncated, _ = env.step(action)
        np.testing.assert_array_equal(action, episode.actions[t])
        np.testing.assert_array_equal(observation, episode.observations[t + 1])
        assert reward == episode.rewards[t]
    assert (terminated, truncated) == (episode.terminated, episode.truncated)


def test_more_episodes_than_lanes_keep_their_order() -> None:
    spec, policy = env_spec("Hopper-v5"), uniform_policy(*BOUNDS, 11, "Hopper-v5")
    indices = tuple(range(PARALLEL_EPISODES * 2 + 3))
    together = play(EpisodeTask(spec, policy.to_bytes(), 0, (), indices, False))
    for index in indices[::5]:
        (alone,) = play(EpisodeTask(spec, policy.to_bytes(), 0, (), (index,), False))
        assert isinstance(alone, Episode)
        np.testing.assert_array_equal(alone.observations, together[index].observations)  # type: ignore[union-attr]


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5", "Pendulum-v1"])
def test_a_made_environment_is_gymnasiums(env_id: str) -> None:
    """Over a reset in mid-episode too: whether a walker is healthy is remembered for one step alone."""
    ours, theirs = make_env(env_spec(env_id)), plain(env_id)
    theirs.action_space.seed(0)
    for seed, length in ((0, 5), (1, 400)):
        np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
        for _ in range(length):
            action = theirs.action_space.sample()
            one, other = ours.step(action), theirs.step(action)
            np.testing.assert_array_equal(one[0], other[0])
            assert one[1:4] == other[1:4]
            if one[2] or one[3]:
                break
    ours.close()
    theirs.close()


def test_a_walker_works_out_once_a_step_whether_it_is_healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    healthy = HopperEnv.is_healthy.fget  # type: ignore[attr-defined]
    monkeypatch.setattr(HopperEnv, "is_healthy", property(lambda env: asked.append(True) or healthy(env)))
    env = make_env(env_spec("Hopper-v5"))
    env.reset(seed=0)
    for steps in range(1, 4):
        env.step(np.zeros(3))
        assert len(asked) == steps
    env.close()


@pytest.mark.parametrize("workers", [0, 2])
def test_no_more_episodes_are_played_than_are_likely_to_be_wanted(
    workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, policy, enough = env_spec("Hopper-v5"), uniform_policy(*BOUNDS, 11, "Hopper-v5"), 8000
    begun: list[int] = []
    call = Rollouts.call
    monkeypatch.setattr(Rollouts, "call", lambda self, do, task: begun.extend(task.indices) or call(self, do, task))
    found = []
    for told in (None, enough):
        begun.clear()
        with (
            Rollouts(spec, workers) as rollouts,
            contextlib.closing(rollouts.episodes(policy, 0, transitions_needed=told)) as endless,
        ):
            found.append([episode.observations for episode in cut_at(endless, enough)])
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))
    assert begun == list(range(len(begun)))
    assert len(begun) - len(found[1]) < PARALLEL_EPISODES  # some 360 are wanted


def test_the_last_episode_is_cut_and_truncated() -> None:
    spec, policy = env_spec("Hopper-v5"), uniform_policy(*BOUNDS, 11, "Hopper-v5")
    with Rollouts(spec) as rollouts:
        whole = list(itertools.islice(rollouts.episodes(policy, 0), 8))
        total = sum(map(len, whole[:3])) + 1
        cut = list(cut_at(iter(whole), total))
    assert sum(map(len, cut)) == total
    assert len(cut) == 4
    assert (cut[-1].terminated, cut[-1].truncated) == (False, True)
    assert cut[-1].observations.shape == (2, 11)
    assert all(episode.terminated for episode in cut[:-1])


def test_sigterm_to_all_processes_leaves_evaluations_to_the_parent() -> None:
    """Slurm sends it so; the parent saves a checkpoint, and that waits for the evaluations under way."""
    policy = uniform_policy(np.full(1, -3, np.float32), np.full(1, 3, np.float32), 4, "InvertedPendulum-v5")
    with Rollouts(POLE, workers=2) as rollouts:
        gather(rollouts.start_evaluation(policy, 0, (), 1, True))
        futures = rollouts.start_evaluation(policy, 0, (), 400, False)
        assert rollouts._pool is not None
        for pid in rollouts._pool._processes:
            os.kill(pid, signal.SIGTERM)
        assert len(gather(futures)) == 400


def test_a_killed_worker_ends_those_beside_it() -> None:
    policy = uniform_policy(np.full(1, -3, np.float32), np.full(1, 3, np.float32), 4, "InvertedPendulum-v5")
    with Rollouts(POLE, workers=2) as rollouts:
        gather(rollouts.start_evaluation(policy, 0, (), 100, False))
        assert rollouts._pool is not None
        first, *beside = rollouts._pool._processes
        futures = rollouts.start_evaluation(policy, 0, (), 4000, False)
        os.kill(first, signal.SIGKILL)
        with pytest.raises(OffbenchError, match="a worker process died"):
            gather(futures)
        began = time.monotonic()
    assert beside
    assert time.monotonic() - began < 30


def test_leaving_the_pool_ends_what_is_being_played() -> None:
    policy = uniform_policy(*BOUNDS, 11, "Hopper-v5")
    with Rollouts(env_spec("Hopper-v5"), workers=1) as rollouts:
        assert len(gather(rollouts.start_evaluation(policy, 0, (), 1, False))) == 1
        many = EpisodeTask(rollouts.env_spec, policy.to_bytes(), 0, (), tuple(range(10**6)), False)
        future = rollouts.call(play, many)
        while not future.running():
            time.sleep(0.01)
    assert isinstance(future.exception(timeout=0), CancelledError)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_that_another_thread_takes_waits_until_a_worker_has_started(stop: signal.Signals) -> None:
    release, started = threading.Event(), list[bool]()
    other = threading.Thread(target=release.wait)
    before = signal.signal(stop, signal.default_int_handler)

    def start() -> None:
        with uninterrupted_start():
            os.kill(os.getpid(), stop)
            time.sleep(0.2)
            started.append(True)

    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            start()
    finally:
        signal.signal(stop, before)
        release.set()
        other.join()
    assert started


@pytest.mark.slow
def test_workers_end_when_their_parent_is_killed(tiny: tuple[str, str], home: Path) -> None:
    recipe, behaviour_dir = tiny
    words = ["collect", recipe, "--level", "random", "--steps", "3000000", "--behaviour-dir", behaviour_dir]
    parent = subprocess.Popen([sys.executable, "-m", "offbench", *words, "--workers", "2"])
    children: list[int] = []
    deadline = time.monotonic() + 60
    while len(children) < 2 and time.monotonic() < deadline:
        time.sleep(0.2)
        children = _children(parent.pid)
    parent.kill()
    parent.wait()
    assert len(children) >= 2
    while any(_alive(pid) for pid in children) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not any(_alive(pid) for pid in children)
    assert minari_store.local_ids() == []


def _children(pid: int) -> list[int]:
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in path.read_text().split()] if path.exists() else []


def _alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    return status.exists() and "State:\tZ" not in status.read_text()


def test_small_returns_keep_their_digits() -> None:
    """References of an environment whose rewards are tiny; those of others have four decimals."""
    small = summary([EpisodeStats(1.23456e-5, 3), EpisodeStats(1.23456e-5, 4)])
    assert small == {"return": 1.2346e-5, "low": 1.2346e-5, "high": 1.2346e-5, "length": 3.5}
    assert summary([EpisodeStats(3421.123456, 3), EpisodeStats(3421.123456, 3)])["return"] == 3421.1235
