"""Training jobs in this process, or in several with one progress bar for all.

train_job(job)           trains it in this process
run_jobs(jobs, n)        trains them in n processes
"""

from __future__ import annotations

import collections
import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import NamedTuple

from offbench.common.errors import OffbenchError
from offbench.common.interrupts import announce_stop
from offbench.common.processes import start_worker, uninterrupted_start
from offbench.common.progress import Progress
from offbench.common.text import printable
from offbench.training.claim import check_algorithm_code, check_environment_code
from offbench.training.datasets import load_datasets
from offbench.training.devices import matmul_settings
from offbench.training.failures import describe_failure
from offbench.training.spec import Job
from offbench.training.trainer import STOPPED, OnProgress, Trainer


def train_job(job: Job, on_progress: OnProgress) -> list[str]:
    """Train a job in this process.

    Returns:
        A line for each run that diverged.

    Raises:
        OffbenchError: anything that the user can fix.
    """
    check_environment_code(job)
    with matmul_settings(job.device, job.first.precision):
        return Trainer(job, load_datasets(job.specs)).train(on_progress)


def run_jobs(jobs: Sequence[Job], processes: int) -> list[str]:
    """Train jobs, up to `processes` at a time; a job that fails does not stop the others.

    A single job on a CPU uses the other processes for its evaluations.

    Returns:
        What went wrong, a line each.
    """
    if len(jobs) == 1 and jobs[0].device == "cpu":
        jobs = [replace(jobs[0], workers=processes - 1)]
    with JobProgress(jobs) as progress:
        if processes == 1 or len(jobs) == 1:
            return [line for i, job in enumerate(jobs) for line in _train_here(job, i, progress)]
        with _Pool(progress) as pool:
            return list(_train_in_processes(jobs, processes, pool))


def raise_first(problems: Sequence[str]) -> None:
    """Raise OffbenchError for the first of several problems, with the number of the others; do nothing for none."""
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise OffbenchError(problems[0] + more)


def _titles(jobs: Sequence[Job]) -> list[str]:
    """Return a title for each job: settings and seed of its first run are added where they tell jobs apart."""
    variants: dict[str, list[str]] = {}
    for job in jobs:
        variants.setdefault(job.title, []).append(job.first.variant)
    titles = []
    for job in jobs:
        alike = variants[job.title]
        variant = f", {job.first.variant}" if len(set(alike)) > 1 else ""
        titles.append(job.title + (f"{variant}, seed {job.first.seed}" if len(alike) > 1 else ""))
    return titles


class JobProgress(Progress):
    """One progress bar for several jobs."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs, self.steps, self.notes = jobs, dict[int, int](), dict[int, str]()
        self.titles, self.traces = _titles(jobs), {""}
        runs = sum(len(job.specs) for job in jobs)
        title = jobs[0].title if len(jobs) == 1 else f"{runs} runs"
        super().__init__(sum(job.updates for job in jobs), title, work=sum(job.work for job in jobs))

    def report(self, index: int, step: int, note: str) -> None:
        """Show that a job is at `step`, and say where it resumed and where it was stopped.

        It must get every report of a job: the first one says where it resumed, the last one whether it was stopped.
        """
        if index not in self.steps and step:
            self.print_line(f"{self.titles[index]}: resuming from step {step:,}")
        self.update(index, step, note)
        if note == STOPPED:
            self.print_line(f"{self.titles[index]}: stopped at step {step:,}, checkpoint saved")

    def update(self, index: int, step: int, note: str) -> None:
        """Show that a job is at `step`."""
        if index not in self.steps:  # steps of an earlier session count as done, not as speed
            done = step * len(self.jobs[index].specs)
            self.skip(done, done * self.jobs[index].cost)
        self.steps[index] = step
        news = "" if note == self.notes.get(index) else note
        self.notes[index] = note
        if news and len(self.jobs) > 1:
            news = f"{self.titles[index]}: {news}"
        done_of = {i: step * len(self.jobs[i].specs) for i, step in self.steps.items()}
        work = sum(done * self.jobs[i].cost for i, done in done_of.items())
        self.to(sum(done_of.values()), news, work)

    def print_trace(self, trace: str) -> None:
        """Print a traceback, once if several jobs fail at the same line."""
        if trace not in self.traces:
            self.print_line(printable(trace.rstrip()))
            self.traces.add(trace)


def _train_here(job: Job, index: int, progress: JobProgress) -> list[str]:
    if job.deadline_passed:
        return []
    try:
        return train_job(job, lambda step, note: progress.report(index, step, note))
    except (Exception, SystemExit) as error:  # an algorithm of the user's own may call sys.exit
        if len(progress.jobs) == 1 and isinstance(error, Exception):
            raise
        return [_problem(job, error, progress.print_trace)]


def _problem(job: Job, error: BaseException, write_traceback: Callable[[str], object]) -> str:
    """Return a line that describes the failure of one of several jobs."""
    return (
        str(error) if isinstance(error, OffbenchError) else f"{job.title}: {describe_failure(error, write_traceback)}"
    )


class _End(NamedTuple):
    """The last message of a training process; those before it are its (step, note)."""

    problems: list[str]
    trace: str = ""


class _Pool(contextlib.AbstractContextManager["_Pool"]):
    """The training processes; leaving the context ends them, each with a checkpoint."""

    def __init__(self, progress: JobProgress) -> None:
        self.progress = progress
        self.active: dict[Connection, tuple[int, multiprocessing.process.BaseProcess]] = {}  # job's index, process

    def start(self, index: int, job: Job) -> None:
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_worker, args=(job, sender, os.getpid()), daemon=False)
        with uninterrupted_start():
            process.start()
        sender.close()
        self.active[receiver] = (index, process)

    def end(self, receiver: Connection) -> None:
        _, process = self.active.pop(receiver)
        receiver.close()
        process.join()

    def __exit__(self, exception_type: type[BaseException] | None, *_error: object) -> None:
        processes = [process for _, process in self.active.values()]
        for process in processes:
            process.terminate()
        if exception_type is KeyboardInterrupt:
            announce_stop()
        try:
            for receiver, (index, _) in list(self.active.items()):
                with contextlib.suppress(EOFError, OSError):  # the process has ended
                    while not isinstance(message := receiver.recv(), _End):
                        self.progress.report(index, *message)
                self.end(receiver)
        except KeyboardInterrupt:
            for process in processes:
                process.kill()
            raise


def _train_in_processes(jobs: Sequence[Job], processes: int, pool: _Pool) -> Iterator[str]:
    waiting = collections.deque(enumerate(jobs))
    while waiting or pool.active:
        while waiting and len(pool.active) < processes:
            index, job = waiting.popleft()
            if not job.deadline_passed:
                pool.start(index, job)
        # if all remaining jobs are over, there is no process to wait for
        for receiver in wait(list(pool.active)) if pool.active else ():
            assert isinstance(receiver, Connection)
            index = pool.active[receiver][0]
            try:
                message = receiver.recv()
            except EOFError:
                message = _End([f"a training process died (killed, or out of memory): {jobs[index].title}"])
            if not isinstance(message, _End):
                pool.progress.report(index, *message)
                continue
            pool.progress.print_trace(message.trace)
            yield from message.problems
            pool.end(receiver)


def _worker(job: Job, sender: Connection, parent: int) -> None:
    """Train in a process: send (step, note) at each progress, then an _End."""
    start_worker(parent)
    traces: list[str] = []
    try:
        check_algorithm_code(job)
        lines = train_job(job, lambda step, note: sender.send((step, note)))
    except (Exception, SystemExit) as error:
        lines = [_problem(job, error, traces.append)]
    sender.send(_End(lines, "".join(traces)))
