"""Killed and resumed: the same bits as undisturbed, nothing lost, nothing twice."""

from __future__ import annotations

import itertools
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.analysis.results import read_results
from offbench.cli.main import main
from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.training.registry import algorithm_names
from offbench.training.run import Run, find_runs
from offbench.training.run_config import Session

SMALL: dict[str, Any] = {"hidden": (16, 16), "batch_size": 32, "eval_every": 100, "eval_episodes": 2, "workers": 1}
HALF: dict[str, Any] = {"precision": "bfloat16", "hidden": (64, 64)}  # a CPU multiplies narrower layers in float32
EXTRA: dict[str, dict[str, Any]] = {
    "td3_bc": {},
    "bdb": {},
    "bdb_plus": {"critic_penalty": "cql", "penalty_actions": 3, "beta": "learned"},
    "bc": {},
    "iql": {"decay_steps": 1000},
    "rebrac": {},
    "bear": {"vae_hidden": (16, 16), "target_samples": 3, "match_samples": 2, "warm_up_steps": 150, "eval_samples": 2},
    "cql": {"num_actions": 2, "bc_steps": 150, "eval_samples": 3},
}


def test_every_algorithm_is_tested_here() -> None:
    assert set(EXTRA) == set(algorithm_names())


def train(algorithm: str, dataset: str | list[str], runs: str, steps: int, **more: Any) -> list[Run]:
    settings = SMALL | EXTRA[algorithm] | more
    return [Run(path) for path in offbench.train(algorithm, dataset, steps=steps, runs=runs, **settings)]


def assert_same_files(one: Run, other: Run) -> None:
    newest = f"checkpoint-{max(checkpoints.steps(one.folder)):09d}.safetensors"
    for name in ("policy.safetensors", "evaluations.csv", "losses.csv", newest):
        assert (one.folder / name).read_bytes() == (other.folder / name).read_bytes(), name


@pytest.mark.parametrize(
    ("algorithm", "more"), [*((algorithm, {}) for algorithm in sorted(EXTRA)), ("bdb", HALF), ("rebrac", HALF)]
)
@pytest.mark.usefixtures("bfloat16")
def test_a_run_stopped_and_resumed_ends_with_the_same_bits(medium: str, algorithm: str, more: dict[str, Any]) -> None:
    (whole,) = train(algorithm, medium, "whole", 300, **more)
    assert whole.config().precision == more.get("precision", "float32")
    for steps in (100, 200, 300):
        (pieces,) = train(algorithm, medium, "pieces", steps, **more)
    assert_same_files(whole, pieces)


@pytest.mark.parametrize("more", [{}, HALF])
@pytest.mark.usefixtures("bfloat16")
def test_a_run_alone_equals_the_same_run_in_a_stack(medium: str, more: dict[str, Any]) -> None:
    """From the data to the weights: batches, noise and initial weights depend on the run's own seed alone."""
    stack = train("bdb", medium, "stack", 200, seeds=[3, 4, 5], **more)
    for run in stack:
        (alone,) = train("bdb", medium, "alone", 200, seeds=run.config().seed, **more)
        assert_same_files(run, alone)


@pytest.mark.usefixtures("bfloat16")
def test_each_precision_has_runs_of_its_own(medium: str) -> None:
    one, other = (train("td3_bc", medium, "runs", 100, **HALF | {"precision": p})[0] for p in ("float32", "bfloat16"))
    assert other.config().variant == f"{one.config().variant},precision=bfloat16"
    assert one.policy_path.read_bytes() != other.policy_path.read_bytes()
    labels = [method.label for method in read_results("runs").methods]
    assert labels == ["td3_bc", "td3_bc (precision=bfloat16)"]


def test_a_precision_that_the_device_lacks_is_refused(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("offbench.training.devices.has_bfloat16", lambda: False)
    for name, reason in {
        "bfloat16": "this processor cannot",
        "tf32": "use float32 on a CPU",
        "half": "'half'",
    }.items():
        with pytest.raises(OffbenchError, match=reason):
            train("td3_bc", medium, "runs", 100, precision=name)
    assert not Path("runs").exists()


def test_new_seeds_leave_finished_ones_alone(medium: str) -> None:
    """Seed 0 is done, seed 1 is half way, seed 2 is new: each goes on from where it is, to its own bits."""
    whole = train("td3_bc", medium, "whole", 200, seeds=[0, 1, 2])
    (first,) = train("td3_bc", medium, "runs", 200, seeds=0)
    train("td3_bc", medium, "runs", 100, seeds=1)
    before = first.policy_path.stat().st_mtime_ns
    for a, b in zip(whole, train("td3_bc", medium, "runs", 200, seeds=[0, 1, 2]), strict=True):
        assert_same_files(a, b)
    assert first.policy_path.stat().st_mtime_ns == before


def test_fewer_steps_than_there_are_do_not_undo_a_run(medium: str) -> None:
    (run,) = train("td3_bc", medium, "runs", 400)
    assert checkpoints.steps(run.folder) == [400, 300]
    with pytest.raises(OffbenchError, match="is at step 400 already; give --steps 400"):
        train("td3_bc", medium, "runs", 200)
    with pytest.raises(OffbenchError, match="is at step 400 already"):
        train("td3_bc", medium, "runs", 350)
    train("td3_bc", medium, "runs", 300)  # finished at exactly 300 too: nothing to do
    assert run.evaluations().keys() == {100, 200, 300, 400}
    assert checkpoints.steps(run.folder) == [400, 300]


def test_an_evaluation_off_the_grid_goes_when_a_run_is_extended(medium: str) -> None:
    """A run extended from 150 to 300 scores like one that went straight there."""
    (straight,) = train("td3_bc", medium, "straight", 300)
    (run,) = train("td3_bc", medium, "runs", 150)
    assert run.evaluations().keys() == {100, 150}
    train("td3_bc", medium, "runs", 300)
    assert run.evaluations() == straight.evaluations()
    assert run.policy_path.read_bytes() == straight.policy_path.read_bytes()


def test_two_datasets_in_a_stack_equal_each_alone(tiny: tuple[str, str], medium: str) -> None:
    """Offsets, sizes and normalisers of each dataset: together as apart."""
    other = offbench.collect(tiny[0], "random", behaviour_dir=tiny[1], workers=1, steps=437)
    stack = train("bdb", [other, medium], "stack", 200, seeds=[0, 1])
    for run in stack:
        config = run.config()
        (alone,) = train("bdb", config.dataset, "alone", 200, seeds=config.seed)
        assert_same_files(run, alone)


def test_a_learned_beta_beside_a_fixed_one_resumes_right(medium: str) -> None:
    whole = train("bdb_plus", medium, "whole", 200, beta=["learned", 0.25], beta_learning_rate=1e-2)
    for beta in ("learned", 0.25):  # apart first, then together
        train("bdb_plus", medium, "runs", 100, beta=beta, beta_learning_rate=1e-2)
    together = train("bdb_plus", medium, "runs", 200, beta=["learned", 0.25], beta_learning_rate=1e-2)
    for a, b in zip(whole, together, strict=True):
        assert_same_files(a, b)


def test_a_stack_killed_between_two_checkpoints_resumes_from_the_older(medium: str) -> None:
    whole = train("bdb", medium, "whole", 300, seeds=[0, 1])
    _, second = train("bdb", medium, "runs", 200, seeds=[0, 1])
    (second.folder / "checkpoint-000000200.safetensors").unlink()
    for a, b in zip(whole, train("bdb", medium, "runs", 300, seeds=[0, 1]), strict=True):
        assert_same_files(a, b)


@pytest.mark.parametrize("on_a_terminal", [False, True])
def test_the_step_that_runs_resume_from_is_printed(
    medium: str, on_a_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train("td3_bc", medium, "runs", 100, seeds=[0, 1])
    assert "resuming" not in capsys.readouterr().err
    train("td3_bc", medium, "runs", 200, seeds=[0])
    capsys.readouterr()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: on_a_terminal)
    train("td3_bc", medium, "runs", 200, seeds=[0, 1, 2])
    said = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)  # a terminal's control codes
    lines = said.replace("\r", "\n").splitlines()
    assert lines[0] == "already finished: 1 of 3 runs"
    assert [line for line in lines if "resuming" in line] == [f"td3_bc on {medium}, seed 1: resuming from step 100"]


@pytest.mark.parametrize(("words", "goes_on"), [(["train", "bc"], True), (["show", "x-v0"], False)])
def test_ctrl_c_promises_only_what_a_command_keeps(
    words: list[str], goes_on: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(_: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("offbench.cli.main._run", stop)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 130
    said = capsys.readouterr().err
    assert "offbench: stopped" in said
    assert ("rerun the same command to resume" in said) == goes_on


def test_a_finished_run_is_left_alone(medium: str) -> None:
    (run,) = train("td3_bc", medium, "runs", 100)
    before = {path.name: path.stat().st_mtime_ns for path in run.folder.glob("*.safetensors")}
    train("td3_bc", medium, "runs", 100)
    assert {path.name: path.stat().st_mtime_ns for path in run.folder.glob("*.safetensors")} == before


@pytest.mark.parametrize("damage", ["cut", "one bit"])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(
    damage: str, medium: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (whole,) = train("td3_bc", medium, "whole", 300)
    (run,) = train("td3_bc", medium, "runs", 200)
    newest = run.folder / "checkpoint-000000200.safetensors"
    data = bytearray(newest.read_bytes())
    data[-100] ^= 1
    newest.write_bytes(data if damage == "one bit" else data[:1000])
    train("td3_bc", medium, "runs", 300)
    assert "checkpoint-000000200.safetensors is damaged" in (said := capsys.readouterr().err)
    assert "it is not used" in said
    assert_same_files(run, whole)


def test_a_run_whose_checkpoints_are_all_damaged_is_not_trained_anew(medium: str) -> None:
    (run,) = train("td3_bc", medium, "runs", 300)
    for step in (200, 300):
        (run.folder / f"checkpoint-{step:09d}.safetensors").write_bytes(b"damaged")
    written = run.evaluations_path.read_bytes()
    with pytest.raises(OffbenchError, match="every run has an intact checkpoint; delete the runs"):
        train("td3_bc", medium, "runs", 400)
    assert run.evaluations_path.read_bytes() == written


def test_damaged_checkpoints_do_not_outlive_the_new_ones(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If they counted as the newest two, every new one would be deleted as soon as it is written."""
    (run,) = train("td3_bc", medium, "runs", 300)
    (run.folder / "checkpoint-000000300.safetensors").write_bytes(b"damaged")

    def stopped(folder: Path, step: int, *content: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints, "save_checkpoint", stopped)
    with pytest.raises(KeyboardInterrupt):
        train("td3_bc", medium, "runs", 400)
    assert checkpoints.steps(run.folder) == [200]


def test_another_run_in_the_same_place_is_refused(tiny: tuple[str, str], medium: str) -> None:
    train("td3_bc", medium, "runs", 100)
    with pytest.raises(OffbenchError, match="--eval-episodes 2, not 3"):
        train("td3_bc", medium, "runs", 200, eval_episodes=3)
    recipe, behaviour_dir = tiny
    offbench.collect(recipe, "medium", behaviour_dir=behaviour_dir, workers=1, seed=1, overwrite=True)
    with pytest.raises(OffbenchError, match="trained on another content of"):
        train("td3_bc", medium, "runs", 200)


def test_a_run_whose_files_were_deleted_is_not_taken_for_another(medium: str) -> None:
    """Going on from half of its evaluations, or under a new config.json, would give numbers that are not the run's."""
    (run,) = train("td3_bc", medium, "runs", 300)
    for path, steps in itertools.product((run.config_path, run.evaluations_path), (300, 400)):
        kept = path.read_bytes()
        path.unlink()
        with pytest.raises(OffbenchError, match=f"{path.name}.*put (it|the file) back, or delete the run"):
            train("td3_bc", medium, "runs", steps)
        if path == run.evaluations_path:
            with pytest.raises(OffbenchError, match="is missing; put it back, or delete the run"):
                offbench.normalize("runs")
        path.write_bytes(kept)
    run.write_evaluations({step: found for step, found in run.evaluations().items() if step != 200})
    with pytest.raises(OffbenchError, match="the evaluation of step 200 is missing"):
        train("td3_bc", medium, "runs", 400)


def test_a_refused_command_makes_no_run_folder(medium: str) -> None:
    train("td3_bc", medium, "runs", 100)
    with pytest.raises(OffbenchError, match=r"--eval-every 100, not 50 \(to continue it, give --eval-every 100\)"):
        train("td3_bc", medium, "runs", 100, seeds=[1, 0], eval_every=50)
    assert len(find_runs(Path("runs"))) == 1


def test_a_deleted_policy_comes_back_from_the_checkpoint(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    (run,) = train("td3_bc", medium, "runs", 300)
    policy, evaluations = run.policy_path.read_bytes(), run.evaluations_path.read_bytes()
    run.policy_path.unlink()
    train("td3_bc", medium, "runs", 300)
    assert (run.policy_path.read_bytes(), run.evaluations_path.read_bytes()) == (policy, evaluations)
    run.losses_path.unlink()
    capsys.readouterr()
    train("td3_bc", medium, "runs", 400)
    assert str(run.losses_path) in capsys.readouterr().err
    assert [row["step"] for row in run.losses()] == [400]


def test_what_trained_a_run_later_is_noted_if_it_is_something_else(
    medium: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run,) = train("td3_bc", medium, "runs", 100)
    train("td3_bc", medium, "runs", 200)
    assert run.config().sessions == ()
    elsewhere = {"device": "cuda", "precision": "tf32", "versions": {"torch": "9"}, "hardware": {"cores": 99}}
    monkeypatch.setattr("offbench.training.trainer.training_platform", lambda *_: elsewhere)
    for steps in (300, 400):
        train("td3_bc", medium, "runs", steps)
    config = run.config()
    assert config.sessions == (Session(step=200, **elsewhere),)
    assert (config.device, config.steps) == ("cpu", 400)


def test_two_processes_cannot_train_the_same_run(medium: str) -> None:
    (run,) = train("td3_bc", medium, "runs", 100)
    code = f"""
import sys
from offbench.cli.main import main
main(["train", "td3_bc", "--dataset", {medium!r}, "--steps", "200", "--eval-every", "100", "--eval-episodes", "2",
      "--hidden", "16,16", "--batch-size", "32"])
"""
    with run.locked():
        found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ))
    assert found.returncode == 2
    assert f"is being trained by process {os.getpid()} on {socket.gethostname()}" in found.stderr
    assert run.config().steps == 100  # who was refused has changed nothing


def test_the_steps_of_losses_stay_whole(home: Path) -> None:
    """A resume writes the rows anew that it has read: 1000998 is not 1.001e+06."""
    run, steps = Run(home), [999_999, 1_000_000, 1_000_998, 1_001_000, 12_345_678]
    run.write_losses([{"step": step, "q_abs": step / 3} for step in steps])
    text = run.losses_path.read_text()
    assert text.splitlines()[3] == "1000998,333666"
    run.write_losses(run.losses())
    assert run.losses_path.read_text() == text
    assert [row["step"] for row in run.losses()] == steps
