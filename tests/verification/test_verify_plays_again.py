"""`verify` plays episodes again: bit for bit on the same physics, within a tolerance on others, or step by step."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
import pytest

from offbench.common.provenance import versions
from offbench.data import minari_store, minari_writer
from offbench.envs.environments import env_spec, make_env
from offbench.rollouts.rollouts import Episode
from offbench.verification.verify import verify
from tests.verification.test_verify import change_metadata, codes, each, hopper, metadata_path, replace, tamper

__all__ = ["hopper"]  # a fixture


def recorded(
    name: str,
    env_id: str,
    change: Callable[[Any], None],
    seeded: bool = True,
    steps: int = 300,
    rng: Any = None,
    **kwargs: Any,
) -> str:
    """Record random actions in an environment that `change` has had its hands on, as if it were the real one."""
    spec = env_spec(env_id, **kwargs)
    env, rng = make_env(spec), rng or np.random.default_rng(0)
    change(env.unwrapped)
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]

    def episodes() -> Iterator[Episode]:
        for seed in range(4):
            observations, actions, rewards, ends = [env.reset(seed=seed)[0].copy()], [], [], (False, False)
            while not any(ends) and len(actions) < steps:
                actions.append(rng.uniform(low, high).astype(np.float32))
                observation, reward, *flags, _ = env.step(actions[-1])
                observations.append(observation.copy())
                rewards.append(float(reward))
                ends = (bool(flags[0]), bool(flags[1]))
            ends = ends if any(ends) else (False, True)
            yield Episode(seed if seeded else -1, np.array(observations), np.array(actions), np.array(rewards), *ends)

    metadata = {"dataset_id": name, "minari_version": versions()["minari"], "offbench": {"versions": versions()}}
    with minari_store.claimed(name, False) as path:
        minari_writer.write(path, episodes(), spec, metadata, 1000, (env.observation_space, env.action_space))
    return name


def nothing(_: Any) -> None:
    pass


def heavier(env: Any) -> None:
    env.model.opt.gravity[2] *= 1.02


def slower(env: Any) -> None:
    env.model.opt.timestep *= 1.01


def rounding_differently(env: Any) -> None:
    """Let every step begin with an error in the last bits, as on a processor that rounds differently."""
    step = env.step

    def step_with_error(action: Any) -> Any:
        env.data.qvel[0] += 1e-15
        return step(action)

    env.step = step_with_error


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Ant-v5"])
def test_another_processors_rounding_is_a_warning(env_id: str) -> None:
    report = verify(recorded("rounded-v0", env_id, rounding_differently), workers=1)
    assert report.ok, report.lines()
    assert any("4 episodes played again one step at a time" in line for line in report.checked)
    assert any(
        "4 episodes played again from their seeds differ, at first in the last bits only" in w for w in report.warnings
    )


@pytest.mark.parametrize("seeded", [True, False])
@pytest.mark.parametrize("change", [heavier, slower])
def test_other_physics(change: Callable[[Any], None], seeded: bool) -> None:
    assert codes(recorded("other-v0", "Hopper-v5", change, seeded)) == {"other-physics"}


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5", "Ant-v5", "InvertedPendulum-v5"])
def test_one_step_replay_serves_the_mujoco_environments(env_id: str) -> None:
    report = verify(recorded("same-v0", env_id, nothing, seeded=False), workers=1)
    assert report.ok, report.lines()
    assert any("4 episodes played again one step at a time" in line for line in report.checked)
    assert codes(recorded("heavier-v0", env_id, heavier, seeded=False)) == {"other-physics"}


def test_an_environment_whose_state_cannot_be_told_is_left_out_and_said() -> None:
    report = verify(recorded("reacher-v0", "Reacher-v5", nothing, seeded=False), workers=1)
    assert report.ok
    assert any("playing 4 episodes again: no seed, and no state" in line for line in report.skipped)
    assert codes(recorded("seeded-v0", "Reacher-v5", slower)) == {"other-physics"}


def test_another_version_is_compared_within_a_tolerance_and_said(hopper: str) -> None:
    change_metadata(hopper, versions=versions() | {"mujoco": "3.2.3"})
    report = verify(hopper, workers=1)
    assert report.ok
    assert "recorded with mujoco 3.2.3, but" in report.warnings[0]

    def edit(file: h5py.File) -> None:
        for group in each(file):
            group["observations"][:] = group["observations"][()] * 1.001

    assert codes(tamper(hopper, edit)) == {"other-physics"}


def saturated(name: str, env_id: str, change: Callable[[Any], None], seeded: bool) -> str:
    """Record as `recorded` does, every action at one of the space's bounds."""

    class Bounds:
        def uniform(self, low: Any, high: Any) -> Any:
            return np.where(self.rng.random(low.shape) < 0.5, low, high)

        rng = np.random.default_rng(0)

    return recorded(name, env_id, change, seeded, rng=Bounds())


@pytest.mark.parametrize("seeded", [True, False])
def test_actions_at_the_spaces_bounds_are_not_clipped(seeded: bool) -> None:
    """What lies beyond them is never executed, so it is the physics that differ."""
    assert codes(saturated("sound-v0", "Hopper-v5", nothing, seeded)) == set()
    assert codes(saturated("heavier-v0", "Hopper-v5", heavier, seeded)) == {"other-physics"}


def test_ant_of_version_4_is_played_again() -> None:
    """111 observations: contact forces too, and no word of the two positions that are left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        kwargs = {"use_contact_forces": True}
        report = verify(recorded("ant-v0", "Ant-v4", nothing, seeded=False, **kwargs), workers=1)
        assert report.ok, report.lines()
        assert any("4 episodes played again one step at a time" in line for line in report.checked)
        assert codes(recorded("heavier-v0", "Ant-v4", heavier, seeded=False, **kwargs)) == {"other-physics"}


def test_ends_that_cannot_be_played_are_listed_as_skipped() -> None:
    """An import without final observations: the last step of a terminated episode leads to a stand-in."""
    name = recorded("repeated-v0", "InvertedPendulum-v5", nothing, seeded=False)
    assert not any("ends of" in line for line in verify(name, workers=1).skipped)
    metadata = minari_store.read_metadata(name)
    metadata["offbench"]["final_observations"] = "repeated"
    metadata_path(name).write_text(json.dumps(metadata))
    assert any("the ends of 4 episodes" in line for line in verify(name, workers=1).skipped)


def test_terminations_at_the_time_limit_alone_are_told_without_playing() -> None:
    def mark(file: h5py.File) -> None:
        for group in each(file):
            replace(group, "terminations", np.arange(len(group["rewards"])) == len(group["rewards"]) - 1)
            replace(group, "truncations", np.zeros(len(group["rewards"]), bool))

    name = tamper(recorded("clock-v0", "HalfCheetah-v5", nothing, steps=20, max_episode_steps=20), mark)
    report = verify(name, workers=1, episodes=0)
    found = {finding.code: finding.what for finding in report.findings}
    assert "all 4 terminations lie exactly at the time limit of 20" in found["timeouts-as-terminations"]


@pytest.mark.parametrize("factor", [1.0, 1.0001])
def test_rewards_in_float32_are_compared_in_float32(factor: float) -> None:
    """As Stable-Baselines3's environments give them; without seeds, the steps are played one at a time."""
    name = recorded("rewards-v0", "Hopper-v5", nothing, seeded=False)

    def to_float32(file: h5py.File) -> None:
        for group in each(file):
            replace(group, "rewards", (factor * group["rewards"][:]).astype(np.float32))

    assert codes(tamper(name, to_float32)) == (set() if factor == 1 else {"other-rewards"})
