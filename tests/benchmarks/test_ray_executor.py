"""A benchmark on a real Ray cluster of two nodes: the same results as on this machine, whatever dies."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from offbench.algorithm import Logs
from offbench.benchmarks import ray_executor
from offbench.benchmarks.benchmark import benchmark
from offbench.benchmarks.grid import GridDataset, load_grid
from offbench.benchmarks.plan import prepare
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.training.devices import Machine
from offbench.training.jobs import train_job
from offbench.training.registry import load_algorithm
from offbench.training.run import Run, find_runs
from offbench.training.spec import Job, RunSpec
from offbench.training.train import Training
from tests.conftest import TINY_RECIPE

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own

GRID = """
seeds = 2
eval_every = 500
eval_episodes = 2
datasets = [{id = "mine-v0", env = "inverted-pendulum", level = "medium", steps = 1_000}]

[[algorithms]]
name = "bdb"
steps = 3_000
hidden = [32, 32]
"""


@pytest.fixture
def two_nodes(home: Path) -> Iterator[Any]:
    """A head without processors and two nodes with one each; yields (cluster, nodes)."""
    import ray
    from ray.cluster_utils import Cluster

    (home / "grid.toml").write_text(GRID)
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        workers = [nodes.add_node(num_cpus=1) for _ in range(2)]
        yield nodes, workers
    finally:
        ray.shutdown()
        nodes.shutdown()


def run(where: str, executor: Any) -> bool:
    bench = prepare("./grid.toml", runs=where, workers=2, stack=1, device="cpu")
    return benchmark(bench, executor=executor, say=lambda line: None)


def same(home: Path, ours: str, theirs: str) -> None:
    runs = find_runs(home / ours)
    assert len(runs) == 2
    for one in runs:
        other = Run(home / theirs / one.folder.relative_to(home / ours))
        assert one.evaluations_path.read_bytes() == other.evaluations_path.read_bytes()
        assert one.policy_path.read_bytes() == other.policy_path.read_bytes()
        newest = "checkpoint-000003000.safetensors"
        assert (one.folder / newest).read_bytes() == (other.folder / newest).read_bytes()


def test_a_lost_node_changes_nothing(two_nodes: Any, home: Path) -> None:
    """Slices of two seconds; a node is killed while both are at work, and another one joins."""
    nodes, workers = two_nodes
    assert run("local", None)
    executor = ray_executor.RayExecutor(nodes.address, slice_seconds=2)
    assert executor.cpus == 2
    with ThreadPoolExecutor(1) as beside:  # Ray starts and ends its nodes in the main thread alone
        over = beside.submit(run, "ray", executor)
        while not any((home / "ray").rglob("checkpoint-*")) and not over.done():
            time.sleep(0.1)
        assert not over.done()
        nodes.remove_node(workers[0], allow_graceful=False)
        nodes.add_node(num_cpus=1, wait=False)
        assert over.result()
    nodes.wait_for_nodes(60)  # the one that joined among them
    assert len(nodes.list_all_nodes()) == 3
    same(home, "local", "ray")


def test_a_task_waits_for_the_processes_of_a_lost_node(home: Path, medium: str) -> None:
    """They end some seconds after Ray has started their tasks again elsewhere."""
    config: Any = load_algorithm("td3_bc").Config(hidden=(16, 16))
    spec = RunSpec("td3_bc", config, medium, 0, 100, 100, 1, home / "runs" / medium / "td3_bc/default/seed-0")
    (job,) = Training([spec], Machine("cpu", 1)).jobs
    script = "import sys, time; from offbench.training.run import Run; from pathlib import Path\n"
    script += "with Run(Path(sys.argv[1])).locked(): print('locked', flush=True); time.sleep(5)"
    words = [sys.executable, "-c", script, str(spec.folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as lost:
        assert lost.stdout
        assert lost.stdout.readline() == "locked\n"
        began = time.monotonic()
        assert ray_executor._task(lambda: train_job(job, lambda *_: None), job.title) == (True, [])
    assert time.monotonic() - began > 3
    assert spec.run.finished(100)


def test_a_slice_begins_when_its_task_does(home: Path, medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task dealt out a minute ago, with slices of half a minute, trains to its end all the same."""
    fake = SimpleNamespace(remote=lambda **_: lambda task: SimpleNamespace(remote=lambda *words: (task, words)))
    executor = object.__new__(ray_executor.RayExecutor)
    executor.ray, executor.slice, executor._options = fake, 30.0, {}
    executor.server = SimpleNamespace(report=SimpleNamespace(remote=lambda *_: None))
    config: Any = load_algorithm("td3_bc").Config(hidden=(16, 16))
    spec = RunSpec("td3_bc", config, medium, 0, 1_000, 1_000, 1, home / "runs" / medium / "td3_bc/default/seed-0")
    (job,) = Training([spec], Machine("cpu", 1)).jobs
    with ray_executor._driver(home) as driver:
        with monkeypatch.context() as patched:
            patched.setattr(ray_executor, "time", SimpleNamespace(time=lambda: time.time() - 60))
            task, words = executor._start(job, 0, driver)
        assert task(*words) == (True, [])
    assert not ray_executor.unfinished(job)


def test_runs_that_a_lost_node_left_far_apart_resume_on_their_own(home: Path, medium: str) -> None:
    """It brought back the first run of a stack, but not the second."""
    config: Any = load_algorithm("td3_bc").Config(hidden=(16, 16))

    def specs(root: str, steps: int) -> tuple[RunSpec, ...]:
        folders = [home / root / medium / "td3_bc" / "default" / f"seed-{seed}" for seed in range(2)]
        return tuple(RunSpec("td3_bc", config, medium, i, steps, 100, 1, folder) for i, folder in enumerate(folders))

    for chosen in (specs("whole", 600), specs("apart", 100), specs("apart", 400)[:1]):
        (started,) = Training(list(chosen), Machine("cpu", 1)).jobs
        train_job(started, lambda *_: None)
    job = Job(specs("apart", 600), "cpu")
    begun: list[int] = []

    def train(local: Job) -> list[str]:
        return ray_executor._train_groups(local, lambda step, _: begun.append(step))

    with ray_executor._driver(home) as driver:
        assert ray_executor._train_here(job, driver, SimpleNamespace(), train) == []
    assert begun[0] == 400
    assert 100 in begun
    assert 0 not in begun
    for one, other in zip(specs("whole", 600), specs("apart", 600), strict=True):
        assert one.run.evaluations_path.read_bytes() == other.run.evaluations_path.read_bytes()
        assert one.run.policy_path.read_bytes() == other.run.policy_path.read_bytes()


def test_nodes_that_share_no_disk_fetch_and_bring_back(
    two_nodes: Any, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The token's content is not what the nodes find: as on a node with another disk at the same path."""
    nodes, _ = two_nodes
    assert run("local", None)
    shutil.rmtree(home / "minari")  # to be recorded on a node as well

    driver_of = ray_executor._driver

    @contextmanager
    def foreign(folder: Path) -> Iterator[ray_executor.Driver]:
        with driver_of(folder) as driver:
            yield replace(driver, content="another")

    monkeypatch.setattr(ray_executor, "_driver", foreign)
    assert run("ray", ray_executor.RayExecutor(nodes.address, slice_seconds=2))
    same(home, "local", "ray")


ALGO = """
import losses
from parts.half import HALF
from offbench.algos.bc import BC

class Mine(BC):
    def update(self, batch, noise, phase):
        return losses.checked(super().update(batch, noise, phase), HALF)
"""
LOSSES = """
def checked(logs, half):
    return {name: half * value for name, value in logs.items()}
"""


def test_an_algorithm_of_ones_own_is_sent_to_the_nodes(
    two_nodes: Any, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the files beside it; all files are gone before the tasks start, so that no node can read them."""
    nodes, _ = two_nodes
    (home / "grid.toml").write_text(GRID.replace("bdb", "./mine/algo.py:Mine"))
    (home / "mine" / "parts").mkdir(parents=True)
    (home / "mine" / "parts" / "half.py").write_text("HALF = 0.5\n")
    (home / "mine" / "algo.py").write_text(ALGO)
    (home / "mine" / "losses.py").write_text(LOSSES)
    assert run("local", None)
    executor = ray_executor.RayExecutor(nodes.address, slice_seconds=2)
    send = executor._send_code

    def and_hide(name: str) -> None:
        send(name)
        (home / "mine").rename(home / "elsewhere")

    with monkeypatch.context() as patched:
        patched.setattr(executor, "_send_code", and_hide)
        assert run("ray", executor)
    same(home, "local", "ray")
    shutil.rmtree(home / "ray")
    (home / "elsewhere").rename(home / "mine")
    here = os.getpid()

    def fails(logs: Logs, half: float) -> Logs:
        return logs if os.getpid() == here else 1 / 0  # type: ignore[return-value]

    monkeypatch.setattr(sys.modules["losses"], "checked", fails)
    with pytest.raises(OffbenchError, match=r'(?s)algo.py", line 8, in update.*ZeroDivisionError'):
        run("ray", ray_executor.RayExecutor(nodes.address))


def test_the_command_line_trains_on_a_cluster(
    two_nodes: Any, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a worker for each of the cluster's processors, and the bits of this machine."""
    nodes, _ = two_nodes
    assert run("local", None)
    asked: list[int] = []
    train = ray_executor.RayExecutor.train

    def noted(self: ray_executor.RayExecutor, jobs: Any, processes: int) -> list[str]:
        asked.append(processes)
        return train(self, jobs, processes)

    monkeypatch.setattr(ray_executor.RayExecutor, "train", noted)
    words = ["--address", nodes.address, "--runs", "ray", "--stack", "1", "--device", "cpu"]
    main(["benchmark", "./grid.toml", "--executor", "ray", *words])
    assert asked == [2]
    same(home, "local", "ray")
    assert "next: offbench report --runs ray" in capsys.readouterr().err


def test_tasks_read_files_of_the_drivers_folder_but_import_none(
    two_nodes: Any, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cluster was started in another folder; recipe, behaviour agents and datasets are named by relative paths."""
    nodes, _ = two_nodes
    project = home / "project"
    project.mkdir()
    monkeypatch.chdir(project)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "datasets")
    (project / "colorsys.py").write_text("raise RuntimeError")
    (project / "tiny.toml").write_text(TINY_RECIPE)
    executor = ray_executor.RayExecutor(nodes.address)

    def imported_file() -> str:
        import colorsys

        return colorsys.__file__

    imported = executor.ray.get(executor.ray.remote(imported_file).remote())
    assert Path(imported).parent == Path(os.__file__).parent
    executor.record([GridDataset("tiny-medium-v0", "./tiny.toml", "medium", steps=500)], 1)
    assert (project / "datasets" / "tiny-medium-v0" / "data").is_dir()
    assert list((project / "behaviour" / "tiny").iterdir())


def test_what_fails_on_a_node_is_said_here(two_nodes: Any, home: Path) -> None:
    nodes, _ = two_nodes
    (home / "grid.toml").write_text(GRID.replace('env = "inverted-pendulum"', 'env = "./gone.toml"'))
    source = load_grid("./grid.toml").datasets
    with pytest.raises(OffbenchError, match="no recipe file"):
        ray_executor.RayExecutor(nodes.address).record(source, 1)


def test_a_cluster_that_is_not_there_is_one_line() -> None:
    with pytest.raises(OffbenchError, match="no Ray cluster at"):
        ray_executor.RayExecutor("127.0.0.1:1")
