"""Checks of environments that a file names: what may be imported and made, and with which arguments.

A dataset, run or policy names the code that makes its environment. It is checked by name, before anything is
imported. Recipes are the user's own and are not checked.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import importlib.util
import math
import os
import re
import sys
from collections.abc import Iterator

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from offbench.common.errors import OffbenchError
from offbench.common.processes import environment
from offbench.common.settings import short_repr

VARIABLE = "OFFBENCH_TRUST"
REMEDY = f"if you trust where it is from, add --trust ({VARIABLE}=1 in Python)"
# packages whose environments need not be registered; imported D4RL files name gym's
PACKAGES = ("gymnasium.envs.", "gymnasium_robotics.envs.", "gym.envs.")
DISTRIBUTIONS = {"gymnasium": "gymnasium", "gymnasium_robotics": "gymnasium-robotics", "gym": "gym"}
# wrappers of gymnasium.wrappers for flat spaces that write no file, open no window and take no function
WRAPPERS = {
    "ClipAction",
    "ClipReward",
    "DelayObservation",
    "DtypeObservation",
    "FilterObservation",
    "FlattenObservation",
    "FrameStackObservation",
    "MaxAndSkipObservation",
    "OrderEnforcing",
    "PassiveEnvChecker",
    "RecordEpisodeStatistics",
    "RepeatAction",
    "RescaleAction",
    "RescaleObservation",
    "ReshapeObservation",
    "StickyAction",
    "TimeAwareObservation",
    "TimeLimit",
}
ENTRY_POINT = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)", re.ASCII)
MAX_ARGUMENT = 10_000  # whole number among arguments: frame_skip = 2e9 would never return
MULTIPLYING = ("frame_skip", "num_repeats", "skip", "stack_size", "delay")  # arguments whose effects multiply
MAX_ARGUMENT_VALUES = 10_000  # values in all arguments together
DEEPEST_NESTING = 10
MAX_TEXT_LENGTH = 200  # characters of a text


@contextlib.contextmanager
def trusting() -> Iterator[None]:
    """Let files name any environment within this context, in processes started in it too."""
    with environment({VARIABLE: "1"}):
        yield


def is_trusting() -> bool:
    """Return whether the user trusts the files of this command (--trust)."""
    return os.environ.get(VARIABLE) == "1"


def check_code(spec: EnvSpec) -> None:
    """Check the EnvSpec of a file; nothing that is not allowed is imported.

    Raises:
        OffbenchError: it names code or arguments that are not allowed, or no environment or wrapper class.
    """
    registered = gym.registry.get(spec.id)
    if registered is None or registered.entry_point != spec.entry_point:
        _check_class(spec.entry_point, gym.Env)
    for wrapper in spec.additional_wrappers:
        _check_class(wrapper.entry_point, gym.Wrapper)
    if not is_trusting():
        limit = spec.max_episode_steps
        if limit is not None and (type(limit) is not int or not (limit > 0 or limit == -1)):  # -1: no limit
            raise OffbenchError(f"its time limit is {short_repr(limit)}, not a number of steps")
        checker, times = _ArgumentChecker(), 1
        for name, kwargs in ((spec.id, spec.kwargs), *((w.name, w.kwargs or {}) for w in spec.additional_wrappers)):
            checker.check(kwargs, f"the arguments of {name}")
            times *= math.prod(max(1, kwargs[key]) for key in MULTIPLYING if isinstance(kwargs.get(key), int))
        if times > MAX_ARGUMENT:
            raise OffbenchError(
                f"it would repeat or stack {times:,} steps, and {MAX_ARGUMENT:,} are allowed; {REMEDY}"
            )


def needs_trust(spec: EnvSpec) -> bool:
    """Return whether a file with this EnvSpec is refused without --trust, in a process that has registered nothing."""
    names = ENTRY_POINT.fullmatch(str(spec.entry_point))
    if names is None or not f"{names[1]}.".startswith(PACKAGES):
        return True
    try:
        check_code(spec)
    except OffbenchError:
        return True
    return False


def _check_class(entry_point: object, base: type) -> None:
    names = ENTRY_POINT.fullmatch(str(entry_point))
    if names is None:
        raise OffbenchError(
            f"its entry point {str(entry_point)[:MAX_TEXT_LENGTH]!r} does not have the form module:Class"
        )
    if not (is_trusting() or _is_allowed(names[1], names[2], base)):
        kind = "environments" if base is gym.Env else "wrappers"
        raise OffbenchError(
            f"it would run {entry_point}, which is not among the {kind} that a file may name; {REMEDY}"
        )
    if not is_trusting():
        _check_installed(names[1])
    cls = getattr(importlib.import_module(names[1]), names[2], None)
    if not (isinstance(cls, type) and issubclass(cls, base) and cls is not base):
        raise OffbenchError(
            f"its entry point {entry_point!r} is not a class derived from {base.__name__}, so it is not run"
        )


def _check_installed(module: str) -> None:
    """Check that Python would import an allowed package as it was installed, and not a folder of the same name.

    Raises:
        OffbenchError: there is such a folder, in the working directory for example.
    """
    package = module.partition(".")[0]
    if package in sys.modules or package not in DISTRIBUTIONS:
        return
    package_spec = importlib.util.find_spec(package)
    if package_spec is None:
        return  # the import reports it
    folders = [os.path.realpath(path) for path in package_spec.submodule_search_locations or ()]
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        installed = importlib.metadata.distribution(DISTRIBUTIONS[package]).locate_file(package)
        if os.path.realpath(str(installed)) in folders:
            return
    raise OffbenchError(f"it would run {module} from {', '.join(folders)}, where it is not installed; {REMEDY}")


def _is_allowed(module: str, name: str, base: type) -> bool:
    if base is gym.Wrapper:
        return f"{module}.".startswith("gymnasium.wrappers.") and name in WRAPPERS
    registered = (spec.entry_point for spec in gym.registry.values())
    return f"{module}.".startswith(PACKAGES) or f"{module}:{name}" in registered


class _ArgumentChecker:
    """Checks that arguments are numbers, short texts that are not paths, or lists and tables of these."""

    def __init__(self) -> None:
        self.count = 0

    def check(self, value: object, where: str, depth: int = 0) -> None:
        self.count += 1
        if self.count > MAX_ARGUMENT_VALUES or depth > DEEPEST_NESTING:
            raise OffbenchError(f"{where} are too many or too deeply nested; {REMEDY}")
        if isinstance(value, dict):
            for key, item in value.items():
                self.check(key, where, depth)
                self.check(item, where, depth + 1)
        elif isinstance(value, list | tuple):
            for item in value:
                self.check(item, where, depth + 1)
        elif isinstance(value, str):
            if len(value) > MAX_TEXT_LENGTH or re.search(r"[/\\:\0]", value) or value.startswith((".", "~")):
                raise OffbenchError(
                    f"{where} contain {value[:MAX_TEXT_LENGTH]!r}, which may lead to a file or module; {REMEDY}"
                )
        elif isinstance(value, int):
            if abs(value) > MAX_ARGUMENT:
                raise OffbenchError(
                    f"{where} contain {str(value)[:20]}, and whole numbers may be {MAX_ARGUMENT:,} at most; {REMEDY}"
                )
        elif not isinstance(value, float | None):
            raise OffbenchError(f"{where} contain a {type(value).__name__}; {REMEDY}")
