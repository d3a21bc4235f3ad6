"""Algorithms by name: ours and third parties', through the entry-point group `offbench.algos`."""

from __future__ import annotations

import functools
import importlib.metadata
from typing import TYPE_CHECKING, cast

from offbench.errors import OffbenchError, unknown

if TYPE_CHECKING:
    from offbench.algorithm import Algorithm

GROUP = "offbench.algos"


@functools.cache
def _entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}


def algorithm_names() -> list[str]:
    """Return the names of all installed algorithms, ours and third parties'."""
    return sorted(_entry_points())


def load_algorithm(name: str) -> type[Algorithm]:
    """Return an algorithm's class by name. Raises OffbenchError if it is unknown or does not import."""
    points = _entry_points()
    if name not in points:
        raise unknown("algorithm", name, points)
    try:
        return cast("type[Algorithm]", points[name].load())
    except (ImportError, AttributeError) as error:
        raise OffbenchError(f"algorithm {name!r} ({points[name].value}) does not import: {error}") from error
