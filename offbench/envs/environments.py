"""Environments: made from a recipe's id, or from the EnvSpec that a dataset or a run carries.

An EnvSpec names the code that makes the environment, so one that came in a file is checked before it is believed.

The EnvSpecs that offbench passes around, and keeps in runs, may have a field that Gymnasium's have not,
`contact_margin`: "sum" is the rule of MuJoCo 3.5 and later, "max", the default, that of earlier versions
(offbench.envs.physics). Minari's metadata get the plain EnvSpec.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from offbench.common.errors import OffbenchError
from offbench.envs.contact_margin import EARLIER, MARGIN, without_margin
from offbench.envs.trust import check_code

WHAT_MATTERS = ("id", "kwargs", "max_episode_steps")  # with the contact margins, what makes two specs the same


def env_spec(env_id: str, **kwargs: Any) -> str:
    """Return Gymnasium's EnvSpec of `env_id` as JSON, checked to have flat Box spaces and bounded actions.

    Raises:
        OffbenchError: it cannot be made, or its spaces are of another kind.
    """
    try:
        with _quiet_loading(env_id):
            env = gym.make(env_id, **kwargs)
        assert env.spec is not None
        text = env.spec.to_json()
    except Exception as error:  # a third-party environment may raise anything here
        hint = ""
        if isinstance(error, gym.error.NameNotFound | gym.error.NamespaceNotFound) and ":" not in env_id:
            hint = f" If a module of yours registers it, name it before a colon: my_module:{env_id}"
        raise OffbenchError(f"cannot make the environment {env_id!r}: {_reason(error)}{hint}") from error
    _check_spaces(env, env_id)
    return text


def checked_spec(text: str, where: str, observation_dim: int, action_dim: int) -> str:
    """Return the EnvSpec JSON that a file carries if it can be believed, made, and fits.

    Raises:
        OffbenchError: it names code that is no Gymnasium environment, cannot be made, or has other shapes.
    """
    env = believed_env(text, where)
    _check_spaces(env, where)
    shapes = (env.observation_space.shape, env.action_space.shape)
    if shapes != ((observation_dim,), (action_dim,)):
        raise OffbenchError(
            f"{where} takes observations ({observation_dim},) and actions ({action_dim},); the environment "
            f"{env.spec.id if env.spec else '?'} has {shapes[0]} and {shapes[1]}: give the right one"
        )
    return text


def believed_env(text: str, where: str) -> gym.Env[Any, Any]:
    """Make the environment of an EnvSpec (JSON) that came in a file, if what it names is an environment.

    Raises:
        OffbenchError: it names code that is no Gymnasium environment, or cannot be made.
    """
    try:
        check_code(EnvSpec.from_json(without_margin(text)[0]))
        return make_env(text)
    except OffbenchError as error:
        raise OffbenchError(f"{where}: {error}") from None
    except Exception as error:  # see env_spec
        raise OffbenchError(
            f"{where}: cannot make its environment: {_reason(error)}; install or import the package it comes from"
        ) from error


def make_env(spec: str, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """Make the environment of an EnvSpec in JSON, without the step-by-step checker, with the contacts it asks for."""
    plain, rule = without_margin(spec)
    made = EnvSpec.from_json(plain)
    made.disable_env_checker = True
    with _quiet_loading(made.id):
        options: dict[str, Any] = {"render_mode": render_mode} if render_mode else {}  # else the EnvSpec's own
        env = gym.make(made, **options)
    if hasattr(env.unwrapped, "model"):
        from offbench.envs.physics import model_of, set_contacts  # imports MuJoCo, which is slow to load

        if (model := model_of(env)) is not None:
            set_contacts(model, rule, made.id)
    _ask_once(env.unwrapped)
    return env


@contextlib.contextmanager
def _quiet_loading(env_id: str) -> Iterator[None]:
    """Say nothing of what MuJoCo finds deprecated in Gymnasium's own models, such as HalfCheetah's `settotalmass`.

    MuJoCo would print it and write MUJOCO_LOG.TXT into the working directory, for each environment that is made.
    """
    registered = gym.registry.get(env_id)
    if registered is None or not str(registered.entry_point).startswith("gymnasium.envs.mujoco."):
        yield
        return
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_say_unless_deprecated)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _say_unless_deprecated(warning: str) -> None:
    if "deprecated" not in warning:
        print(f"offbench: warning: MuJoCo: {warning.strip()}", file=sys.stderr)


def _ask_once(env: Any) -> None:
    """Let a task of Gymnasium's own work out once a step whether it is healthy.

    Its step asks twice, for the reward and for the end, and each time costs a tenth of the step.
    """
    kind: Any = type(env)
    if not (kind.__module__.startswith("gymnasium.envs.mujoco.") and hasattr(kind, "is_healthy")):
        return

    class AskedOnce(kind):  # type: ignore[misc]
        _healthy: Any = None

        @property
        def is_healthy(self) -> Any:
            if self._healthy is None:
                self._healthy = super().is_healthy
            return self._healthy

        def do_simulation(self, *arguments: Any) -> None:
            super().do_simulation(*arguments)
            self._healthy = None

        def set_state(self, *arguments: Any) -> None:
            super().set_state(*arguments)
            self._healthy = None

    env.__class__ = AskedOnce


def same_environment(a: str | None, b: str | None) -> bool:
    """Return whether two EnvSpecs (JSON) are the same environment; versions of wrappers do not count."""
    if a is None or b is None:
        return a is b
    first, second = json.loads(a), json.loads(b)
    same = all(first.get(key) == second.get(key) for key in WHAT_MATTERS)
    return same and first.get(MARGIN, EARLIER) == second.get(MARGIN, EARLIER)


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _check_spaces(env: gym.Env[Any, Any], where: str) -> None:
    try:
        box(env.observation_space, f"{where}: observations")
        actions = box(env.action_space, f"{where}: actions")
        if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
            raise OffbenchError(f"{where}: actions must be bounded, the action space is {actions}")
    finally:
        env.close()


def box(space: gym.Space[Any], what: str) -> gym.spaces.Box:
    """Return `space` if it is a flat float Box, else raise an OffbenchError that begins with `what`."""
    if not isinstance(space, gym.spaces.Box):
        raise OffbenchError(f"{what} must be a Box space, not {space}; wrap the environment to make it one")
    if len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise OffbenchError(f"{what} must be a flat Box of floats, not {space}; wrap it in FlattenObservation")
    return space
