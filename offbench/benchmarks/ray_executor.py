"""A Ray cluster as the executor of a benchmark: `offbench benchmark GRID --executor ray`.

    driver (head)   plans, submits jobs and recordings as tasks, holds the run folders
    task            trains one job for at most a slice of time and returns; the driver submits what is left of it again
    FileServer      an actor on the driver's node: reads and writes files there for nodes that do not share its disk

A node that can read the driver's token on its own disk works in the driver's folders, as the driver itself would. Any
other node downloads the datasets and checkpoints from the file server, trains in a folder of its own and uploads the
run folders. If a node is lost, Ray runs its tasks again from what it has uploaded; a run's bits do not depend on where
it resumes.

Ray would put the driver's current folder on the nodes' import path, where a file named like a standard module replaces
that module. With an empty folder as Ray's `working_dir` it does not.

An algorithm of the user's own is sent with each task as the code that the driver imported, so that all nodes run that
code, whatever files they have. Packages must be installed on each node.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.benchmarks.datasets import record_dataset
from offbench.benchmarks.grid import GridDataset
from offbench.common.errors import LockedError, OffbenchError
from offbench.common.files import write_bytes
from offbench.common.processes import MAX_WORKERS, cores, environment
from offbench.data import minari_store
from offbench.training.claim import by_common_step, check_algorithm_code
from offbench.training.jobs import JobProgress, raise_first, train_job
from offbench.training.registry import register, user_algorithm
from offbench.training.source_code import own_modules
from offbench.training.spec import Job, RunSpec

if TYPE_CHECKING:
    from ray import ObjectRef
    from ray.actor import ActorHandle

SLICE = 600.0  # seconds that a task trains before it returns
RETRIES = 5  # times that Ray runs a lost task again
TIMEOUT = 5.0  # seconds to wait for a cluster
POLL = 1.0  # seconds between two checks of the tasks
LOCKED_TIMEOUT = 30.0  # seconds that a task tries again while another process holds a run or a dataset
LEFT_OUT = (".lock", ".holder", ".tmp")  # endings of files that belong to one process

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
        self.ray = ray
        self.slice = slice_seconds
        if not ray.is_initialized():
            try:
                _check_address(address)
                with tempfile.TemporaryDirectory() as empty:  # ray.init uploads it
                    ray.init(
                        address=address,
                        runtime_env={"working_dir": empty},
                        log_to_driver=False,
                        logging_level="WARNING",
                        include_dashboard=False,
                    )
            except (OSError, RuntimeError, ValueError, SystemExit) as error:
                raise OffbenchError(
                    f"no Ray cluster at {address}: {error}; start one with `ray start --head`"
                ) from None
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        this_node = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self.server = ray.remote(num_cpus=0, scheduling_strategy=this_node)(FileServer).remote()
        self._options = {"max_retries": RETRIES, "num_cpus": 1}

    @property
    def cpus(self) -> int:
        """The cluster's processors, at most as many as there may be workers."""
        return min(int(self.ray.cluster_resources().get("CPU", 1)), MAX_WORKERS)

    def record(self, datasets: Sequence[GridDataset], workers: int, deadline: float | None = None) -> None:
        """Record datasets, a task each, none after the deadline. Raises OffbenchError for the first that failed."""
        task = self.ray.remote(**self._options)(_record)
        with _driver(minari_store.root()) as driver:
            results = self.ray.get([task.remote(dataset, driver, self.server, deadline) for dataset in datasets])
        raise_first([line for _, lines in results for line in lines])

    def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
        """Train jobs, slice by slice, wherever a processor is free; return what went wrong, a line each."""
        jobs = [replace(job, specs=tuple(replace(s, folder=s.folder.resolve()) for s in job.specs)) for job in jobs]
        common = Path(os.path.commonpath([spec.folder.parent for job in jobs for spec in job.specs]))
        for name in {job.first.algorithm for job in jobs}:
            self._send_code(name)
        waiting, active, problems = list(range(len(jobs))), dict["ObjectRef", int](), list[str]()
        self.ray.get(self.server.clear.remote())
        with JobProgress(jobs) as progress, _driver(common) as driver:
            while waiting or active:
                for index in waiting:
                    if not jobs[index].deadline_passed:
                        active[self._start(jobs[index], index, driver)] = index
                waiting = []
                for ref in self.ray.wait(list(active), num_returns=1, timeout=POLL)[0] if active else ():
                    index = active.pop(ref)
                    succeeded, lines = self._result(ref, jobs[index])
                    problems += lines
                    if succeeded and unfinished(jobs[index]):
                        waiting.append(index)
                for index, (step, note) in self.ray.get(self.server.reports.remote()).items():
                    progress.update(index, step, note)
        return problems

    def _send_code(self, algorithm: str) -> None:
        """Let Ray pickle the modules of a user's own algorithm by value, as other nodes cannot import them."""
        from ray import cloudpickle

        for module in own_modules(algorithm):
            cloudpickle.register_pickle_by_value(module)
        try:
            cloudpickle.dumps(user_algorithm(algorithm))
        except Exception as error:  # whatever its globals raise
            raise OffbenchError(
                f"the code of {algorithm} cannot be sent to the nodes ({error}); install it as a package on each"
            ) from error

    def _start(self, job: Job, index: int, driver: Driver) -> ObjectRef:
        gpu = {"num_gpus": 1} if job.device != "cpu" else {}
        task = self.ray.remote(**self._options, **gpu)(_train)
        rest = replace(job, specs=unfinished(job))
        own = user_algorithm(job.first.algorithm)
        return task.remote(rest, own, self.slice, index, driver, self.server)

    def _result(self, ref: ObjectRef, job: Job) -> tuple[bool, list[str]]:
        try:
            result: tuple[bool, list[str]] = self.ray.get(ref)
            return result
        except self.ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[-1]
            return False, [f"{job.title}: its node was lost {RETRIES} times, or its process died: {reason}"]


def _check_address(address: str | None) -> None:
    """Raise OSError if nothing listens at an address: Ray itself would try for minutes, then end the process."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=TIMEOUT).close()


def unfinished(job: Job) -> tuple[RunSpec, ...]:
    """Return the runs of a job that have neither reached their last step nor diverged."""
    return tuple(spec for spec in job.specs if not (spec.run.diverged or spec.run.finished(spec.steps)))


class FileServer:
    """The driver's files, for nodes that do not share its disk, and the tasks' progress."""

    def __init__(self) -> None:
        self.latest: dict[int, tuple[int, str]] = {}

    def read(self, folder: str) -> Files:
        """Return all files of a folder."""
        return read_folder(Path(folder))

    def write(self, folder: str, files: Files) -> None:
        """Make a run folder hold these files; each is written whole."""
        write_folder(Path(folder), files)

    def replace(self, folder: str, files: Files) -> None:
        """Write a dataset's folder, whole or not at all."""
        target = Path(folder)
        temporary = target.with_name(f".offbench-{target.name}.upload")
        shutil.rmtree(temporary, ignore_errors=True)
        write_folder(temporary, files)
        if not target.exists():
            temporary.replace(target)

    def clear(self) -> None:
        """Forget the progress of an earlier call."""
        self.latest.clear()

    def report(self, index: int, step: int, note: str) -> None:
        """Keep the latest step and note of a job."""
        self.latest[index] = (step, note)

    def reports(self) -> dict[int, tuple[int, str]]:
        """Return the latest step and note of every job."""
        return dict(self.latest)


def read_folder(folder: Path) -> Files:
    """Return the files below a folder by their relative paths; locks and unfinished files are left out."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(LEFT_OUT)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def write_folder(folder: Path, files: Files) -> None:
    """Make a folder hold these files. A run's checkpoints are written last, as its training does."""
    for name in sorted(files, key=lambda name: name.startswith("checkpoint-")):
        write_bytes(folder / name, files[name])
    for name in set(read_folder(folder)) - set(files):
        (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True)
class Driver:
    """The driver's folders.

    Attributes:
        folder: the current folder, at which relative paths start.
        datasets: Minari's folder.
        token: a file in a folder that tasks write to, by which a node finds out whether it shares the disk.
        content: what the token holds.
    """

    folder: Path
    datasets: Path
    token: Path
    content: str

    def shares_disk(self) -> bool:
        """Return whether this node can work in the driver's folders."""
        try:
            return self.folder.is_dir() and self.token.read_text() == self.content
        except OSError:
            return False

    @contextlib.contextmanager
    def folders(self) -> Iterator[None]:
        """Work in the driver's folders within this context."""
        with contextlib.chdir(self.folder), environment({"MINARI_DATASETS_PATH": str(self.datasets)}):
            yield


@contextlib.contextmanager
def _driver(folder: Path) -> Iterator[Driver]:
    """Yield the driver of this process, with a token in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    token = folder.resolve() / f".offbench-token-{os.getpid()}"
    driver = Driver(Path.cwd(), minari_store.root().resolve(), token, os.urandom(16).hex())
    write_bytes(token, driver.content.encode())
    try:
        yield driver
    finally:
        token.unlink(missing_ok=True)


@contextlib.contextmanager
def _own_folder() -> Iterator[Path]:
    """Yield a temporary folder for this task, which also holds Minari's datasets and the cache."""
    with (
        tempfile.TemporaryDirectory(prefix="offbench-") as name,
        environment({"MINARI_DATASETS_PATH": f"{name}/minari", "OFFBENCH_CACHE": f"{name}/cache"}),
    ):
        yield Path(name)


def _train(
    job: Job, own: type | None, seconds: float, index: int, driver: Driver, server: ActorHandle
) -> tuple[bool, list[str]]:
    """A task: train a job for a slice of time, which begins now, however long the task has waited.

    Args:
        own: the algorithm's class, if no installed package has it.
    """
    if own is not None:
        register(own)
    slice_end = time.time() + seconds
    deadline = slice_end if job.deadline is None else min(job.deadline, slice_end)
    job = replace(job, deadline=deadline, workers=min(job.workers, cores()))  # the driver counts the cluster's cores

    def report(step: int, note: str) -> None:
        server.report.remote(index, step, note)

    def train(local: Job) -> list[str]:
        if own is None:  # else it is the code that the driver sent
            check_algorithm_code(local)
        return _train_groups(local, report)

    return _task(lambda: _train_here(job, driver, server, train), job.title)


def _train_here(job: Job, driver: Driver, server: ActorHandle, train: Callable[[Job], list[str]]) -> list[str]:
    """Train a job in the driver's folders where this node shares them, else in a folder of this task's own."""
    import ray

    if driver.shares_disk():
        with driver.folders():
            return train(job)
    with _own_folder() as folder:
        for name in {spec.dataset for spec in job.specs}:
            write_folder(minari_store.path_of(name), ray.get(server.read.remote(str(driver.datasets / name))))
        own = tuple(replace(spec, folder=folder / str(i)) for i, spec in enumerate(job.specs))
        for spec, local in zip(job.specs, own, strict=True):
            write_folder(local.folder, ray.get(server.read.remote(str(spec.folder))))
        lines = train(replace(job, specs=own))
        for spec, local in zip(job.specs, own, strict=True):
            ray.get(server.write.remote(str(spec.folder), read_folder(local.folder)))
        return lines


def _train_groups(job: Job, report: Callable[[int, str], None]) -> list[str]:
    """Train the runs of a job that can resume together, group after group: a lost node may have written only some."""
    groups = by_common_step(job.specs)
    return [line for group in groups for line in train_job(replace(job, specs=tuple(group)), report)]


def _record(
    source: GridDataset, driver: Driver, server: ActorHandle, deadline: float | None
) -> tuple[bool, list[str]]:
    """A task: record a dataset, unless it has waited until after the deadline."""
    if deadline is not None and time.time() > deadline:
        return True, []
    return _task(lambda: _record_here(source, driver, server), source.id)


def _record_here(source: GridDataset, driver: Driver, server: ActorHandle) -> list[str]:
    import ray

    if driver.shares_disk():
        with driver.folders():
            record_dataset(source, workers=1)
        return []
    with _own_folder():
        record_dataset(source, workers=1)
        files = read_folder(minari_store.path_of(source.id))
        ray.get(server.replace.remote(str(driver.datasets / source.id), files))
    return []


def _task(work: Callable[[], list[str]], title: str) -> tuple[bool, list[str]]:
    """Do the work of a task; return whether it succeeded, and what went wrong."""
    began = time.monotonic()
    while True:
        try:
            return True, work()
        except LockedError as error:  # perhaps by a process of a lost node, which ends soon
            if time.monotonic() - began > LOCKED_TIMEOUT:
                return False, [f"{title}: {error}"]
        except OffbenchError as error:
            return False, [f"{title}: {error}"]
        except (Exception, SystemExit):  # of offbench or of a user's algorithm: the driver shows all of it
            return False, [f"{title}: {traceback.format_exc()}"]
