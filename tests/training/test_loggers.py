"""TensorBoard and Weights & Biases on request: what they get is what the run's files hold, every step once."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import subprocess
import sys
import types
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.cli.main import main
from offbench.training import loggers
from offbench.training.loggers import LoggerOptions, Loggers
from offbench.training.run import Run
from tests.made_runs import made_run

REFERENCES = ([-20.0, 230.0], [-10.0, 190.0])  # of a made run: its dataset's, D4RL's
SIZES: dict[str, Any] = {"hidden": (8,), "batch_size": 8, "eval_episodes": 2, "workers": 1}


def events(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Read every scalar of a folder's event files with TensorBoard's own reader, nothing dropped."""
    loader = pytest.importorskip("tensorboard.backend.event_processing.event_file_loader")
    from tensorboard.util import tensor_util

    found: dict[str, list[tuple[int, float]]] = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        for event in loader.EventFileLoader(str(path)).Load():
            for value in event.summary.value:
                number = float(tensor_util.make_ndarray(value.tensor).item())
                found.setdefault(value.tag, []).append((event.step, number))
    return found


def check_events(run: Run) -> None:
    """The event files must hold losses.csv and evaluations.csv, each step once and in order."""
    found = events(run.folder / "tensorboard")
    with open(run.folder / "losses.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for name in rows[0]:
        if name != "step":
            expected = [(int(row["step"]), float(row[name])) for row in rows if row[name]]
            assert [step for step, _ in found[f"losses/{name}"]] == [step for step, _ in expected]
            assert found[f"losses/{name}"] == [(step, pytest.approx(value, rel=1e-4)) for step, value in expected]
    for name, values in evaluations_by_hand(run).items():
        assert found[name] == [(step, pytest.approx(value, rel=1e-5)) for step, value in values.items()]


def evaluations_by_hand(run: Run) -> dict[str, dict[int, float]]:
    """Return each evaluation's mean return, length and score by step, from evaluations.csv and config.json."""
    with open(run.evaluations_path, newline="") as file:
        rows = list(csv.DictReader(file))
    low, high = json.loads(run.config_path.read_text())["references"]["dataset"]
    means: dict[str, dict[int, float]] = {"evaluation/return": {}, "evaluation/length": {}, "evaluation/score": {}}
    for step in sorted({int(row["step"]) for row in rows}):
        episodes = [row for row in rows if int(row["step"]) == step]
        for name in ("return", "length"):
            means[f"evaluation/{name}"][step] = sum(float(row[name]) for row in episodes) / len(episodes)
        means["evaluation/score"][step] = 100 * (means["evaluation/return"][step] - low) / (high - low)
    return means


def test_event_files_hold_what_the_run_holds(medium: str) -> None:
    pytest.importorskip("tensorboard")
    folders = offbench.train("td3_bc", medium, seeds=range(2), steps=60, eval_every=20, tensorboard=True, **SIZES)
    for folder in folders:
        check_events(Run(folder))


def test_the_scores_of_event_files_are_by_the_runs_own_references(home: Path) -> None:
    """In a run whose lengths are not its returns."""
    pytest.importorskip("tensorboard")
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, steps=12_000, references=REFERENCES)
    with Loggers([run], LoggerOptions(tensorboard=True)) as views:
        views.write(0, run.losses(), run.evaluations())
    check_events(run)


def test_a_longer_training_shows_every_step_once(medium: str) -> None:
    pytest.importorskip("tensorboard")
    for steps in (40, 80):
        (folder,) = offbench.train("td3_bc", medium, steps=steps, eval_every=20, tensorboard=True, **SIZES)
    check_events(Run(folder))
    assert len(events(folder / "tensorboard")["evaluation/return"]) == 4


def test_steps_that_a_kill_took_back_are_not_shown(medium: str) -> None:
    """A process dies with its last checkpoint unwritten: its event file holds more than the run goes on from."""
    pytest.importorskip("tensorboard")
    (folder,) = offbench.train("td3_bc", medium, steps=40, eval_every=20, tensorboard=True, **SIZES)
    (newest,) = folder.glob("checkpoint-*40.safetensors")
    newest.unlink()
    (folder,) = offbench.train("td3_bc", medium, steps=60, eval_every=20, tensorboard=True, **SIZES)
    check_events(Run(folder))


def test_the_flag_writes_event_files(medium: str, home: Path) -> None:
    pytest.importorskip("tensorboard")
    words = ["--steps", "20", "--eval-every", "10", "--eval-episodes", "1", "--hidden", "8", "--tensorboard"]
    main(["train", "td3_bc", "--dataset", medium, *words])
    assert len(list(home.glob("runs/**/tensorboard/events.out.tfevents.*"))) == 1


def test_nothing_is_written_unasked(medium: str) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=20, eval_every=10, **SIZES)
    assert not (folder / "tensorboard").exists()
    assert not (folder / "wandb.json").exists()


@pytest.mark.parametrize("package", ["tensorboard", "wandb"])
def test_a_missing_package_is_said_first(package: str, medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(loggers.importlib.util, "find_spec", lambda n: None if n == package else found(n))
    wanted: dict[str, Any] = {"tensorboard": True} if package == "tensorboard" else {"wandb": "project"}
    with pytest.raises(offbench.OffbenchError, match=rf"pip install 'offbench\[{package}\]'"):
        offbench.train("td3_bc", medium, steps=20, **wanted, **SIZES)
    assert not list(Path().glob("runs/**/config.json"))


def test_the_folder_that_wandb_writes_is_not_the_package(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(home)])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    (home / "wandb").mkdir()
    with pytest.raises(offbench.OffbenchError, match="needs the package wandb"):
        LoggerOptions(wandb="project").check()


class FakeRun:
    """Stands for a run of W&B: it keeps what it is given."""

    def __init__(self, **arguments: Any) -> None:
        self.arguments, self.rows, self.finished = arguments, [], False

    def define_metric(self, *_: Any, **__: Any) -> None:
        pass

    def log(self, row: dict[str, float]) -> None:
        self.rows.append(row)

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def fake_wandb(monkeypatch: pytest.MonkeyPatch) -> list[FakeRun]:
    """A stand-in for the package: the real one is tried by the test below where it is installed."""
    opened: list[FakeRun] = []

    def init(**arguments: Any) -> FakeRun:
        opened.append(FakeRun(**arguments))
        return opened[-1]

    module = types.ModuleType("wandb")
    module.init = init  # type: ignore[attr-defined]
    module.Settings = dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", module)
    return opened


def show(run: Run, until: int) -> None:
    """Show a run as it was when it had reached `until`, in a process of its own so to speak."""
    losses = [row for row in run.losses() if row["step"] <= until]
    evaluations = {step: rows for step, rows in run.evaluations().items() if step < until}
    with Loggers([run], LoggerOptions(wandb="project")) as views:
        views.write(0, losses, evaluations)


def test_wandb_gets_every_step_once_over_two_processes(fake_wandb: list[FakeRun], home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, steps=12_000, references=REFERENCES)
    for until in (5000, 8000, 3000, 12_001):  # the third went back to an older checkpoint
        show(run, until)
    assert len({fake.arguments["id"] for fake in fake_wandb}) == 1
    assert all(fake.finished and fake.arguments["project"] == "project" for fake in fake_wandb)
    assert fake_wandb[0].arguments["name"] == "hopper-medium-v0/td3_bc/default/seed-0"
    seen = Counter((row["step"], key) for fake in fake_wandb for row in fake.rows for key in row if key != "step")
    assert set(seen.values()) == {1}
    for name, values in evaluations_by_hand(run).items():
        sent = {row["step"]: row[name] for fake in fake_wandb for row in fake.rows if name in row}
        assert sent == pytest.approx(values)
    assert {step for step, key in seen if key == "losses/q_abs"} == {int(row["step"]) for row in run.losses()}
    assert fake_wandb[2].rows == []


def test_wandb_notes_before_it_sends(fake_wandb: list[FakeRun], home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill while rows go out: some may be missing, none comes twice."""
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50, steps=12_000)
    monkeypatch.setattr(FakeRun, "log", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        show(run, 5000)
    assert json.loads((run.folder / "wandb.json").read_text())["losses"] == 5000


def test_wandbs_refusal_is_one_line(home: Path, fake_wandb: list[FakeRun], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: Any) -> None:
        raise RuntimeError("no API key configured")

    monkeypatch.setattr(sys.modules["wandb"], "init", refuse)
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    with pytest.raises(offbench.OffbenchError, match="no API key configured; log in with `wandb login`"):
        show(run, 5000)


def test_a_refusal_at_the_second_run_closes_the_first(
    fake_wandb: list[FakeRun], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = sys.modules["wandb"].init

    def only_once(**arguments: Any) -> FakeRun:
        if fake_wandb:
            raise RuntimeError("too many runs")
        return opened(**arguments)

    monkeypatch.setattr(sys.modules["wandb"], "init", only_once)
    runs = [made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", seed, 50) for seed in range(2)]
    with (
        pytest.raises(offbench.OffbenchError, match="too many runs"),
        Loggers(runs, LoggerOptions(wandb="project")),
    ):
        pass
    assert fake_wandb[0].finished


def test_a_run_that_does_not_close_leaves_no_other_open(
    fake_wandb: list[FakeRun], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(loggers.TensorBoard, "close", full)
    runs = [made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", seed, 50) for seed in range(2)]
    with pytest.raises(OSError, match="disk full"), Loggers(runs, LoggerOptions(tensorboard=True, wandb="project")):
        pass
    assert [run.finished for run in fake_wandb] == [True, True]


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_run_whose_folder_of_events_is_a_link(name: str, home: Path, fake_wandb: list[FakeRun]) -> None:
    """In a run that was handed over it may lead anywhere."""
    pytest.importorskip("tensorboard")
    (home / "elsewhere").mkdir()
    (home / "elsewhere" / "events.out.tfevents.1").touch()
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    (run.folder / name).symlink_to(home / "elsewhere")
    show = LoggerOptions(tensorboard=True) if name == "tensorboard" else LoggerOptions(wandb="project")
    with pytest.raises(offbench.OffbenchError, match=f"{name} is a link; delete it"), Loggers([run], show):
        pass
    assert os.listdir(home / "elsewhere") == ["events.out.tfevents.1"]
    assert not fake_wandb


@pytest.mark.slow
def test_the_real_wandb_offline(medium: str, home: Path) -> None:
    pytest.importorskip("wandb", reason="wandb is missing: pip install offbench[wandb]")
    code = f"""
import offbench
for steps in (20, 40):
    offbench.train("td3_bc", {medium!r}, seeds=[0, 1], steps=steps, eval_every=10, hidden=(8,), batch_size=8,
                   eval_episodes=1, workers=1, wandb="project")
"""
    environment = dict(os.environ) | {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "HOME": str(home)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=home, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for seed in (0, 1):
        (folder,) = home.glob(f"runs/**/seed-{seed}")
        assert len(list(folder.glob("wandb/offline-run-*/*.wandb"))) == 2
        noted = json.loads((folder / "wandb.json").read_text())
        assert noted["losses"] == 40
        assert noted["evaluations"] == 40
