"""How many processes to use."""

from __future__ import annotations

import os

from offbench.errors import OffbenchError


def cores() -> int:
    """Return the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_workers(workers: int | None) -> int:
    """Return `workers`, or one a core if it is None. Raises OffbenchError below 1."""
    if workers is None:
        return cores()
    if workers < 1:
        raise OffbenchError(f"workers must be at least 1, not {workers}")
    return workers
