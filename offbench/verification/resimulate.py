"""Does a recorded episode come out of its environment? Played again from its seed, or one step at a time.

from the seed   reset(seed), then the recorded actions: every observation, reward and end must come out again
one step        put the environment in a recorded state, take its action: the next observation must come out
                (MuJoCo environments whose observation holds qpos and qvel; where x is missing nothing depends on it)

Runs in worker processes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from offbench.common.arrays import Array
from offbench.data.minari_reader import Recorded
from offbench.envs.environments import Env, box
from offbench.rollouts.rollouts import kept_envs, reset, step

STEPS = 40  # of an episode that are replayed one by one
WHOLE, CLOSE, ROUNDED = 1e-9, 1e-6, 1e-4  # tolerances: same physics, other version, observations kept as float32
CLIPPED_VELOCITY = 10.0  # Hopper and Walker2d report no velocity beyond it: the state cannot be recovered there
SHARE = 0.01  # of the replayed steps, or one of them, that rounding may carry across a contact or a limit


@dataclass(frozen=True)
class Verdict:
    """What replaying an episode showed. `faults` are (code, detail); `how` is seed, step or none."""

    index: int
    how: str
    steps: int
    faults: tuple[tuple[str, str], ...] = ()
    end: bool = True  # whether its last step was played, so that its end is checked


def check(spec: str, episode: Recorded, exact: bool, last_unknown: bool) -> Verdict:
    """Play one episode again by the strictest means there is.

    Args:
        spec: the environment it was recorded in, EnvSpec JSON.
        exact: the installed simulator is the recorded one, so bits must agree.
        last_unknown: a terminated episode's last observation is a stand-in, as after an import from D4RL.
    """
    env = kept_envs(spec, 1)[0]
    if episode.seed is not None and exact and not last_unknown:
        return _from_seed(env, episode, 0.0)
    state = _State.of(env)
    if state is not None:
        return _one_step(env, state, episode, exact, last_unknown)
    if episode.seed is not None and not last_unknown:
        return _from_seed(env, episode, CLOSE)
    return Verdict(episode.index, "none", 0)


def _from_seed(env: Env, e: Recorded, tolerance: float) -> Verdict:
    observations, rewards, ends = [reset(env, e.seed)], [], [False, False]
    for action in e.actions:
        observation, reward, *ends = step(env, action)
        observations.append(observation)
        rewards.append(reward)
        if any(ends):
            break
    steps = len(rewards)
    played = np.array(observations).astype(e.observations.dtype)
    off = _off(played, e.observations[: steps + 1], tolerance)
    first_off = int(np.flatnonzero(off)[0]) if off.any() else None
    over = ("steps-after-end", f"the environment ends at step {steps} of {len(e)}")
    if first_off is not None:
        # only the row behind the environment's own end: the next episode begins there
        fault = over if first_off == steps < len(e) else _why(env, played, e, first_off, tolerance)
        return Verdict(e.index, "seed", steps, (fault,))
    faults = []
    earned = _off(np.array(rewards).astype(e.rewards.dtype), e.rewards[:steps], tolerance)
    if earned.any():
        faults.append(("other-rewards", f"from step {int(np.flatnonzero(earned)[0])}"))
    if steps < len(e):
        faults.append(over)
    else:
        faults += _ends(bool(e.terminations[-1]), ends[0], len(e))
    return Verdict(e.index, "seed", steps, tuple(faults))


def _ends(recorded: bool, played: bool, steps: int) -> list[tuple[str, str]]:
    if recorded and not played:
        return [("timeouts-as-terminations", f"after {steps} steps")]
    if played and not recorded:
        return [("terminations-as-timeouts", f"after {steps} steps")]
    return []


def _off(a: Array, b: Array, tolerance: float) -> Array:
    """Return which rows of `a` differ from those of `b`, relative beyond 1."""
    far = a != b if tolerance == 0 else np.abs(a - b) > tolerance * (1 + np.abs(b))
    return np.asarray(far.reshape(len(far), -1).any(1))


def _why(env: Env, played: Array, e: Recorded, first: int, tolerance: float) -> tuple[str, str]:
    """Name the fault of an episode whose observations part from the environment's at row `first`."""
    rows = len(played)
    close = max(tolerance, CLOSE)
    if rows > 2 and not _off(played[1 : rows - 1], e.observations[: rows - 2], close).any():
        return "shifted-observations", "row t holds what followed action t"
    if rows > 2 and not _off(played[: rows - 2], e.observations[1 : rows - 1], close).any():
        return "shifted-observations", "row t holds what was there before action t - 1"
    if first == 0:
        return "other-start", f"by up to {np.abs(played[0] - e.observations[0]).max():.3g}"
    if _piled(e.actions, box(env.action_space, "actions"))[first - 1]:
        return "clipped-actions", f"the first step that does not follow its action is {first - 1}"
    return "other-physics", f"from row {first}, by {np.abs(played[first] - e.observations[first]).max():.3g} there"


def _piled(actions: Array, space: gym.spaces.Box) -> Array:
    """Return which steps [T] have an action at the outermost value of a component, if several steps share it.

    At the space's own bounds that is no clipping after the fact: what lies beyond them is never executed.
    """
    piled = np.zeros(len(actions), bool)
    for outermost, bound in ((actions.min(0), space.low), (actions.max(0), space.high)):
        at = (actions == outermost) & ~np.isclose(outermost, bound)
        piled |= (at & (at.sum(0) > 2)).any(1)
    return piled


class _State:
    """Puts a MuJoCo environment into the state that an observation describes."""

    def __init__(self, env: Any, skipped: int) -> None:
        self.env = env
        self.positions, self.skipped = self.env.model.nq - skipped, skipped
        self.size = self.positions + self.env.model.nv
        self.rewards = True  # whether the reward follows from the state; Ant's looks at where bodies were a moment ago

    def set(self, observation: Array) -> None:
        """Set the state; positions that the observation leaves out (x) become 0."""
        whole = np.asarray(observation[: self.size], np.float64)
        positions = np.concatenate([np.zeros(self.skipped), whole[: self.positions]])
        self.env.set_state(positions, whole[self.positions :].copy())

    @classmethod
    def of(cls, env: Env) -> _State | None:
        """Return the way to set the state, or None where the observation does not determine it."""
        inner: Any = env.unwrapped
        if not (hasattr(inner, "set_state") and hasattr(getattr(inner, "model", None), "nq")):
            return None
        dim = env.observation_space.shape[0]  # type: ignore[index]
        # the positions that are left out are x (and y); older versions of the environments do not list them
        said = getattr(inner, "observation_structure", {}).get("skipped_qpos")
        for skipped in (0, 1, 2) if said is None else (said,):
            state = cls(inner, skipped)
            if 0 < state.size <= dim and state._works(env):
                return state
        return None

    def _works(self, env: Env) -> bool:
        """Try it: a step from a set state must lead where the same step leads without setting it."""
        observation, reward = reset(env, 0), 0.0
        rng = np.random.default_rng(0)
        low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
        before, action = observation, low
        for _ in range(5):
            before, action = observation, rng.uniform(low, high).astype(low.dtype)
            observation, reward, *_ = step(env, action)
        self.set(before)
        again, repaid, *_ = step(env, action)
        self.rewards = abs(repaid - reward) <= WHOLE * (1 + abs(reward))
        return not _off(again[None, : self.size], observation[None, : self.size], WHOLE).any()


def _one_step(env: Env, state: _State, e: Recorded, exact: bool, last_unknown: bool) -> Verdict:
    seen = np.asarray(e.observations, np.float64)
    rounded = bool((seen == seen.astype(np.float32)).all())
    tolerance = ROUNDED if rounded else WHOLE if exact else CLOSE
    last = len(e) - 1
    steps = np.unique(np.linspace(0, last, min(len(e), STEPS)).astype(int))
    complete = (np.abs(seen[:-1, state.positions : state.size]) != CLIPPED_VELOCITY).all(1)
    steps = np.array([t for t in steps if complete[t] and not (t == last and last_unknown)], int)
    if not len(steps):
        return Verdict(e.index, "none", 0)
    reset(env, 0)
    moved, paid, ended = (np.zeros(len(steps), bool) for _ in range(3))
    for i, t in enumerate(steps):
        state.set(seen[t])
        observation, reward, ended[i], _ = step(env, e.actions[t])
        moved[i] = _far(observation, seen[t + 1], state, tolerance)
        paid[i] = abs(reward - float(e.rewards[t])) > tolerance * (1 + abs(reward))
    allowed = max(1, SHARE * len(steps)) if rounded else 0
    early = ended & (steps != last)
    moved &= ~early  # what follows an end is another episode
    if moved.sum() > allowed:
        return Verdict(e.index, "step", len(steps), (_why_step(env, state, e, steps, moved, tolerance),))
    faults = []
    if state.rewards and paid.sum() > allowed:
        faults.append(("other-rewards", f"at {paid.sum()} of {len(steps)} steps"))
    if early.sum() > allowed:
        faults.append(("steps-after-end", f"the environment ends at step {steps[early][0] + 1} of {len(e)}"))
    if steps[-1] == last:
        faults += _ends(bool(e.terminations[-1]), bool(ended[-1]), len(e))
    return Verdict(e.index, "step", len(steps), tuple(faults), end=bool(steps[-1] == last))


def _far(observation: Array, recorded: Array, state: _State, tolerance: float) -> bool:
    actual = np.asarray(observation, np.float64)[None, : state.size]
    return bool(_off(actual, recorded[None, : state.size], tolerance)[0])


def _why_step(env: Env, state: _State, e: Recorded, steps: Array, moved: Array, tolerance: float) -> tuple[str, str]:
    """Name the fault of an episode whose steps lead elsewhere."""
    for offset, words in ((1, "row t holds what followed action t"), (-1, "row t holds what preceded action t - 1")):
        near = [t for t in steps[1:-1] if 0 <= t + offset < len(e)]
        off = []
        for t in near:
            state.set(e.observations[t])
            observation, *_ = step(env, e.actions[t + offset])
            off.append(_far(observation, e.observations[t + 1].astype(np.float64), state, tolerance))
        if near and sum(off) < 0.2 * len(near) < sum(moved):
            return "shifted-observations", words
    if _piled(e.actions, box(env.action_space, "actions"))[steps[moved]].all():
        return "clipped-actions", f"{moved.sum()} of {len(steps)} steps do not follow their actions"
    return "other-physics", f"{moved.sum()} of {len(steps)} steps lead elsewhere"
