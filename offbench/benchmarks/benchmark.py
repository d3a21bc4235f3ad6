"""`benchmark`: a whole grid, from missing datasets to the score table; it resumes wherever it was stopped.

grid -> plan: runs, expected hours and disk space (offbench.benchmarks.plan)
     -> missing datasets are recorded
     -> a shard's runs -> Training (offbench.training.train) -> an executor
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from offbench.benchmarks.datasets import record_dataset
from offbench.benchmarks.grid import GridDataset
from offbench.benchmarks.plan import Benchmark, is_longer, prepare, shard_of, write_plan
from offbench.common.errors import OffbenchError
from offbench.training.jobs import raise_first, run_jobs
from offbench.training.spec import Job
from offbench.training.train import Training

UNITS = {"s": 1, "m": 60, "h": 3600}


class Executor(Protocol):
    """Where recordings and trainings happen."""

    def record(self, datasets: Sequence[GridDataset], workers: int, deadline: float | None = None) -> None:
        """Record datasets, none after the deadline. Raises OffbenchError if one cannot be recorded."""
        ...

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs up to their deadline; return what went wrong, a line each."""
        ...


class LocalExecutor:
    """This machine's processes."""

    def record(self, datasets: Sequence[GridDataset], workers: int, deadline: float | None = None) -> None:
        """Record datasets, one after the other, until the deadline."""
        for dataset in datasets:
            if deadline is None or time.time() < deadline:
                record_dataset(dataset, workers)

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs, up to `processes` at a time."""
        return run_jobs(jobs, processes)


def benchmark(
    grid: str | Path | Benchmark,
    *,
    budget: str | float | None = None,
    shard: tuple[int, int] = (0, 1),
    executor: Executor | None = None,
    command: str = "",
    say: Callable[[str], None] = print,
) -> bool:
    """Run a grid to its end, or as far as the budget allows; finished runs are left as they are.

    Args:
        grid: a shipped grid's name such as `medium`, a file (`./mine.toml`), or what
            `offbench.benchmarks.plan.prepare` returns, which takes the folder, the device and the processes.
        budget: "9m", "2h", "90s" or seconds: stops with checkpoints after that time; the same call resumes.
        shard: (i, n): the i-th of n shares of the runs, for machines with a shared file system.
        executor: this machine (default), or a cluster (`offbench.benchmarks.ray_executor.RayExecutor`).
        command: what the user typed, for each run's config.json.
        say: receives each line of the plan.

    Returns:
        Whether the grid (of this shard) is finished.

    Raises:
        OffbenchError: anything that the user can fix; runs that diverged, once all others are done.
    """
    deadline = time.time() + _seconds(budget) if budget is not None else None
    executor = executor or LocalExecutor()
    bench = grid if isinstance(grid, Benchmark) else prepare(grid)
    update_seconds = write_plan(bench, shard, say)
    executor.record(bench.missing(), bench.machine.workers, deadline)
    if bench.missing():
        return False  # out of time
    specs = [spec for share in shard_of(bench, shard) for spec in share if not is_longer(spec)]
    training = Training(specs, bench.machine, command=command)
    for line in training.diverged:  # an earlier call raised for these
        say(line)
    raise_first(training.run(executor.train, deadline=deadline, cost=update_seconds))
    return not training.unfinished_jobs()


def _seconds(budget: str | float) -> float:
    """Return the seconds of `9m`, `1.5h`, `90s` or a number."""
    try:
        value = float(budget[:-1]) * UNITS[budget[-1]] if isinstance(budget, str) else float(budget)
    except (ValueError, TypeError, KeyError, IndexError):
        raise OffbenchError(f"a budget is a time like 9m, 1.5h or 90s, not {budget!r}") from None
    if not 0 < value < float("inf"):
        raise OffbenchError(f"a budget must be positive, not {budget!r}")
    return value
