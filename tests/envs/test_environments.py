"""Environments of others: what they take, what scores they have, and what is said where they cannot be made."""

from __future__ import annotations

import json
import os
import sys
import types
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from offbench.common.errors import OffbenchError
from offbench.data.minari_reader import RecordedEpisode
from offbench.envs import environments
from offbench.envs.environments import (
    action_box,
    box,
    check_spec,
    env_spec,
    make_env,
    same_environment,
    untrusted_env,
)
from offbench.envs.margin_rule import SUM_RULE, with_margin
from offbench.envs.recipes import d4rl_reference_of_env
from offbench.rollouts.policy import uniform_policy
from offbench.rollouts.rollouts import ErrorReporting, Rollouts, gather, scalar_reward
from offbench.verification.resimulate import replay_episode

PENDULUM = (np.full(1, -3, np.float32), np.full(1, 3, np.float32))
HOPPER, HALFCHEETAH = (-20.272305, 3234.3), (-280.178953, 12135.0)  # D4RL's infos.py


class Steps(gym.Env[Any, Any]):
    """An environment whose next reward, end and exception a test chooses."""

    observation_space = gym.spaces.Box(-9, 9, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    observation: Any = np.zeros(3, np.float32)
    reward: Any = 1.0
    ends = True
    fails = exits = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        if self.fails:
            raise KeyError("torque")
        if self.exits:
            sys.exit()
        return self.observation, self.reward, self.ends, False, {}


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> str:
    """The EnvSpec of `Steps`, registered in a module of its own, without a time limit."""
    module = types.ModuleType("steps_module")
    module.Steps = Steps  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "steps_module", module)
    environments._warned_no_time_limit.clear()
    gym.register("Steps-v0", "steps_module:Steps")
    try:
        yield env_spec("Steps-v0")  # type: ignore[misc]
    finally:
        del gym.registry["Steps-v0"]


def play(spec: str) -> list[float]:
    policy = uniform_policy(np.full(1, -1, np.float32), np.full(1, 1, np.float32), 3, "Steps-v0")
    with Rollouts(spec) as rollouts:
        return [stats.ret for stats in gather(rollouts.start_evaluation(policy, 0, (), 2, False))]


@pytest.mark.parametrize(
    ("changes", "reference"),
    [
        ({}, HOPPER),
        ({"render_mode": "rgb_array"}, HOPPER),
        ({"forward_reward_weight": 100.0}, None),
        ({"max_episode_steps": 50}, None),
        ({"terminate_when_unhealthy": False}, None),
    ],
)
def test_d4rls_scores_are_of_the_standard_task_alone(changes: dict[str, Any], reference: Any) -> None:
    spec = gym.make("Hopper-v5", **changes).spec
    assert spec is not None
    assert d4rl_reference_of_env(spec.to_json()) == reference


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (lambda env: env, True),
        (gym.wrappers.RecordEpisodeStatistics, True),
        (lambda env: gym.wrappers.ClipReward(env, 0.0, 0.1), False),
        (lambda env: gym.wrappers.ClipReward(env, 0.0, 0.2), False),
        (lambda env: gym.wrappers.TimeLimit(env, 5), False),
    ],
)
def test_wrappers_that_change_rewards_or_episodes_make_another_environment(other: Any, same: bool) -> None:
    plain = gym.make("InvertedPendulum-v5").spec
    wrapped = other(gym.make("InvertedPendulum-v5", render_mode="rgb_array")).spec
    assert plain is not None
    assert same_environment(plain.to_json(), wrapped.to_json()) is same
    assert same_environment(wrapped.to_json(), wrapped.to_json())
    clipped = gym.wrappers.ClipReward(gym.make("InvertedPendulum-v5"), 0.0, 0.1).spec
    assert clipped is not None
    assert not same_environment(plain.to_json(), clipped.to_json())
    assert not same_environment(clipped.to_json(), None)


def test_wrappers_and_other_namespaces_have_no_d4rl_score() -> None:
    plain = json.loads(env_spec("Hopper-v5"))
    watched = gym.wrappers.RecordEpisodeStatistics(gym.make("Hopper-v5")).spec
    changed = gym.wrappers.ClipReward(gym.make("Hopper-v5"), 0.0, 1.0).spec
    assert watched is not None
    assert changed is not None
    assert d4rl_reference_of_env(watched.to_json()) == HOPPER
    assert d4rl_reference_of_env(changed.to_json()) is None
    assert (
        d4rl_reference_of_env(EnvSpec("Hopper-v2", "gym.envs.mujoco:HopperEnv", max_episode_steps=1000).to_json())
        == HOPPER
    )
    for other in ({"id": "frogs/Hopper-v5"}, {"id": "Hopper-v9"}, {"entry_point": "frogs:Frog"}):
        assert d4rl_reference_of_env(json.dumps(plain | other)) is None
    assert d4rl_reference_of_env(env_spec("InvertedPendulum-v5")) is None
    assert d4rl_reference_of_env(None) is None
    for env_id, reference in (("Hopper-v5", None), ("HalfCheetah-v5", HALFCHEETAH)):  # which has no margins
        assert d4rl_reference_of_env(with_margin(env_spec(env_id), SUM_RULE)) == reference


@pytest.mark.parametrize("wrapper", [gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward])
def test_wrappers_whose_episodes_depend_on_earlier_ones_are_refused(wrapper: Any) -> None:
    spec = wrapper(gym.make("InvertedPendulum-v5")).spec
    with pytest.raises(OffbenchError, match=f"x-v0: the environment has the wrapper {wrapper.__name__}, whose stat"):
        untrusted_env(spec.to_json(), "x-v0")
    gym.register("Wrapped-v0", spec.entry_point, max_episode_steps=5, additional_wrappers=spec.additional_wrappers)
    try:
        with pytest.raises(OffbenchError, match=wrapper.__name__):
            env_spec("Wrapped-v0")
    finally:
        del gym.registry["Wrapped-v0"]


@pytest.mark.parametrize("bound", [np.finfo(np.float32).max, 1e30, 2e6])
def test_bounds_that_are_none_are_refused(bound: float) -> None:
    with pytest.raises(OffbenchError, match=r"bounded.*correct the action space"):
        action_box(gym.spaces.Box(-bound, bound, (1,), np.float32), "x: actions")


def test_bounds_are_in_order_and_wide_ones_are_taken() -> None:
    wide = gym.spaces.Box(-1e6, 1e6, (2,), np.float32)
    assert action_box(wide, "x: actions") is wide
    with pytest.raises(OffbenchError, match="not below its upper bound"):
        action_box(gym.spaces.Box(np.float32([0, 1]), np.float32([1, 1])), "x: actions")


def test_remedies_fit_what_is_wrong() -> None:
    """FlattenObservation changes neither number types nor actions."""
    integers, image = gym.spaces.Box(0, 255, (3,), np.int64), gym.spaces.Box(0, 1, (4, 4), np.float32)
    for space, what, remedy in (
        (integers, "x: observations", "float32"),
        (integers, "x: actions", "float32"),
        (image, "x: observations", "FlattenObservation"),
        (image, "x: actions", "continuous actions"),
        (gym.spaces.Discrete(3), "x: actions", "continuous actions"),
        (gym.spaces.Dict(a=image), "x: observations", "FlattenObservation and record"),
        (gym.spaces.Box(0, 255, (8, 8), np.uint8), "x: observations", "FlattenObservation and DtypeObservation"),
        (gym.spaces.Graph(integers, None), "x: observations", "turn them into numbers"),
        (gym.spaces.Box(0, 1, (0,), np.float32), "x: observations", "have no dimension"),
    ):
        with pytest.raises(OffbenchError, match=remedy) as error:
            box(space, what)
        assert ("FlattenObservation" in str(error.value)) == remedy.startswith("FlattenObservation")
    flat = gym.wrappers.FlattenObservation(gym.make("MountainCarContinuous-v0")).observation_space
    assert box(flat, "x: observations") is flat


def test_other_action_bounds_are_said_where_policies_are_evaluated(capsys: pytest.CaptureFixture[str]) -> None:
    spec = env_spec("InvertedPendulum-v5")
    check_spec(spec, "same-v0", 4, *PENDULUM)
    check_spec(spec, "rounded-v0", 4, PENDULUM[0] * np.float32(1 + 1e-7), PENDULUM[1].astype(np.float64))
    assert capsys.readouterr().err == ""
    check_spec(spec, "scaled-v0", 4, PENDULUM[0] / 3, PENDULUM[1] / 3)
    assert "scaled-v0 has actions with bounds [-1, 1], the environment" in (said := capsys.readouterr().err)
    assert "InvertedPendulum-v5 takes [-3, 3]" in said


def test_an_environment_of_the_script_itself_is_refused() -> None:
    """Worker processes cannot import it."""
    gym.register("Mine-v0", "__main__:Mine")
    sys.modules["__main__"].Mine = Steps  # type: ignore[attr-defined]
    try:
        spec = EnvSpec("Mine-v0", "__main__:Mine").to_json()
        for attempt in (lambda: env_spec("Mine-v0"), lambda: untrusted_env(spec, "mine-v0")):
            with pytest.raises(OffbenchError, match=r"__main__.*move it into a module"):
                attempt()
    finally:
        del gym.registry["Mine-v0"]
        del sys.modules["__main__"].Mine  # type: ignore[attr-defined]


def test_what_cannot_be_made_again_is_not_sent_after_a_package() -> None:
    monitored = json.loads(env_spec("InvertedPendulum-v5"))
    monitored["additional_wrappers"] = [
        {"name": "Monitor", "entry_point": "stable_baselines3.common.monitor:Monitor", "kwargs": None}
    ]
    gone = EnvSpec("HalfCheetah-v2", "gymnasium.envs.mujoco.half_cheetah:HalfCheetahEnv").to_json()
    for spec, why in ((json.dumps(monitored), "the wrapper Monitor does not record"), (gone, "half_cheetah")):
        with pytest.raises(OffbenchError, match=why) as error:
            check_spec(spec, "x-v0", 4, *PENDULUM)
        assert "--env RECIPE" in str(error.value)
        assert "--trust" not in str(error.value)
        assert "install" not in str(error.value)
    absent = EnvSpec("A-v0", "gymnasium_robotics.envs.absent:A", max_episode_steps=5).to_json()
    with pytest.raises(OffbenchError, match="install the package that has the module gymnasium_robotics"):
        untrusted_env(absent, "x-v0")


def test_specs_of_older_gymnasium_are_read() -> None:
    old = json.loads(env_spec("InvertedPendulum-v5")) | {"autoreset": False, "apply_api_compatibility": False}
    assert untrusted_env(json.dumps(old), "old-v0").observation_space.shape == (4,)


@pytest.mark.parametrize("reward", [np.array([1.5]), np.array([[1.5]]), np.float32(1.5), 1.5, np.array(1.5)])
def test_rewards_of_one_element_are_numbers(steps: str, reward: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Steps, "reward", reward)
    assert play(steps) == [1.5, 1.5]


def test_an_environment_that_fails_is_named(steps: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Steps, "reward", np.ones(2))
    with pytest.raises(OffbenchError, match=r"Steps-v0 failed: .*shape \(2,\)"):
        play(steps)
    with pytest.raises(ValueError, match="shape"):
        scalar_reward(np.ones((2, 2)))
    monkeypatch.setattr(Steps, "fails", True)
    with pytest.raises(OffbenchError, match=r"Steps-v0 failed: KeyError: 'torque'"):
        play(steps)
    recorded = RecordedEpisode(0, 0, np.zeros((2, 3), np.float32), *(np.zeros((1, 1)) for _ in range(4)))
    ((code, text),) = replay_episode(steps, recorded, True, False).faults
    assert code == "not-replayable"
    assert "Steps-v0 failed: KeyError: 'torque'" in text


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"reward": np.nan}, "reward with NaN"),
        ({"observation": np.full(3, np.inf)}, "observation with NaN or infinite"),
        ({"observation": np.zeros(4)}, r"shape \(4,\), its space \(3,\)"),
        ({"observation": "abc"}, r"shape \(\), its space \(3,\)"),
        ({"fails": True}, "KeyError: 'torque'"),
        ({"exits": True}, "SystemExit"),
    ],
)
def test_numbers_that_are_none_are_neither_recorded_nor_learned_from(
    changes: dict[str, Any], what: str, steps: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in changes.items():
        monkeypatch.setattr(Steps, name, value)
    with pytest.raises(OffbenchError, match=f"Steps-v0 failed: .*{what}"):
        play(steps)
    env = ErrorReporting(make_env(steps))  # what SAC learns in
    env.reset(seed=0)
    with pytest.raises(OffbenchError, match=f"Steps-v0 failed: .*{what}"):
        env.step(np.zeros(1, np.float32))


def test_an_environment_without_a_time_limit_is_named_and_does_not_run_for_ever(
    steps: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    environments._warned_no_time_limit.clear()
    env_spec("Steps-v0")
    assert "Steps-v0 has no time limit (max_episode_steps)" in capsys.readouterr().err
    assert play(steps) == [1.0, 1.0]  # it ends by itself
    monkeypatch.setattr("offbench.rollouts.rollouts.MAX_EPISODE_STEPS", 200)
    monkeypatch.setattr(Steps, "ends", False)
    with pytest.raises(OffbenchError, match=r"not ended within 200 steps.*max_episode_steps"):
        play(steps)
    limited = json.loads(steps) | {
        "max_episode_steps": 300
    }  # beyond MAX_EPISODE_STEPS: the environment's own limit counts
    assert play(json.dumps(limited)) == [300.0, 300.0]


def test_a_limit_that_no_run_reaches_is_none() -> None:
    assert environments.time_limit(EnvSpec("A-v0", max_episode_steps=10**9)) is None
    assert environments.time_limit(EnvSpec("A-v0", max_episode_steps=1000)) == 1000


def test_a_variable_that_keeps_mujoco_from_loading_is_named(offbench_cli: Any) -> None:
    """A renderer that does not exist: nothing is drawn here, but MuJoCo reads the variable when it loads."""
    env = {**os.environ, "MUJOCO_GL": "nonsense"}
    done = offbench_cli("collect", "inverted-pendulum", "--level", "random", "--steps", "50", env=env)
    assert done.returncode == 2
    assert "MUJOCO_GL=nonsense" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
