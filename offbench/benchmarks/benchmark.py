"""`benchmark`: a whole grid, from missing datasets to the score table; stopped at any point, it goes on.

grid -> plan: runs, stacks, expected hours, disk (offbench.benchmarks.plan)
     -> datasets that are missing are recorded
     -> a shard's runs -> cut into parts -> what is left of them -> jobs -> an executor
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from offbench.benchmarks.datasets import record_source
from offbench.benchmarks.grid import Source, Times
from offbench.benchmarks.plan import Benchmark, Plan, prepare
from offbench.common.errors import OffbenchError
from offbench.training.grouping import Part, cut, diverged, pending, with_evaluators
from offbench.training.jobs import Job, Order, complain, run_jobs
from offbench.training.trainer import Schedule

UNITS = {"s": 1, "m": 60, "h": 3600}


class Executor(Protocol):
    """Where recordings and trainings happen."""

    def record(self, sources: Sequence[Source], workers: int) -> None:
        """Record datasets. Raises OffbenchError if one cannot be."""
        ...

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs as far as their deadline; return what went wrong, a line each."""
        ...


class LocalExecutor:
    """This machine's processes."""

    def __init__(self, deadline: float | None = None) -> None:
        self.deadline = deadline

    def record(self, sources: Sequence[Source], workers: int) -> None:
        """Record datasets, one after the other, until the deadline."""
        for source in sources:
            if self.deadline is None or time.time() < self.deadline:
                record_source(source, workers)

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs in so many processes."""
        return run_jobs(jobs, processes)


def benchmark(
    grid: str | Benchmark,
    *,
    budget: str | None = None,
    shard: tuple[int, int] = (0, 1),
    executor: Executor | None = None,
    command: str = "",
    say: Callable[[str], None] = print,
) -> bool:
    """Run a grid to its end, or as far as the budget allows; finished parts are left alone.

    Args:
        grid: a shipped grid's name such as `medium`, a file (`./mine.toml`), or what
            `offbench.benchmarks.plan.prepare` returns, which takes the folder, the device and the processes.
        budget: "9m", "2h" or "90s": stops cleanly after that time; the same call goes on.
        shard: (i, n): the i-th of n shares of the runs, for machines with a shared file system.
        executor: where it happens: this machine (default), or a cluster
            (`offbench.benchmarks.ray_executor.RayExecutor`).
        command: what the user typed, for each run's config.json.
        say: takes the plan, line by line.

    Returns:
        Whether the grid (of this shard) is finished.

    Raises:
        OffbenchError: anything that the user can mend; runs that diverged, once all others are done.
    """
    deadline = time.time() + _seconds(budget) if budget else None
    executor = executor or LocalExecutor(deadline)
    bench = prepare(grid) if isinstance(grid, str) else grid
    plan = Plan(bench)
    for line in plan:
        say(line)
    executor.record(bench.missing(), bench.workers)
    if bench.missing():
        return False  # out of time
    parts = _parts(bench, shard)
    jobs = [
        replace(job, cost=plan.update_seconds.get(job.kind, 1.0))
        for part, schedule in parts
        for job in pending(part, replace(schedule, deadline=deadline), command=command)
    ]
    jobs.sort(key=lambda job: job.work, reverse=True)  # a long one begun last would run beside idle ones
    if bench.device != "cpu":
        jobs = with_evaluators(jobs, bench.workers)
    for line in diverged([part for part, _ in parts]):  # known since an earlier call, which failed for it
        say(line)
    complain(executor.train(jobs, bench.processes) if jobs else [])
    return not any(pending(part, schedule, command=command) for part, schedule in parts)


def _seconds(text: str) -> float:
    """Return the seconds of `9m`, `1.5h` or `90s`."""
    try:
        value = float(text[:-1]) * UNITS[text[-1]]
    except (ValueError, KeyError, IndexError):
        raise OffbenchError(f"a budget is a time like 9m, 1.5h or 90s, not {text!r}") from None
    if not 0 < value < float("inf"):
        raise OffbenchError(f"a budget must be more than nothing, not {text!r}")
    return value


def _parts(bench: Benchmark, shard: tuple[int, int]) -> list[tuple[Part, Schedule]]:
    """Return this shard's parts. Runs of equal times are cut together, whatever their algorithm."""
    by_times: dict[Times, list[Order]] = {}
    for one, orders in zip(bench.variants, shared(bench, shard), strict=True):
        by_times.setdefault(replace(one.times, seeds=()), []).extend(orders)
    found = []
    for times, orders in by_times.items():
        schedule = Schedule(
            times.steps, times.eval_every, times.eval_episodes, bench.device, workers=0, precision=bench.precision
        )
        found += [(part, schedule) for part in cut(orders, bench.device, bench.processes, bench.stack)]
    return found


def shared(bench: Benchmark, shard: tuple[int, int]) -> list[list[Order]]:
    """Return a shard's runs of each variant: of each its share, by the grid alone, for machines differ.

    Raises:
        OffbenchError: there is no such shard.
    """
    place, count = shard
    if not 0 <= place < count:
        raise OffbenchError(f"a shard is i/n with i from 0 to n - 1, not {place}/{count}")
    found, first = [], 0
    for one in bench.variants:
        orders = bench.orders(one)
        mine = np.array_split(np.arange(len(orders)), count)[(place - first) % count]
        found.append([orders[i] for i in mine])
        first += len(orders)  # the first few have one more: next time the shares behind them
    return found
