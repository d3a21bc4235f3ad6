"""The time left: by hand, where all steps cost the same and where they do not."""

from __future__ import annotations

import dataclasses
import io
import re
import time
from pathlib import Path

import pytest

from offbench.common import progress
from offbench.training.jobs import JobProgress
from offbench.training.registry import load_algorithm
from offbench.training.spec import Job, RunSpec


class Clock:
    """Seconds that pass when told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(time, "monotonic", made)
    return made


def job(algorithm: str, runs: int, steps: int, cost: float) -> Job:
    config = load_algorithm(algorithm).Config()
    specs = tuple(RunSpec(algorithm, config, "x-v0", seed, steps, 100, 1, Path()) for seed in range(runs))
    return Job(specs, "cpu", cost=cost)


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_what_is_slow_is_still_to_come(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with JobProgress([job("td3_bc", 2, 1000, 0.1), job("cql", 1, 100, 3.0)]) as bar:
        bar.report(0, 0, "")
        clock.now = 100.0
        bar.report(0, 1000, "")
        # 2000 updates of 0.1 in 100 s: 2 units of work a second, and 300 are left
        assert last_line(capsys) == "3 runs: 2,000/2,100 steps, 20 steps/s, 2 min 30 s left"
        clock.now = 200.0
        bar.report(1, 50, "score 7")  # resumed there: 150 of the 300 were done before
        clock.now = 250.0
        bar.report(1, 60, "")
        # 230 units in 250 s, 120 left
        assert last_line(capsys) == "3 runs: 2,060/2,100 steps, 8 steps/s, 2 min 10 s left, cql on x-v0: score 7"


def test_trainings_side_by_side_have_a_line_for_every_evaluation(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [job("bc", 1, 1000, 1.0), job("bc", 1, 1000, 1.0), job("td3_bc", 1, 1000, 1.0)]
    wide = dataclasses.replace(jobs[1].first.config, hidden=(8, 8))
    jobs[1] = Job((dataclasses.replace(jobs[1].first, seed=7, config=wide),), "cpu")
    with JobProgress(jobs) as bar:
        for step in range(10, 301, 10):
            for index in range(3):
                clock.now += 0.01
                bar.report(index, step, f"score {index} at step {step // 100 * 100}" if step >= 100 else "")
    notes = [line.rpartition("left, ")[2] for line in capsys.readouterr().err.splitlines() if "score" in line]
    titles = ["bc on x-v0, default, seed 0", "bc on x-v0, hidden=8x8, seed 7", "td3_bc on x-v0"]
    assert notes == [f"{titles[i]}: score {i} at step {step}" for step in (100, 200, 300) for i in range(3)]


def test_a_terminal_shows_the_same(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with progress.Progress(1000, "recording") as bar:
        clock.now = 10.0
        bar.to(100, "score 3")
        bar.print_line("a line above")
    assert "recording" in screen.getvalue()
    assert "10%" in screen.getvalue()
    assert "100/1,000, 10 steps/s, 1 min 30 s left" in screen.getvalue()
    assert "  score 3" in screen.getvalue()
    assert "a line above\n" in screen.getvalue()


def test_a_narrow_terminal_shows_the_bar_and_the_whole_note(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "dumb")  # no color and no movement: the last picture alone
    monkeypatch.setenv("COLUMNS", "80")
    note = "bdb (adaptive) on halfcheetah-medium-v0: score 41.3 at step 995,000"
    with progress.Progress(3000, "converting inverted-pendulum-medium-v0") as bar:
        clock.now = 10.0
        bar.to(1500, note)
    picture = [line.rstrip() for line in screen.getvalue().splitlines()]
    assert f"  {note}" in picture
    (line,) = [line for line in picture if line.startswith("converting inverted-pendulum-medium-v0 ")]
    assert re.search(r"v0 ━+╸? +50% 1,500/3,000, 10 s left$", line)


def test_a_long_title_is_cut_before_the_time_left(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    with progress.Progress(3000, "recording halfcheetah-medium-expert-v0") as bar:
        clock.now = 10.0
        bar.to(1500)
    assert re.search(r"recording halfche\.\.\. .*50%.*1,500/3,000, 10 s left", screen.getvalue())


def test_a_log_has_a_line_for_every_evaluation(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with progress.Progress(1000, "td3_bc on x-v0") as bar:
        for step in range(10, 501, 10):
            clock.now += 0.1
            bar.to(step, f"score {step // 100 * 5} at step {step // 100 * 100}" if step >= 100 else "")
    lines = capsys.readouterr().err.splitlines()
    assert [line.rpartition(", ")[2] for line in lines] == [f"score {5 * i} at step {100 * i}" for i in range(1, 6)]
    assert lines[0].startswith("td3_bc on x-v0: 100/1,000 steps, 100 steps/s, 9 s left")
