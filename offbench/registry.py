"""Algorithms by name: ours and third parties', through the entry-point group `offbench.algos`."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
from typing import TYPE_CHECKING, cast

from offbench.errors import OffbenchError, unknown

if TYPE_CHECKING:
    from offbench.algorithm import Algorithm

GROUP = "offbench.algos"


NEEDED = ("batch_size", "normalize")  # settings that the training itself reads


@functools.cache
def _entry_points() -> dict[str, list[importlib.metadata.EntryPoint]]:
    found: dict[str, list[importlib.metadata.EntryPoint]] = {}
    for point in importlib.metadata.entry_points(group=GROUP):
        if point not in (same := found.setdefault(point.name, [])):
            same.append(point)
    return found


def algorithm_names() -> list[str]:
    """Return the names of all installed algorithms, ours and third parties'."""
    return sorted(_entry_points())


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
    except (ImportError, AttributeError) as error:
        raise OffbenchError(f"algorithm {name!r} ({point.value}) does not import: {error}") from error
    config = getattr(kind, "Config", None)
    if not (isinstance(config, type) and dataclasses.is_dataclass(config)):
        raise OffbenchError(f"algorithm {name!r} ({point.value}): Config must be a dataclass of settings")
    for needed in NEEDED:
        if needed not in {field.name for field in dataclasses.fields(config)}:
            raise OffbenchError(f"algorithm {name!r} ({point.value}): its Config lacks the setting {needed}")
    return cast("type[Algorithm]", kind)
