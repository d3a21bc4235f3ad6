"""Algorithms by name: ours and third parties', through the entry-point group `offbench.algos`."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import os
import sys
import traceback
import types
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from offbench.common.errors import SHOW_TRACEBACK, OffbenchError, drawing_variable, unknown
from offbench.common.files import OPEN_FILES

if TYPE_CHECKING:
    from offbench.algorithm.interface import Algorithm

GROUP = "offbench.algos"


NEEDED = ("batch_size", "normalize")  # settings that the training itself reads
# Settings of earlier versions, which bdb_plus has now, and the values under which a run trains as without them.
FORMER_SETTINGS: dict[str, dict[str, Any]] = {
    "bdb": {
        "uncertainty": "absolute",
        "uncertainty_scale": 1.0,
        "beta_max": 1.0,
        "cloning_steps": 0,
        "beta_target": 0.05,
        "beta_learning_rate": 3e-4,
        "critic_penalty": "none",
        "penalty_weight": 1.0,
        "penalty_actions": 10,
    }
}


@functools.cache
def _entry_points() -> dict[str, list[importlib.metadata.EntryPoint]]:
    found: dict[str, list[importlib.metadata.EntryPoint]] = {}
    for package in importlib.metadata.distributions():
        try:
            points = package.entry_points.select(group=GROUP)
        except Exception as error:  # a package whose metadata are damaged must not stop the others
            print(f"offbench: warning: {package} has unreadable entry points ({error})", file=sys.stderr)
            continue
        for point in points:
            if point not in (same := found.setdefault(point.name, [])):
                same.append(point)
    return found


def algorithm_names() -> list[str]:
    """Return the names of all installed algorithms, ours and third parties'."""
    return sorted(_entry_points())


def failure(error: Exception) -> str:
    """Return what has gone wrong and what to do about it, whatever was raised.

    The traceback goes to stderr if $OFFBENCH_TRACEBACK is set, or if an installed algorithm has the fault: whoever
    writes one needs it.
    """
    expected = isinstance(error, OffbenchError | OSError | MemoryError)
    algorithm = None if expected else _third_party(error.__traceback__)
    if algorithm or os.environ.get("OFFBENCH_TRACEBACK"):
        traceback.print_exception(error)
    if isinstance(error, OffbenchError):
        return str(error)
    if isinstance(error, MemoryError):
        return f"not enough memory ({error or 'for this command'}); close other programs, or ask for less"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        remedy = f"; {OPEN_FILES[error.errno]}" if error.errno in OPEN_FILES else ""
        return f"{where}{error.strerror or error}{remedy} ({SHOW_TRACEBACK})"
    if not algorithm and (variable := drawing_variable(error)):
        return f"MuJoCo does not load with {variable} ({type(error).__name__}: {error}); unset it or choose another"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    what = f"{type(error).__name__}: {error} (at {frame.filename}:{frame.lineno})"
    if algorithm:
        return f"an error in the package {algorithm}: {what}; see the traceback above"
    return f"this is a bug in offbench: {what}; please report it; {SHOW_TRACEBACK}"


def _third_party(trace: types.TracebackType | None) -> str | None:
    """Return the package of an algorithm, not offbench's own, that a traceback leads through."""
    packages = {point.module.partition(".")[0] for points in _entry_points().values() for point in points}
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
        if package in packages - {"offbench"}:
            return package
        trace = trace.tb_next
    return None


def load_algorithm(name: str) -> type[Algorithm]:
    """Return an algorithm's class by name.

    Raises:
        OffbenchError: it is unknown, two packages have one of that name, it does not import, or has no sound Config.
    """
    points = _entry_points()
    if name not in points:
        raise unknown("algorithm", name, points)
    point, *others = points[name]
    if others:
        raise OffbenchError(f"two algorithms are named {name!r}: {point.value} and {others[0].value}; rename yours")
    try:
        kind = point.load()
    except Exception as error:  # whatever its code raises
        why = f"{type(error).__name__}: {error}"
        raise OffbenchError(f"algorithm {name!r} ({point.value}) does not import: {why} ({SHOW_TRACEBACK})") from error
    from offbench.algorithm.interface import Algorithm  # imports PyTorch, which those who ask for names do without

    if not (isinstance(kind, type) and issubclass(kind, Algorithm)):
        raise OffbenchError(
            f"algorithm {name!r} ({point.value}) must be a subclass of offbench.algorithm.Algorithm; "
            "see docs/extending.md"
        )
    config = getattr(kind, "Config", None)
    if not (isinstance(config, type) and dataclasses.is_dataclass(config)):
        raise OffbenchError(f"algorithm {name!r} ({point.value}): Config must be a dataclass of settings")
    for needed in NEEDED:
        if needed not in {field.name for field in dataclasses.fields(config)}:
            raise OffbenchError(f"algorithm {name!r} ({point.value}): its Config lacks the setting {needed}")
    return kind


def current_settings(algorithm: str, settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a run's recorded settings without those that its algorithm had in an earlier version only.

    Raises:
        OffbenchError: one of them had an effect, so that the run can be reported but not resumed or restored.
    """
    former = FORMER_SETTINGS.get(algorithm, {})
    used = {name: settings[name] for name, off in former.items() if settings.get(name, off) != off}
    if algorithm == "bdb" and settings.get("beta") == "learned":
        used["beta"] = "learned"
    if used:
        name, value = next(iter(used.items()))
        raise OffbenchError(
            f"{where} was trained by an earlier version of {algorithm} with {name} = {value!r}, which is a setting of "
            "bdb_plus now; the run can still be reported and evaluated, but not resumed"
        )
    return {name: value for name, value in settings.items() if name not in former}
