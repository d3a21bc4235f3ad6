"""Jobs: stacks as plain values, so that another process, or another machine, can train them.

Order   one run: algorithm, dataset, settings, seed, where it is written, for how long
Job     the orders that train together
perform(job)             trains it in this process
run_jobs(jobs, n)        trains them in n processes, and shows one progress bar for all
"""

from __future__ import annotations

import collections
import contextlib
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from offbench.common.errors import OffbenchError
from offbench.common.processes import announce_stop, quiet_start, start_worker
from offbench.common.progress import Progress
from offbench.common.settings import build
from offbench.data import transitions
from offbench.data.transitions import Transitions
from offbench.training.batches import Member
from offbench.training.registry import failure, load_algorithm
from offbench.training.run import Run
from offbench.training.trainer import STOPPED, Report, Schedule, Trainer


@dataclass(frozen=True)
class Order:
    """One run that is to be trained.

    Attributes:
        settings: the algorithm's, by name; what is left out has its default.
        folder: the run's directory.
    """

    algorithm: str
    dataset: str
    settings: dict[str, Any]
    seed: int
    folder: str

    def member(self, data: Transitions | None = None) -> Member:
        """Return the run as a stack takes it. Raises OffbenchError for a bad setting or dataset."""
        config: Any = build(load_algorithm(self.algorithm).Config, self.settings, self.algorithm)
        data = data or transitions.load(self.dataset)
        return Member(Run(Path(self.folder)), self.seed, config, data, self.algorithm)


@dataclass(frozen=True)
class Job:
    """A stack that is to be trained.

    Attributes:
        cost: of a run's update, beside those of the other jobs: for the time left.
    """

    kind: str
    orders: tuple[Order, ...]
    schedule: Schedule
    cost: float = 1.0

    @property
    def updates(self) -> int:
        """Updates of all its runs together."""
        return len(self.orders) * self.schedule.steps

    @property
    def work(self) -> float:
        """What its updates cost, all runs together, beside the other jobs."""
        return self.updates * self.cost

    @property
    def title(self) -> str:
        """What a progress bar calls it."""
        first, runs = self.orders[0], len(self.orders)
        return f"{self.kind} on {first.dataset}" + (f" ({runs} runs)" if runs > 1 else "")


def perform(job: Job, report: Report) -> list[str]:
    """Train a job in this process.

    Returns:
        A line for each run that diverged.

    Raises:
        OffbenchError: anything that the user can mend.
    """
    from offbench.training.devices import arithmetic

    loaded = {name: transitions.load(name) for name in dict.fromkeys(order.dataset for order in job.orders)}
    members = [order.member(loaded[order.dataset]) for order in job.orders]
    with arithmetic(job.schedule.device, job.schedule.precision):
        return Trainer(load_algorithm(job.kind), members, job.schedule).train(report)


def run_jobs(jobs: Sequence[Job], processes: int) -> list[str]:
    """Train jobs, so many at a time; a job that fails does not stop the others.

    Returns:
        What went wrong, a line each.
    """
    with Board(jobs) as board:
        if processes == 1 or len(jobs) == 1:
            return [line for i, job in enumerate(jobs) for line in _here(job, i, board)]
        with _Pool(board) as pool:
            return list(_spread(jobs, processes, pool))


def complain(problems: Sequence[str]) -> None:
    """Raise OffbenchError for the first of several problems, saying how many more there are; none is none."""
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise OffbenchError(problems[0] + more)


class Board(contextlib.AbstractContextManager["Board"]):
    """Adds up the jobs' steps for one progress bar."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs, self.steps = jobs, dict[int, int]()
        runs = sum(len(job.orders) for job in jobs)
        title = jobs[0].title if len(jobs) == 1 else f"{runs} runs"
        self.progress = Progress(sum(job.updates for job in jobs), title, work=sum(job.work for job in jobs))

    def __exit__(self, *error: Any) -> None:
        self.progress.__exit__(*error)

    def heard(self, job: int, step: int, note: str) -> None:
        """Take in one of a job's reports, none of which is missed: they say where it goes on and where it stops."""
        if job not in self.steps and step:
            self.progress.say(f"{self.jobs[job].title}: going on from step {step:,}")
        self.at(job, step, note)
        if note == STOPPED:
            self.progress.say(f"{self.jobs[job].title}: stopped at step {step:,}, checkpoint saved")

    def at(self, job: int, step: int, note: str) -> None:
        """Take in that a job is at `step`."""
        if job not in self.steps:  # what was there before counts as done, not as speed
            done = step * len(self.jobs[job].orders)
            self.progress.skip(done, done * self.jobs[job].cost)
        self.steps[job] = step
        done_of = {i: step * len(self.jobs[i].orders) for i, step in self.steps.items()}
        work = sum(done * self.jobs[i].cost for i, done in done_of.items())
        self.progress.to(sum(done_of.values()), note, work)


def _here(job: Job, place: int, board: Board) -> list[str]:
    if is_over(job):
        return []
    try:
        return perform(job, lambda step, note: board.heard(place, step, note))
    except OffbenchError as error:
        if len(board.jobs) == 1:
            raise
        return [str(error)]


def is_over(job: Job) -> bool:
    """Whether a job's deadline has passed."""
    return job.schedule.deadline is not None and time.time() > job.schedule.deadline


class _Pool(contextlib.AbstractContextManager["_Pool"]):
    """The processes at work; leaving the context ends them, each with a checkpoint."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.active: dict[Connection, tuple[int, multiprocessing.process.BaseProcess]] = {}

    def start(self, place: int, job: Job) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(job, theirs, os.getpid()), daemon=False)
        with quiet_start():
            process.start()
        theirs.close()
        self.active[ours] = (place, process)

    def end(self, pipe: Connection) -> None:
        _, process = self.active.pop(pipe)
        pipe.close()
        process.join()

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        at_work = [process for _, process in self.active.values()]
        for process in at_work:
            process.terminate()
        if kind is KeyboardInterrupt:
            announce_stop()
        try:
            for pipe, (place, _) in list(self.active.items()):
                with contextlib.suppress(EOFError, OSError):  # it has ended
                    while (heard := pipe.recv())[0] is not None:
                        self.board.heard(place, *heard[:2])
                self.end(pipe)
        except KeyboardInterrupt:
            for process in at_work:
                process.kill()
            raise


def _spread(jobs: Sequence[Job], processes: int, pool: _Pool) -> Iterator[str]:
    waiting = collections.deque(enumerate(jobs))
    while waiting or pool.active:
        while waiting and len(pool.active) < processes:
            place, job = waiting.popleft()
            if not is_over(job):
                pool.start(place, job)
        # to wait for nothing, where all jobs that were left are over, is to wait for ever
        for ready in wait(list(pool.active)) if pool.active else ():
            assert isinstance(ready, Connection)
            at_work = pool.active[ready][0]
            try:
                step, note, lines = ready.recv()
            except EOFError:
                step, note = None, ""
                lines = [f"a training process died (killed, or out of memory): {jobs[at_work].title}"]
            if step is not None:
                pool.board.heard(at_work, step, note)
                continue
            yield from lines
            pool.end(ready)


def _work(job: Job, pipe: Connection, parent: int) -> None:
    """The life of a training process: (step, note, None) as it goes, then (None, "", problems)."""
    start_worker(parent)
    try:
        lines = perform(job, lambda step, note: pipe.send((step, note, None)))
    except OffbenchError as error:
        lines = [str(error)]
    except Exception as error:
        lines = [f"{job.title}: {failure(error)}"]
    pipe.send((None, "", lines))
