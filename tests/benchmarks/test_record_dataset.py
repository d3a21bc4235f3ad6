"""A grid's dataset that another process records is waited for; other errors are raised."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from offbench.benchmarks import benchmark as benchmark_module
from offbench.benchmarks import datasets
from offbench.benchmarks.benchmark import LocalExecutor, _seconds, benchmark
from offbench.benchmarks.datasets import record_dataset
from offbench.benchmarks.grid import GridDataset
from offbench.benchmarks.plan import prepare
from offbench.common.errors import LockedError, OffbenchError
from offbench.common.files import exclusive_lock
from offbench.data import minari_store
from tests.benchmarks.test_benchmark import GRID, silent

MINE = GridDataset("mine-v0", "inverted-pendulum", "random", steps=100)


@contextmanager
def recording_meanwhile(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Hold the lock of the dataset, and yield while a call that records it waits beside."""
    lock, waiting, go_on = exclusive_lock, Event(), Event()

    def sleep(seconds: float) -> None:
        assert seconds == datasets.WAIT
        waiting.set()
        assert go_on.wait(20)

    monkeypatch.setattr(datasets, "time", SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(minari_store, "exclusive_lock", lambda path, what, timeout=0.01: lock(path, what, timeout))
    with ThreadPoolExecutor(1) as beside:
        with minari_store.claimed(MINE.id, False):
            recorded = beside.submit(record_dataset, MINE, 1)
            recorded.add_done_callback(lambda _: waiting.set())
            assert waiting.wait(20)
            assert not recorded.done()
            yield
        go_on.set()
        recorded.result(timeout=60)


def test_a_dataset_that_another_process_gives_up_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    with recording_meanwhile(monkeypatch):
        assert MINE.id not in minari_store.local_ids()
    assert minari_store.read_metadata(MINE.id)["total_steps"] == 100


def test_a_lock_that_is_released_meanwhile_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The other process stops between the refusal and the next look at the lock, or trained the behaviour agent."""
    locked = LockedError("mine-v0 is being recorded by process 1 on here; wait for it, or stop it")
    collect, refusals = datasets.collect, [locked, locked]

    def refused_once(*words: Any, **options: Any) -> str:
        if refusals:
            raise refusals.pop()
        return collect(*words, **options)

    monkeypatch.setattr(datasets, "collect", refused_once)
    monkeypatch.setattr(datasets, "WAIT", 0.01)
    record_dataset(MINE, 1)
    assert minari_store.read_metadata(MINE.id)["total_steps"] == 100
    assert capfd.readouterr().err.count("mine-v0 is being recorded by process 1 on here; waiting for it\n") == 1


def test_a_dataset_that_another_process_finishes_is_taken(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with recording_meanwhile(monkeypatch):
        shutil.copytree(minari_store.path_of(medium), minari_store.path_of(MINE.id))
    assert minari_store.read_metadata(MINE.id)["total_steps"] == 600


def test_an_error_is_raised_where_nobody_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datasets, "time", SimpleNamespace(sleep=lambda _: pytest.fail("it waits")))
    with pytest.raises(OffbenchError, match=r"no recipe file .*gone\.toml"):
        record_dataset(GridDataset("mine-v0", "./gone.toml", "random", steps=100), 1)


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("9m", 540), ("0.5m", 30), ("1.5h", 5400), ("2h", 7200)])
def test_budgets_in_seconds_minutes_and_hours(text: str, seconds: float) -> None:
    assert _seconds(text) == seconds


def test_a_budget_is_the_deadline_of_the_trainings(medium: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "grid.toml").write_text(GRID.replace("DATASET", medium))
    deadlines: list[float] = []

    class Idle(LocalExecutor):
        def train(self, jobs: Any, processes: int) -> list[str]:
            deadlines.extend(job.deadline for job in jobs)
            return []

    monkeypatch.setattr(benchmark_module, "write_plan", lambda *_: {})
    began = time.time()
    assert not benchmark(prepare("./grid.toml", workers=1), budget="9m", executor=Idle(), say=silent)
    assert deadlines
    assert all(began + 540 <= deadline <= time.time() + 540 for deadline in deadlines)


def test_no_recording_begins_after_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of a minute each and a budget of 100 seconds: the third would begin after 120."""
    clock, recorded = [1000.0], list[str]()

    def minute(dataset: GridDataset, workers: int) -> None:
        clock[0] += 60
        recorded.append(dataset.id)

    monkeypatch.setattr(benchmark_module, "record_dataset", minute)
    monkeypatch.setattr(benchmark_module, "time", SimpleNamespace(time=lambda: clock[0]))
    sources = [GridDataset(f"{letter}-v0", "inverted-pendulum", "random") for letter in "abc"]
    LocalExecutor().record(sources, 1, 1100.0)
    assert recorded == ["a-v0", "b-v0"]
    LocalExecutor().record(sources, 1)
    assert recorded == ["a-v0", "b-v0", "a-v0", "b-v0", "c-v0"]
