"""What changes between the start of a command and the training of a run: its code, and the run itself."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest

import offbench
from offbench.benchmarks import ray_executor
from offbench.common import checkpoints
from offbench.common.code_hash import file_hash
from offbench.common.errors import OffbenchError
from offbench.envs.environments import env_spec
from offbench.training.devices import pick_machine
from offbench.training.jobs import run_jobs
from offbench.training.run import Run
from offbench.training.source_code import code_of
from offbench.training.spec import RunSpec, TrainingSchedule, specs_of
from offbench.training.train import Training
from tests.conftest import forget_modules
from tests.training.test_resume import train

OWN = """
from offbench.algos.bc import BC


class Mine(BC):
    VERSION = 1.0
"""
SETTINGS = {"hidden": (16, 16), "batch_size": 32}


def specs(algorithm: str, dataset: str, steps: int, seeds: tuple[int, ...] = (0,)) -> list[RunSpec]:
    schedule = TrainingSchedule(seeds, steps, 100, 2)
    return list(specs_of(algorithm, SETTINGS, [dataset], schedule, Path("runs"))[0])


def training(runs: list[RunSpec], *, stack: int = 8, processes: int = 1) -> Training:
    return Training(runs, pick_machine("cpu", processes, stack, "float32"))


def edit(home: Path, text: str) -> None:
    (home / "mine.py").write_text(text)
    forget_modules(home)


def test_code_that_is_edited_before_a_job_starts_is_refused(home: Path, medium: str) -> None:
    """Each job is a process that imports the file anew."""
    edit(home, OWN)
    waiting = training(specs("./mine.py", medium, 20, (0, 1)), stack=1, processes=2)
    (home / "mine.py").write_text(OWN.replace("1.0", "2.0"))
    problems = waiting.run()
    assert len(problems) == 2
    assert all("code was edited since this command began (mine.py has changed)" in line for line in problems)
    assert not any(run.has_checkpoint for run in map(Run, Path("runs").rglob("seed-*")))


def test_the_hash_is_of_the_code_that_was_imported(home: Path, medium: str) -> None:
    edit(home, OWN)
    imported = {"mine.py": file_hash(home / "mine.py")}
    runs = specs("./mine.py", medium, 20)
    (home / "mine.py").write_text(OWN.replace("1.0", "2.0"))
    training(runs)
    assert imported.items() <= runs[0].run.config().code.items()


def test_a_run_that_another_command_has_trained_further_is_left_alone(medium: str) -> None:
    waiting = training(specs("td3_bc", medium, 200))
    (run,) = train("td3_bc", medium, "runs", 400)
    files = {path: path.read_bytes() for path in run.folder.iterdir()}
    with pytest.raises(OffbenchError, match="at step 400 already"):
        waiting.run()
    assert {path: path.read_bytes() for path in run.folder.iterdir()} == files


def test_a_stack_of_which_one_run_was_trained_further_is_left_alone(medium: str) -> None:
    runs = train("td3_bc", medium, "runs", 200, seeds=[0, 1])
    waiting = training(specs("td3_bc", medium, 500, (0, 1)))
    train("td3_bc", medium, "runs", 400, seeds=[0])
    with pytest.raises(OffbenchError, match="another process has trained some of these runs"):
        waiting.run()
    assert [checkpoints.steps(run.folder) for run in runs] == [[400, 300], [200, 100]]


@pytest.mark.parametrize("steps", [200, 300])
def test_a_run_that_another_command_finishes_meanwhile_is_finished(medium: str, steps: int) -> None:
    """Even if it went on to more steps: their checkpoints are kept."""
    waiting = training(specs("td3_bc", medium, 200))
    (run,) = train("td3_bc", medium, "runs", steps)
    files = {path: path.read_bytes() for path in run.folder.iterdir()}
    assert waiting.run() == []
    assert {path: path.read_bytes() for path in run.folder.iterdir()} == files


def test_a_run_that_gets_results_while_its_lock_is_awaited_is_not_deleted(
    medium: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run,) = train("td3_bc", medium, "runs", 100)
    config = run.config()
    stored = {path.name: path.read_bytes() for path in run.folder.glob("*.*") if path.name != "config.json"}
    for name in stored:
        (run.folder / name).unlink()
    lock = Run.locked

    @contextlib.contextmanager
    def awaited(self: Run) -> Iterator[None]:
        for name, content in stored.items():
            (self.folder / name).write_bytes(content)
        with lock(self):
            yield

    monkeypatch.setattr(Run, "locked", awaited)
    with pytest.raises(OffbenchError, match="--eval-every 100, not 50"):
        train("td3_bc", medium, "runs", 100, eval_every=50)
    assert run.config() == config
    assert run.has_checkpoint


def test_fresh_deletes_nothing_if_a_run_is_being_trained(medium: str) -> None:
    first, second = train("td3_bc", medium, "runs", 100, seeds=[0, 1])
    with second.locked(), pytest.raises(OffbenchError, match="is being trained"):
        train("td3_bc", medium, "runs", 100, seeds=[0, 1], fresh=True)
    assert first.finished(100)


def test_a_run_without_intact_checkpoints_does_not_take_its_stack_back_to_the_start(
    medium: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, whole = train("td3_bc", medium, "runs", 200, seeds=[0, 1])
    for step in (100, 200):
        (damaged.folder / f"checkpoint-{step:09d}.safetensors").write_bytes(b"damaged")
    with pytest.raises(OffbenchError, match=r"an intact checkpoint; delete the runs whose .* \(see above\)"):
        train("td3_bc", medium, "runs", 300, seeds=[0, 1])
    assert str(damaged.folder) in capsys.readouterr().err
    assert checkpoints.steps(whole.folder) == [200, 100]
    for path in damaged.folder.iterdir():
        path.unlink()
    train("td3_bc", medium, "runs", 300, seeds=[0, 1])
    assert damaged.finished(300)
    assert whole.finished(300)


def test_an_upload_that_fails_half_way_leaves_a_run_that_resumes(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (run,) = train("td3_bc", medium, "runs", 100)
    (longer,) = train("td3_bc", medium, "longer", 300)
    write = ray_executor.write_bytes

    def full(path: Path, data: bytes) -> None:
        if path.name == "evaluations.csv":
            raise OSError("no space left on device")
        write(path, data)

    files = ray_executor.read_folder(longer.folder)
    monkeypatch.setattr(ray_executor, "write_bytes", full)
    with pytest.raises(OSError, match="no space"):
        ray_executor.write_folder(run.folder, files)
    train("td3_bc", medium, "runs", 300)
    assert run.evaluations_path.read_bytes() == longer.evaluations_path.read_bytes()


def test_jobs_in_processes_check_the_code_of_packages_too(medium: str) -> None:
    waiting = training(specs("td3_bc", medium, 20, (0, 1)), stack=1, processes=2)
    for spec in waiting.jobs[0].specs:
        text = spec.run.config_path.read_text()
        spec.run.config_path.write_text(text.replace(code_of("td3_bc")["td3_bc.py"], "0" * 64))
    problems = run_jobs(waiting.jobs, 2)
    assert ["td3_bc.py has changed" in line for line in problems] == [True]
    assert offbench.normalize("runs")


def test_a_model_that_is_edited_before_a_job_starts_is_refused(home: Path, medium: str) -> None:
    """Each job reads it anew, also in the process that claimed the runs."""
    model = home / "pendulum.xml"
    model.write_bytes((Path(gym.envs.mujoco.__file__).parent / "assets" / "inverted_pendulum.xml").read_bytes())
    own = env_spec("InvertedPendulum-v5", xml_file=str(model))
    waiting = training([dataclasses.replace(spec, env_spec=own) for spec in specs("td3_bc", medium, 100)])
    model.write_text(model.read_text().replace('gravity="0 0 -9.81"', 'gravity="0 0 -5"'))
    with pytest.raises(OffbenchError, match=r"code was edited since this command began \(pendulum.xml has changed\)"):
        waiting.run()
