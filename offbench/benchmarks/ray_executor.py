"""A Ray cluster as the executor of a benchmark: `offbench benchmark GRID --executor ray`.

    driver (head)   plans, deals out stacks and recordings as tasks, holds the run directories
    task            trains one stack for at most a slice of time, then hands it back; the driver deals it out again
    Shelf           an actor beside the driver: reads and writes files there for nodes that do not share its disk

A node whose disk holds the driver's token works in place. Any other fetches datasets and checkpoints from the shelf,
trains in a folder of its own and puts the run directories back. A lost node costs what it had not handed back: Ray
runs its tasks again, and a run's bits do not depend on where it goes on.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from offbench.benchmarks.datasets import record_source
from offbench.benchmarks.grid import Source
from offbench.common.errors import OffbenchError
from offbench.common.files import write_bytes
from offbench.data import minari_store
from offbench.training.grouping import finished
from offbench.training.jobs import Board, Job, Order, is_over, perform
from offbench.training.run import Run

SLICE = 600.0  # seconds that a task trains before it hands back
RETRIES = 5  # times that Ray runs a lost task again
REACH = 5.0  # seconds to wait for a cluster
LOOK = 1.0  # seconds between two looks at the tasks
LEFT_OUT = (".lock", ".holder", ".tmp")  # endings of files that mean something to one process alone

Files = dict[str, bytes]


class RayExecutor:
    """Trains and records on a Ray cluster.

    Args:
        address: the cluster's, e.g. "auto" or "ray://head:10001"; None starts one on this machine.

    Raises:
        OffbenchError: Ray is not installed, or the cluster does not answer.
    """

    def __init__(self, address: str | None = None, slice_seconds: float = SLICE) -> None:
        try:
            import ray
        except ImportError:
            raise OffbenchError("Ray is not installed; run `pip install offbench[ray]`") from None
        self.ray: Any = ray
        self.slice = slice_seconds
        if not ray.is_initialized():
            try:
                _reach(address)
                ray.init(address=address, log_to_driver=False, include_dashboard=False)
            except (OSError, RuntimeError, ValueError, SystemExit) as error:
                raise OffbenchError(
                    f"no Ray cluster at {address}: {error}; start one with `ray start --head`"
                ) from None
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self.shelf = ray.remote(num_cpus=0, scheduling_strategy=here)(Shelf).remote()
        self._retried = {"max_retries": RETRIES, "num_cpus": 1}

    @property
    def cpus(self) -> int:
        """The cluster's processors."""
        return int(self.ray.cluster_resources().get("CPU", 1))

    def record(self, sources: Sequence[Source], workers: int) -> None:
        """Record datasets, a task each. Raises OffbenchError for the first that failed."""
        task = self.ray.remote(**self._retried)(_record)
        with _token(minari_store.root()) as token:
            found = self.ray.get([task.remote(s, str(minari_store.root()), token, self.shelf) for s in sources])
        for _, lines in found:
            for line in lines:
                raise OffbenchError(line)

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs, slice by slice, wherever there is room; return what went wrong, a line each."""
        jobs = [replace(job, orders=tuple(_absolute(order) for order in job.orders)) for job in jobs]
        where = Path(os.path.commonpath([order.folder for job in jobs for order in job.orders]))
        waiting, active, problems = list(range(len(jobs))), dict[Any, int](), list[str]()
        with Board(jobs) as board, _token(where) as token:
            while waiting or active:
                for place in waiting:
                    if not is_over(jobs[place]):
                        active[self._start(jobs[place], place, token)] = place
                waiting = []
                for ref in self.ray.wait(list(active), num_returns=1, timeout=LOOK)[0] if active else ():
                    place = active.pop(ref)
                    well, lines = self._result(ref, jobs[place])
                    problems += lines
                    if well and left(jobs[place]):
                        waiting.append(place)
                for place, (step, note) in self.ray.get(self.shelf.reports.remote()).items():
                    board.at(place, step, note)
        return problems

    def _start(self, job: Job, place: int, token: str) -> Any:
        gpu = {"num_gpus": 1} if job.schedule.device != "cpu" else {}
        task = self.ray.remote(**self._retried, **gpu)(_train)
        rest = replace(job, orders=left(job))
        return task.remote(rest, self.slice, place, str(minari_store.root().resolve()), token, self.shelf)

    def _result(self, ref: Any, job: Job) -> tuple[bool, list[str]]:
        try:
            found: tuple[bool, list[str]] = self.ray.get(ref)
            return found
        except self.ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[-1]
            return False, [f"{job.title}: its node was lost {RETRIES} times, or its process died: {reason}"]


def _reach(address: str | None) -> None:
    """Raise OSError if nothing listens at an address: Ray itself would try for minutes, then end the process."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=REACH).close()


def _absolute(order: Order) -> Order:
    return replace(order, folder=str(Path(order.folder).resolve()))


def left(job: Job) -> tuple[Order, ...]:
    """Return the runs of a job that have neither come to their last step nor diverged."""

    def over(order: Order) -> bool:
        run = Run(Path(order.folder))
        return run.diverged or finished(run, job.schedule.steps)

    return tuple(order for order in job.orders if not over(order))


class Shelf:
    """The driver's files, for nodes that do not share its disk; and what the tasks report."""

    def __init__(self) -> None:
        self.at: dict[int, tuple[int, str]] = {}

    def read(self, folder: str) -> Files:
        """Return all files of a folder."""
        return read_folder(Path(folder))

    def write(self, folder: str, files: Files) -> None:
        """Bring a folder of runs up to date: newer files in, deleted ones out; each file whole."""
        write_folder(Path(folder), files)

    def replace(self, folder: str, files: Files) -> None:
        """Put a dataset's folder in its place, whole."""
        target = Path(folder)
        aside = target.with_name(f".offbench-{target.name}.shelf")
        shutil.rmtree(aside, ignore_errors=True)
        write_folder(aside, files)
        if not target.exists():
            aside.replace(target)

    def report(self, place: int, step: int, note: str) -> None:
        """Take in how far a job is."""
        self.at[place] = (step, note)

    def reports(self) -> dict[int, tuple[int, str]]:
        """Return how far every job is."""
        return dict(self.at)


def read_folder(folder: Path) -> Files:
    """Return the files below a folder by their relative paths; locks and unfinished files are left out."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(LEFT_OUT)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def write_folder(folder: Path, files: Files) -> None:
    """Make a folder hold these files. Checkpoints are written first and old ones deleted last."""
    for name in sorted(files, key=lambda name: not name.startswith("checkpoint-")):
        write_bytes(folder / name, files[name])
    for name in set(read_folder(folder)) - set(files):
        (folder / name).unlink(missing_ok=True)


@contextmanager
def _token(folder: Path) -> Iterator[str]:
    """Write a file whose content tells a node whether it sees the driver's disk."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f".offbench-token-{os.getpid()}"
    content = os.urandom(16).hex()
    write_bytes(path, content.encode())
    try:
        yield f"{path.resolve()}\n{content}"
    finally:
        path.unlink(missing_ok=True)


def _shared(token: str) -> bool:
    path, content = token.split("\n")
    try:
        return Path(path).read_text() == content
    except OSError:
        return False


@contextmanager
def _elsewhere() -> Iterator[Path]:
    """A folder of this task alone, with Minari's datasets and our cache in it."""
    with tempfile.TemporaryDirectory(prefix="offbench-") as name:
        old = {key: os.environ.get(key) for key in ("MINARI_DATASETS_PATH", "OFFBENCH_CACHE")}
        os.environ |= {"MINARI_DATASETS_PATH": f"{name}/minari", "OFFBENCH_CACHE": f"{name}/cache"}
        try:
            yield Path(name)
        finally:
            _restore(old)


def _restore(environment: dict[str, str | None]) -> None:
    for key, value in environment.items():
        if value is None:
            os.environ.pop(key, None)
        else:
            os.environ[key] = value


def _train(job: Job, seconds: float, place: int, datasets: str, token: str, shelf: Any) -> tuple[bool, list[str]]:
    """A task: train a stack until its slice ends, which begins here: however long it has waited, it goes on."""
    ends = [end for end in (job.schedule.deadline, time.time() + seconds) if end is not None]
    job = replace(job, schedule=replace(job.schedule, deadline=min(ends)))

    def report(step: int, note: str) -> None:
        shelf.report.remote(place, step, note)

    return _task(lambda: _train_there(job, datasets, token, shelf, report), job.title)


def _train_there(job: Job, datasets: str, token: str, shelf: Any, report: Callable[[int, str], None]) -> list[str]:
    import ray

    if _shared(token):
        os.environ["MINARI_DATASETS_PATH"] = datasets
        return perform(job, report)
    with _elsewhere() as here:
        for name in {order.dataset for order in job.orders}:
            write_folder(minari_store.path_of(name), ray.get(shelf.read.remote(f"{datasets}/{name}")))
        own = tuple(replace(order, folder=str(here / str(i))) for i, order in enumerate(job.orders))
        for order, local in zip(job.orders, own, strict=True):
            write_folder(Path(local.folder), ray.get(shelf.read.remote(order.folder)))
        lines = perform(replace(job, orders=own), report)
        for order, local in zip(job.orders, own, strict=True):
            ray.get(shelf.write.remote(order.folder, read_folder(Path(local.folder))))
        return lines


def _record(source: Source, datasets: str, token: str, shelf: Any) -> tuple[bool, list[str]]:
    """A task: record a dataset."""
    return _task(lambda: _record_there(source, datasets, token, shelf), source.id)


def _record_there(source: Source, datasets: str, token: str, shelf: Any) -> list[str]:
    import ray

    if _shared(token):
        os.environ["MINARI_DATASETS_PATH"] = datasets
        record_source(source, workers=1)
        return []
    with _elsewhere():
        record_source(source, workers=1)
        ray.get(shelf.replace.remote(f"{datasets}/{source.id}", read_folder(minari_store.path_of(source.id))))
    return []


def _task(work: Callable[[], list[str]], title: str) -> tuple[bool, list[str]]:
    """Return whether the work can go on, and what went wrong."""
    try:
        return True, work()
    except OffbenchError as error:
        return False, [f"{title}: {error}"]
    except Exception:  # a fault of ours or of a third party's algorithm: the driver shows it whole
        return False, [f"{title}: {traceback.format_exc()}"]
