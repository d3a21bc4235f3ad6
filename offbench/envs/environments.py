"""Environments: made from a recipe's id, or from the EnvSpec that a dataset or a run carries.

An EnvSpec names the code that makes the environment, so one that came in a file is checked before it is used.

The EnvSpecs that offbench passes around, and keeps in runs, may have a field that Gymnasium's do not have,
`contact_margin`: "sum" is the rule of MuJoCo 3.5 and later, "max", the default, that of earlier versions
(offbench.envs.contact_margins). Minari's metadata get the plain EnvSpec.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import multiprocessing
from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError, rendering_variable
from offbench.common.files import is_exhausted
from offbench.common.terminal import warn
from offbench.envs.margin_rule import MARGIN_KEY, MAX_RULE, without_margin
from offbench.envs.trust import check_code

Env: TypeAlias = gym.Env[Array, Array]
Space: TypeAlias = gym.Space[Any]
PASSIVE_WRAPPERS = {"OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics"}  # wrappers that change nothing
RENDERING_ARGUMENTS = {"render_mode", "width", "height", "camera_id", "camera_name", "default_camera_config"}
MAX_ACTION_BOUND = 1e6  # larger bounds, such as float32's maximum, count as none
MAX_EPISODE_STEPS = 20_000  # steps that an episode may take in an environment without a time limit
MAX_TIME_LIMIT = 1_000_000  # a larger time limit counts as none
STATEFUL_WRAPPERS = {"NormalizeObservation", "NormalizeReward"}
OTHER_ENV = "give the right environment with --env RECIPE"


def env_spec(env_id: str, **kwargs: Any) -> str:
    """Return Gymnasium's EnvSpec of `env_id` as JSON, checked to have flat Box spaces and bounded actions.

    Raises:
        OffbenchError: the environment cannot be made, or has other spaces.
    """
    try:
        with _quiet_loading(env_id):
            env = gym.make(env_id, **kwargs)
        assert env.spec is not None
        text = env.spec.to_json()
    except (Exception, SystemExit) as error:  # a third-party environment may raise anything here
        if is_exhausted(error):
            raise
        hint = _remedy(error)
        if isinstance(error, gym.error.NameNotFound | gym.error.NamespaceNotFound) and ":" not in env_id:
            hint = f". If a module of yours registers it, name it before a colon: my_module:{env_id}"
        raise OffbenchError(f"cannot make the environment {env_id!r}: {reason(error).rstrip('.')}{hint}") from error
    _check_repeatable(env.spec)
    spaces_of(env, env_id)
    _warn_no_time_limit(env_id, env.spec)
    return text


def parse_spec(text: str) -> EnvSpec:
    """Return Gymnasium's EnvSpec of JSON text, which may have the field for contact margins."""
    return EnvSpec.from_json(without_margin(text)[0])


def check_spec(
    text: str, where: str, observation_dim: int, low: Array, high: Array, *, from_recipe: bool = False
) -> None:
    """Check that the EnvSpec JSON of a file can be trusted and made, and has the file's shapes.

    Warns on stderr if the environment takes actions within other bounds than `low` and `high`, [act] each, or may
    never end.

    Args:
        from_recipe: whether the EnvSpec is of the user's own recipe, which may name any code.

    Raises:
        OffbenchError: it names code that is no Gymnasium environment, cannot be made, or has other shapes.
    """
    with contextlib.suppress(Exception):  # untrusted_env reports what is wrong with it
        spec = parse_spec(text)
        _warn_no_time_limit(spec.id, spec)
    try:
        env = make_env(text) if from_recipe else untrusted_env(text, where)
        observations, actions = spaces_of(env, where)
    except OffbenchError as error:
        raise OffbenchError(f"{error}; to evaluate in another environment, {OTHER_ENV}") from error
    name = env.spec.id if env.spec else "?"
    shapes = (observations.shape, actions.shape)
    if shapes != ((observation_dim,), low.shape):
        raise OffbenchError(
            f"{where} has observations ({observation_dim},) and actions {low.shape}; the environment {name} has "
            f"{shapes[0]} and {shapes[1]}: {OTHER_ENV}"
        )
    if not same_bounds(actions, low, high):
        warn(
            f"{where} has actions with bounds {_bounds(low, high)}, the environment {name} takes "
            f"{_bounds(actions.low, actions.high)}: returns in it are not those of the data's task"
        )


def same_bounds(space: gym.spaces.Box, low: Array, high: Array) -> bool:
    """Return whether a space has these bounds, but for rounding to float32."""
    return bool(np.allclose(space.low, low, 1e-6, 1e-6) and np.allclose(space.high, high, 1e-6, 1e-6))


def _bounds(low: Array, high: Array) -> str:
    if len(np.unique(low)) == len(np.unique(high)) == 1:
        return f"[{low.flat[0]:g}, {high.flat[0]:g}]"
    return ", ".join(f"[{a:g}, {b:g}]" for a, b in zip(low.flat, high.flat, strict=True))


def untrusted_env(text: str, where: str) -> Env:
    """Make the environment of an EnvSpec (JSON) that came in a file, if what it names is an environment.

    Raises:
        OffbenchError: it names code that is no Gymnasium environment, or cannot be made.
    """
    try:
        spec = parse_spec(text)
        _check_repeatable(spec)
        for wrapper in spec.additional_wrappers:
            if wrapper.kwargs is None:
                raise OffbenchError(
                    f"its environment {spec.id} cannot be made again: the wrapper {wrapper.name} does not record its "
                    "arguments"
                )
        check_code(spec)
        env = make_env(text)
        for space in ("observation_space", "action_space"):
            if not isinstance(getattr(env, space, None), gym.Space):
                raise OffbenchError(f"its environment {spec.id} has no {space}")
        return env
    except OffbenchError as error:
        raise OffbenchError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:  # see env_spec
        if is_exhausted(error):
            raise
        raise OffbenchError(
            f"{where}: cannot make its environment: {reason(error).rstrip('.')}{_remedy(error)}"
        ) from error


def _check_repeatable(spec: EnvSpec | None) -> None:
    """Refuse an environment that worker processes cannot import, or whose episodes depend on earlier episodes."""
    wrappers = spec.additional_wrappers if spec else ()
    points = [str(item.entry_point) for item in (spec, *wrappers) if item]
    for wrapper in wrappers:
        if wrapper.name in STATEFUL_WRAPPERS:
            raise OffbenchError(
                f"the environment has the wrapper {wrapper.name}, whose statistics carry over from one episode to the "
                "next: results would depend on the order of the episodes; use the environment without it"
            )
    if spec and any(point.startswith("__main__:") for point in points):
        raise OffbenchError(
            f"the environment {spec.id} is defined in the script itself (__main__), where worker processes cannot "
            "import it; move it into a module and register it there"
        )


def time_limit(spec: EnvSpec | None) -> int | None:
    """Return the steps after which an environment truncates, None if it has no time limit."""
    limit = spec.max_episode_steps if spec else None
    for wrapper in spec.additional_wrappers if spec else ():
        limit = (wrapper.kwargs or {}).get("max_episode_steps", limit) if wrapper.name == "TimeLimit" else limit
    return limit if isinstance(limit, int) and 0 < limit <= MAX_TIME_LIMIT else None


def _warn_no_time_limit(name: str, spec: EnvSpec | None) -> None:
    """Warn once about an environment without a time limit, in which an episode may never end."""
    if time_limit(spec) is None and name not in _warned_no_time_limit and multiprocessing.parent_process() is None:
        _warned_no_time_limit.add(name)
        warn(
            f"{name} has no time limit (max_episode_steps): an episode that does not end within "
            f"{MAX_EPISODE_STEPS:,} steps is an error"
        )


_warned_no_time_limit: set[str] = set()  # environments that a warning was printed for


def make_env(env_spec: str, render_mode: str | None = None) -> Env:
    """Make the environment of an EnvSpec (JSON) with its contact margins, without Gymnasium's environment checker."""
    plain, rule = without_margin(env_spec)
    spec = EnvSpec.from_json(plain)
    spec.disable_env_checker = True
    spec.kwargs.pop("render_mode", None)  # the mode of whoever recorded the data could open a window
    with _quiet_loading(spec.id):
        env: Env = gym.make(spec, render_mode=render_mode) if render_mode else gym.make(spec)
    if hasattr(env.unwrapped, "model"):
        from offbench.envs.contact_margins import model_of, set_contacts  # imports MuJoCo, which is slow to load

        if (model := model_of(env)) is not None:
            set_contacts(model, rule, spec.id)
    _cache_health(env.unwrapped)
    return env


@contextlib.contextmanager
def _quiet_loading(env_id: str) -> Iterator[None]:
    """Suppress MuJoCo's warnings of deprecated elements in Gymnasium's models, such as HalfCheetah's `settotalmass`.

    MuJoCo would print them and write MUJOCO_LOG.TXT into the working directory, for each environment that is made.
    """
    registered = gym.registry.get(env_id)
    if registered is None or not str(registered.entry_point).startswith("gymnasium.envs.mujoco."):
        yield
        return
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_warn_unless_deprecated)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _warn_unless_deprecated(warning: str) -> None:
    if "deprecated" not in warning:
        warn(f"MuJoCo: {warning.strip()}")


def _cache_health(env: Env) -> None:
    """Compute `is_healthy` of Gymnasium's own tasks once per step.

    Their step reads it twice, for the reward and for the termination, and each time takes a tenth of the step.
    """
    cls: Any = type(env)
    if not (cls.__module__.startswith("gymnasium.envs.mujoco.") and hasattr(cls, "is_healthy")):
        return

    class CachedHealth(cls):  # type: ignore[misc]
        _healthy: bool | None = None

        @property
        def is_healthy(self) -> bool | None:
            if self._healthy is None:
                self._healthy = super().is_healthy
            return self._healthy

        def do_simulation(self, *arguments: object) -> None:
            super().do_simulation(*arguments)
            self._healthy = None

        def set_state(self, *arguments: object) -> None:
            super().set_state(*arguments)
            self._healthy = None

    env.__class__ = CachedHealth


def same_environment(a: str | None, b: str | None) -> bool:
    """Return whether two EnvSpecs (JSON) are the same environment.

    Rendering, wrappers that change nothing, and where the code of environment and wrappers is do not count.
    """
    if a is None or b is None:
        return a is b
    return _identity(json.loads(a)) == _identity(json.loads(b))


def _identity(spec: Mapping[str, Any]) -> tuple[object, ...]:
    """Return what an EnvSpec shares with those of the same environment."""
    kwargs, wrappers = spec.get("kwargs") or {}, spec.get("additional_wrappers") or []
    if isinstance(kwargs, dict):
        kwargs = {key: value for key, value in kwargs.items() if key not in RENDERING_ARGUMENTS}
    if isinstance(wrappers, list):
        named = [(w.get("name"), w.get("kwargs") or {}) if isinstance(w, dict) else (w, {}) for w in wrappers]
        wrappers = [wrapper for wrapper in named if str(wrapper[0]) not in PASSIVE_WRAPPERS]
    return spec.get("id"), kwargs, spec.get("max_episode_steps"), wrappers, spec.get(MARGIN_KEY, MAX_RULE)


def reason(error: BaseException) -> str:
    """Return the first line of an exception's text, or its type."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _remedy(error: BaseException) -> str:
    """Return what to do about an environment that cannot be made, "" if there is no general advice."""
    if variable := rendering_variable(error):
        return f"; unset {variable}"
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if package and importlib.util.find_spec(package) is None:
        return f"; install the package that has the module {package}"
    return ""


def spaces_of(env: Env, where: str) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Close an environment; return its spaces of observations and actions.

    Raises:
        OffbenchError: they are no flat float Boxes, or actions have no bounds; it begins with `where`.
    """
    try:
        return box(env.observation_space, f"{where}: observations"), action_box(env.action_space, f"{where}: actions")
    finally:
        env.close()


def box(space: Space, what: str) -> gym.spaces.Box:
    """Return `space` if it is a flat float Box, else raise an OffbenchError that begins with `what`."""
    if isinstance(space, gym.spaces.Box) and not np.issubdtype(space.dtype, np.floating) and len(space.shape) == 1:
        raise OffbenchError(f"{what} must be floats, not {space}; convert them and their space to float32")
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        kind = "flat Box" if isinstance(space, gym.spaces.Box) else "Box space"
        raise OffbenchError(f"{what} must be a {kind}, not {space}; {_flattening(space, what)}")
    if not space.shape[0]:
        raise OffbenchError(f"{what} have no dimension: {space}")
    return space


MAX_FLAT_SIZE = 1_000_000  # dimensions


def _flattening(space: Space, what: str) -> str:
    """Return how to turn a space of observations into a flat Box of floats; actions cannot be turned into one."""
    if "observation" not in what:
        return "offbench's algorithms choose continuous actions, one number for each dimension"
    try:
        flat: Space = gym.spaces.flatten_space(space) if gym.spaces.flatdim(space) < MAX_FLAT_SIZE else space
    except (NotImplementedError, ValueError):
        flat = space
    if not isinstance(flat, gym.spaces.Box):
        return "turn them into numbers and record the dataset again"
    floats = "" if np.issubdtype(flat.dtype, np.floating) else " and DtypeObservation(env, np.float32)"
    return f"wrap the environment in FlattenObservation{floats} and record the dataset again"


def action_box(space: Space, what: str) -> gym.spaces.Box:
    """Return `space` if it is a flat float Box with bounds that actions can be scaled by, else raise OffbenchError."""
    actions = box(space, what)
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise OffbenchError(f"{what} must be bounded to be scaled, not {actions}")
    largest = max(np.abs(actions.low).max(), np.abs(actions.high).max())
    if largest > MAX_ACTION_BOUND:
        raise OffbenchError(
            f"{what} must be bounded to be scaled; a bound of {largest:.3g} is none (at most "
            f"{MAX_ACTION_BOUND:,.0f}): correct the action space to what the environment takes"
        )
    if not (actions.low < actions.high).all():
        raise OffbenchError(
            f"{what}: a lower bound is not below its upper bound in {actions}; correct the action space"
        )
    return actions
