"""Replay a recorded episode in its environment, from its seed or one step at a time, and compare the results.

from the seed   reset(seed), then the recorded actions: every observation, reward and end must be the same
one step        put the environment in a recorded state, take its action: the next observation must be the same
                (MuJoCo environments whose observation holds qpos and qvel; if it leaves out x, nothing depends on x)

Runs in worker processes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.data.minari_reader import RecordedEpisode
from offbench.envs.environments import Env, box
from offbench.rollouts.rollouts import cached_envs, reset, step

STEPS = 40  # maximum number of steps of an episode that are replayed one at a time
WHOLE, CLOSE, ROUNDED = 1e-9, 1e-6, 1e-4  # tolerances: same physics, other version, observations kept as float32
CLIPPED_VELOCITY = 10.0  # Hopper and Walker2d report no velocity beyond it: the state cannot be recovered there
SHARE = 0.01  # share of the replayed steps that may differ (at least one): rounding can change a contact or a limit


@dataclass(frozen=True)
class ReplayResult:
    """The result of replaying an episode. `faults` are (code, detail); `how` is seed, step or none."""

    index: int
    how: str
    steps: int
    faults: tuple[tuple[str, str], ...] = ()
    end: bool = True  # whether its last step was played, so that its end is checked
    rounding: bool = False  # whether a replay from the seed differs, at first in the last bits only

    @property
    def checks_end(self) -> bool:
        """Whether the environment ends the episode as recorded."""
        return self.how != "none" and self.end and not self.faults


def replay_episode(env_spec: str, episode: RecordedEpisode, exact: bool, last_unknown: bool) -> ReplayResult:
    """Replay one episode by the strictest method that it allows.

    Args:
        env_spec: the environment it was recorded in, EnvSpec JSON.
        exact: the installed simulator is the recorded one, so bits must agree.
        last_unknown: a terminated episode's last observation is a placeholder, as after an import from D4RL.
    """
    env = cached_envs(env_spec, 1)[0]
    try:
        return _replay_episode(env, episode, exact, last_unknown)
    except OffbenchError as error:  # the environment failed
        return ReplayResult(episode.index, "none", 0, (("not-replayable", str(error)),))


def _replay_episode(env: Env, episode: RecordedEpisode, exact: bool, last_unknown: bool) -> ReplayResult:
    if episode.seed is not None and exact and not last_unknown:
        from_seed = _from_seed(env, episode, 0.0)
        if from_seed.how == "seed":
            return from_seed
        state = _StateSetter.of(env)
        if state is None:
            return from_seed
        steps = _one_step(env, state, episode, exact, last_unknown)
        return replace(steps, rounding=not steps.faults)
    state = _StateSetter.of(env)
    if state is not None:
        return _one_step(env, state, episode, exact, last_unknown)
    if episode.seed is not None and not last_unknown:
        return _from_seed(env, episode, CLOSE)
    return ReplayResult(episode.index, "none", 0)


def _from_seed(env: Env, e: RecordedEpisode, tolerance: float) -> ReplayResult:
    """Replay an episode from its seed; `how` is none if observations differ, at first in the last bits only."""
    observations, rewards, ends = [reset(env, e.seed)], [], [False, False]
    for action in e.actions:
        observation, reward, *ends = step(env, action)
        observations.append(observation)
        rewards.append(reward)
        if any(ends):
            break
    steps = len(rewards)
    played = np.array(observations).astype(e.observations.dtype)
    differs = _rows_differ(played, e.observations[: steps + 1], tolerance)
    first_off = int(np.flatnonzero(differs)[0]) if differs.any() else None
    last_bits = max(WHOLE, 4 * float(np.finfo(played.dtype).eps)) if played.dtype.kind == "f" else WHOLE
    end_fault = ("steps-after-end", f"the environment ends at step {steps} of {len(e)}")
    if first_off is not None:
        if not _rows_differ(played[[first_off]], e.observations[[first_off]], last_bits).any():
            return ReplayResult(e.index, "none", first_off, rounding=True)
        # only the row after the environment's own end differs: the next episode begins there
        fault = end_fault if first_off == steps < len(e) else _diagnose(env, played, e, first_off, tolerance)
        return ReplayResult(e.index, "seed", steps, (fault,))
    faults = []
    rewards_played, rewards_recorded = np.array(rewards).astype(e.rewards.dtype), e.rewards[:steps]
    reward_differs = _rows_differ(rewards_played, rewards_recorded, tolerance)
    rounding = reward_differs.any() and not _rows_differ(rewards_played, rewards_recorded, last_bits).any()
    if reward_differs.any() and not rounding:
        faults.append(("other-rewards", f"from step {int(np.flatnonzero(reward_differs)[0])}"))
    if steps < len(e):
        faults.append(end_fault)
    else:
        faults += _compare_ends(bool(e.terminations[-1]), ends[0], len(e))
    return ReplayResult(e.index, "seed", steps, tuple(faults), rounding=bool(rounding))


def _compare_ends(recorded: bool, played: bool, steps: int) -> list[tuple[str, str]]:
    if recorded and not played:
        return [("timeouts-as-terminations", f"after {steps} steps")]
    if played and not recorded:
        return [("terminations-as-timeouts", f"after {steps} steps")]
    return []


def _rows_differ(a: Array, b: Array, tolerance: float) -> Array:
    """Return which rows of `a` [T, ...] differ from those of `b`; the tolerance is relative for values beyond 1."""
    far = a != b if tolerance == 0 else np.abs(a - b) > tolerance * (1 + np.abs(b))
    return np.asarray(far.reshape(len(far), -1).any(1))


def _diagnose(env: Env, played: Array, e: RecordedEpisode, first: int, tolerance: float) -> tuple[str, str]:
    """Return the fault of an episode whose observations differ from the environment's from row `first` on."""
    rows = len(played)
    close = max(tolerance, CLOSE)
    if rows > 2 and not _rows_differ(played[1 : rows - 1], e.observations[: rows - 2], close).any():
        return "shifted-observations", "row t holds what followed action t"
    if rows > 2 and not _rows_differ(played[: rows - 2], e.observations[1 : rows - 1], close).any():
        return "shifted-observations", "row t holds what was there before action t - 1"
    if first == 0:
        return "other-start", f"by up to {np.abs(played[0] - e.observations[0]).max():.3g}"
    if _clipped_steps(e.actions, box(env.action_space, "actions"))[first - 1]:
        return "clipped-actions", f"the first step that does not follow its action is {first - 1}"
    return "other-physics", f"from row {first}, by {np.abs(played[first] - e.observations[first]).max():.3g} there"


def _clipped_steps(actions: Array, space: gym.spaces.Box) -> Array:
    """Return which steps [T] have a component at its least or greatest value, if several steps share it.

    Values at the space's own bounds do not count: the environment executed those actions as recorded.
    """
    clipped = np.zeros(len(actions), bool)
    for outermost, bound in ((actions.min(0), space.low), (actions.max(0), space.high)):
        at = (actions == outermost) & ~np.isclose(outermost, bound)
        clipped |= (at & (at.sum(0) > 2)).any(1)
    return clipped


class _StateSetter:
    """Puts a MuJoCo environment into the state that an observation describes."""

    def __init__(self, env: Any, skipped: int) -> None:
        self.env = env
        self.positions, self.skipped = self.env.model.nq - skipped, skipped
        self.size = self.positions + self.env.model.nv
        self.rewards = True  # whether the state determines the reward; Ant's also depends on earlier positions

    def set(self, observation: Array) -> None:
        """Set the state; positions that the observation leaves out (x) become 0."""
        whole = np.asarray(observation[: self.size], np.float64)
        positions = np.concatenate([np.zeros(self.skipped), whole[: self.positions]])
        self.env.set_state(positions, whole[self.positions :].copy())

    @classmethod
    def of(cls, env: Env) -> _StateSetter | None:
        """Return a setter for the environment, or None if its observation does not determine the state."""
        inner: Any = env.unwrapped
        if not (hasattr(inner, "set_state") and hasattr(getattr(inner, "model", None), "nq")):
            return None
        dim = env.observation_space.shape[0]  # type: ignore[index]
        # the positions that are left out are x (and y); older versions of the environments do not list them
        skipped_qpos = getattr(inner, "observation_structure", {}).get("skipped_qpos")
        for skipped in (0, 1, 2) if skipped_qpos is None else (skipped_qpos,):
            state = cls(inner, skipped)
            if 0 < state.size <= dim and state._is_reproducible(env):
                return state
        return None

    def _is_reproducible(self, env: Env) -> bool:
        """Return whether a step from a restored state leads to the same observation as the original step."""
        observation, reward = reset(env, 0), 0.0
        rng = np.random.default_rng(0)
        space = box(env.action_space, "actions")
        low, high = (np.where(np.isfinite(end), end, sign) for end, sign in ((space.low, -1), (space.high, 1)))
        before, action = observation, low
        for _ in range(5):
            before, action = observation, rng.uniform(low, high).astype(low.dtype)
            observation, reward, *_ = step(env, action)
        self.set(before)
        again, reward_again, *_ = step(env, action)
        self.rewards = abs(reward_again - reward) <= WHOLE * (1 + abs(reward))
        return not _rows_differ(again[None, : self.size], observation[None, : self.size], WHOLE).any()


def _one_step(env: Env, state: _StateSetter, e: RecordedEpisode, exact: bool, last_unknown: bool) -> ReplayResult:
    seen = np.asarray(e.observations, np.float64)
    rounded = bool((seen == seen.astype(np.float32)).all())
    tolerance = ROUNDED if rounded else WHOLE if exact else CLOSE
    is_float = np.issubdtype(e.rewards.dtype, np.floating)
    reward_tolerance = max(tolerance, 4 * float(np.finfo(e.rewards.dtype).eps)) if is_float else tolerance
    last = len(e) - 1
    steps = np.unique(np.linspace(0, last, min(len(e), STEPS)).astype(int))
    complete = (np.abs(seen[:-1, state.positions : state.size]) != CLIPPED_VELOCITY).all(1)
    steps = np.array([t for t in steps if complete[t] and not (t == last and last_unknown)], int)
    if not len(steps):
        return ReplayResult(e.index, "none", 0)
    reset(env, 0)
    state_off, reward_off, ended = (np.zeros(len(steps), bool) for _ in range(3))
    for i, t in enumerate(steps):
        state.set(seen[t])
        observation, reward, ended[i], _ = step(env, e.actions[t])
        state_off[i] = _state_differs(observation, seen[t + 1], state, tolerance)
        expected = float(e.rewards.dtype.type(reward))
        reward_off[i] = abs(expected - float(e.rewards[t])) > reward_tolerance * (1 + abs(reward))
    allowed = max(1, SHARE * len(steps)) if rounded else 0
    early = ended & (steps != last)
    state_off &= ~early  # what follows an end is another episode
    if state_off.sum() > allowed:
        return ReplayResult(
            e.index, "step", len(steps), (_diagnose_steps(env, state, e, steps, state_off, tolerance),)
        )
    faults = []
    if state.rewards and reward_off.sum() > allowed:
        faults.append(("other-rewards", f"at {reward_off.sum()} of {len(steps)} steps"))
    if early.sum() > allowed:
        faults.append(("steps-after-end", f"the environment ends at step {steps[early][0] + 1} of {len(e)}"))
    if steps[-1] == last:
        faults += _compare_ends(bool(e.terminations[-1]), bool(ended[-1]), len(e))
    return ReplayResult(e.index, "step", len(steps), tuple(faults), end=bool(steps[-1] == last))


def _state_differs(observation: Array, recorded: Array, state: _StateSetter, tolerance: float) -> bool:
    actual = np.asarray(observation, np.float64)[None, : state.size]
    return bool(_rows_differ(actual, recorded[None, : state.size], tolerance)[0])


def _diagnose_steps(
    env: Env, state: _StateSetter, e: RecordedEpisode, steps: Array, state_off: Array, tolerance: float
) -> tuple[str, str]:
    """Return the fault of an episode whose replayed steps lead to other observations."""
    for offset, detail in ((1, "row t holds what followed action t"), (-1, "row t holds what preceded action t - 1")):
        near = [t for t in steps[1:-1] if 0 <= t + offset < len(e)]
        off = []
        for t in near:
            state.set(e.observations[t])
            observation, *_ = step(env, e.actions[t + offset])
            off.append(_state_differs(observation, e.observations[t + 1].astype(np.float64), state, tolerance))
        if near and sum(off) < 0.2 * len(near) < sum(state_off):
            return "shifted-observations", detail
    if _clipped_steps(e.actions, box(env.action_space, "actions"))[steps[state_off]].all():
        return "clipped-actions", f"{state_off.sum()} of {len(steps)} steps do not follow their actions"
    return "other-physics", f"{state_off.sum()} of {len(steps)} steps lead elsewhere"
