"""Interrupted by Ctrl-C, SIGTERM or kill -9: a checkpoint where it stops, and the same bits after a resume."""

from __future__ import annotations

import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from offbench.agents.behaviour import folder_of
from offbench.cli.main import main
from offbench.common import checkpoints
from offbench.envs.recipes import load_recipe
from offbench.training.run import Run, find_runs
from offbench.training.stack import Stack
from tests.training.test_resume import assert_same_files, train


def kill_when(process: subprocess.Popen[bytes], ready: Any, delay: float) -> None:
    """Send SIGKILL a while after `ready()` first holds."""
    deadline = time.monotonic() + 120
    while not ready() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.mark.slow
def test_training_survives_kill_9(medium: str, home: Path) -> None:
    words = ["train", "bdb", "--dataset", medium, "--steps", "1500", "--eval-every", "100", "--eval-episodes", "2"]
    words += ["--hidden", "16,16", "--batch-size", "32", "--seeds", "0:2"]
    command = [sys.executable, "-m", "offbench", *words]
    wholes = train("bdb", medium, "whole", 1500, seeds=[0, 1])
    folder = home / "killed" / medium / "bdb" / "batch_size=32,hidden=16x16"
    kills = 0
    for delay in (0.0, 0.05, 0.13, 0.21):
        seen = set(checkpoints.steps(folder / "seed-0"))
        process = subprocess.Popen(
            [*command, "--runs", "killed"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        kill_when(process, lambda seen=seen: set(checkpoints.steps(folder / "seed-0")) - seen, delay)
        kills += process.returncode == -signal.SIGKILL
    assert kills >= 2
    for killed, whole in zip(train("bdb", medium, "killed", 1500, seeds=[0, 1]), wholes, strict=True):
        assert killed.folder.parent == folder.relative_to(home)
        assert_same_files(killed, whole)


def interrupted(*sent: int) -> Callable[[Stack, int], Iterator[int]]:
    """Return a `Stack.train_in_chunks` that sends signals to this process at step 300."""
    train_on = Stack.train_in_chunks

    def until_300(stack: Stack, until: int) -> Iterator[int]:
        for step in train_on(stack, until):
            for number in sent if step == 300 else ():
                signal.raise_signal(number)
            yield step

    return until_300


@pytest.mark.parametrize(("sent", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_sigterm_and_sighup_save_a_checkpoint_where_they_arrive(
    medium: str, sent: int, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (whole,) = train("td3_bc", medium, "whole", 600, eval_every=200)
    words = ["train", "td3_bc", "--dataset", medium, "--steps", "600", "--eval-every", "200", "--eval-episodes", "2"]
    words += ["--workers", "1", "--hidden", "16,16", "--batch-size", "32"]
    capsys.readouterr()
    with monkeypatch.context() as patched:
        patched.setattr(Stack, "train_in_chunks", interrupted(sent))
        with pytest.raises(SystemExit) as stopped:
            main(words)
    run = Run(Path("runs") / whole.folder.relative_to("whole"))
    assert stopped.value.code == status
    assert max(checkpoints.steps(run.folder)) == 300
    assert sorted(run.evaluations()) == [200]
    assert "stopped at step 300, checkpoint saved" in (said := capsys.readouterr().err)
    assert "rerun the same command to resume" in said
    assert run.config().command == shlex.join(["offbench", *words])
    main(words)
    assert "resuming from step 300" in capsys.readouterr().err
    assert_same_files(run, whole)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_after_fresh_says_how_to_keep_the_checkpoint(
    medium: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "bc", "--dataset", medium, "--steps", "600", "--eval-every", "600", "--eval-episodes", "2"]
    words += ["--workers", "1", "--hidden", "8", "--batch-size", "32"]
    with monkeypatch.context() as patched:
        patched.setattr(Stack, "train_in_chunks", interrupted(signal.SIGINT))
        with pytest.raises(SystemExit):
            main([*words, "--fresh"])
    assert "rerun the same command without --fresh to resume" in " ".join(capsys.readouterr().err.split())
    (path,) = home.rglob("config.json")
    assert Run(path.parent).config().command == shlex.join(["offbench", *words])
    main(["list", "runs", "--json"])
    (row,) = json.loads(capsys.readouterr().out)["runs"]
    assert row["step"] == 300  # although nothing was evaluated yet


def test_nohup_ignores_sighup(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup starts its command
    monkeypatch.setattr(Stack, "train_in_chunks", interrupted(signal.SIGHUP))
    words = ["train", "bc", "--dataset", medium, "--steps", "400", "--eval-every", "400", "--eval-episodes", "2"]
    main([*words, "--workers", "1", "--hidden", "8", "--batch-size", "32"])
    (run,) = find_runs(Path("runs"))
    assert checkpoints.steps(run.folder) == [400]
    assert signal.signal(signal.SIGHUP, before) == signal.SIG_IGN


@pytest.mark.slow
@pytest.mark.parametrize(("ignored", "status"), [(False, 128 + signal.SIGHUP), (True, 2)])
def test_a_closed_terminal(ignored: bool, status: int, medium: str, home: Path) -> None:
    """It sends SIGHUP. A training that ignores this is finished, and then cannot print the run's folder."""
    words = ["train", "td3_bc", "--dataset", medium, "--steps", "10000", "--eval-every", "10000"]
    words += ["--eval-episodes", "2", "--hidden", "16,16", "--batch-size", "32", "--workers", "1"]
    child, terminal = pty.fork()
    if child == 0:
        signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
        os.execv(sys.executable, [sys.executable, "-m", "offbench", *words])
    said, deadline = b"", time.monotonic() + 120
    while not re.search(rb"[1-9][\d,]*/10,000", said) and time.monotonic() < deadline:
        said += os.read(terminal, 1000)
    os.close(terminal)
    _, ended = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(ended) == status, said
    (step,) = checkpoints.steps(home / f"runs/{medium}/td3_bc/batch_size=32,hidden=16x16/seed-0")
    assert (step == 10_000) == ignored


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_does_not_wait_for_a_checkpoint(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stack, "train_in_chunks", interrupted(signal.SIGINT, signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        train("td3_bc", medium, "runs", 600, eval_every=200)
    (run,) = find_runs(Path("runs"))
    assert checkpoints.steps(run.folder) == [200]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "status", "verb"),
    [(signal.SIGINT, 130, "train"), (signal.SIGTERM, 143, "benchmark"), (signal.SIGHUP, 129, "train")],
)
@pytest.mark.usefixtures("ctrl_c")
def test_interrupted_worker_processes_save_checkpoints_too(
    medium: str, home: Path, sent: int, status: int, verb: str
) -> None:
    """The whole process group gets the signal, as from a terminal, a closed terminal, or Slurm."""
    every, steps = 500, 3000
    settings = {"steps": steps, "eval_every": every, "eval_episodes": 2}
    if verb == "train":
        words = ["train", "td3_bc", "--dataset", medium, "--seeds", "0:2", "--hidden", "16,16", "--batch-size", "32"]
        words += [word for key, value in settings.items() for word in (f"--{key.replace('_', '-')}", str(value))]
    else:
        lines = [f'datasets = ["{medium}"]', "seeds = 2", *(f"{key} = {value}" for key, value in settings.items())]
        lines += ["[[algorithms]]", 'name = "td3_bc"', "hidden = [16, 16]", "batch_size = 32"]
        (home / "grid.toml").write_text("\n".join(lines))
        words = ["benchmark", "./grid.toml"]
    command = [sys.executable, "-m", "offbench", *words, "--workers", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    runs = [Run(home / f"runs/{medium}/td3_bc/batch_size=32,hidden=16x16/seed-{seed}") for seed in range(2)]
    deadline = time.monotonic() + 120
    while not any(checkpoints.steps(run.folder) for run in runs) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, sent)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == status
    assert "leaked" not in errors
    assert "Traceback" not in errors
    assert "rerun the same command to resume" in errors
    newest = [max(there) for run in runs if (there := checkpoints.steps(run.folder))]
    said = [int(number.replace(",", "")) for number in re.findall(r"stopped at step ([\d,]+)", errors)]
    assert said
    assert sorted(said) == sorted(newest)
    more = {"seeds": [0, 1], "eval_every": every}
    whole = train("td3_bc", medium, "whole", steps, **more)
    for run, undisturbed in zip(train("td3_bc", medium, "runs", steps, **more), whole, strict=True):
        assert_same_files(run, undisturbed)


@pytest.mark.slow
def test_behaviour_training_survives_kill_9(tiny: tuple[str, str], home: Path) -> None:
    """The rungs, the transitions and the ladder equal those of an undisturbed training."""
    recipe, behaviour_dir = tiny
    whole = folder_of(load_recipe(recipe), 0, Path(behaviour_dir))
    killed = folder_of(load_recipe(recipe), 0, home / "killed")
    command = [sys.executable, "-m", "offbench", "behaviour", recipe, "--behaviour-dir", str(home / "killed")]
    kills = 0
    for delay in (0.0, 0.2, 0.4):
        seen = set(checkpoints.steps(killed))
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        kill_when(process, lambda seen=seen: set(checkpoints.steps(killed)) - seen, delay)
        kills += process.returncode == -signal.SIGKILL
    assert kills >= 2
    subprocess.run(command, check=True, capture_output=True)
    for path in sorted((whole / "policies").iterdir()):
        assert path.read_bytes() == (killed / "policies" / path.name).read_bytes()
    assert (whole / "ladder" / "medium-replay.hdf5").exists()
    ours, theirs = ((folder / "ladder" / "ladder.csv").read_text().splitlines() for folder in (whole, killed))
    no_hours = [[cell for i, cell in enumerate(line.split(",")) if i != 1] for line in ours]
    assert no_hours == [[cell for i, cell in enumerate(line.split(",")) if i != 1] for line in theirs]
