"""Training a behaviour agent: a signal saves a checkpoint where it arrives, and a resume has the same bits."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

import offbench
from offbench.agents import sac
from offbench.agents.ladder import folder_of
from offbench.agents.sac import train
from offbench.agents.training_folder import TrainingFolder
from offbench.cli.main import main
from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.envs.recipes import load_recipe


def undisturbed(tiny: tuple[str, str]) -> Path:
    return folder_of(load_recipe(tiny[0]), 0, Path(tiny[1]))


def assert_same_training(folder: Path, expected: Path) -> None:
    """All policies, within segments too, all transitions and the ladder's replay, byte for byte."""
    for part in ("policies", "transitions", "ladder/policies"):
        names = sorted(path.name for path in (expected / part).iterdir())
        assert sorted(path.name for path in (folder / part).iterdir()) == names
        for name in names:
            assert (folder / part / name).read_bytes() == (expected / part / name).read_bytes(), name
    replay = "ladder/medium-replay.hdf5"
    assert (folder / replay).read_bytes() == (expected / replay).read_bytes()


def interrupt_at(steps: list[int], sent: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send a signal to this process when the training reaches each of these steps."""
    update = SAC.train

    def interrupted(model: SAC, *args: Any, **kwargs: Any) -> None:
        if steps and model.num_timesteps == steps[0]:
            del steps[0]
            signal.raise_signal(sent)
        update(model, *args, **kwargs)

    monkeypatch.setattr(SAC, "train", interrupted)


@pytest.mark.parametrize(
    ("sent", "status", "at"), [(signal.SIGINT, 130, [504, 1232, 1300]), (signal.SIGTERM, 143, [1200])]
)
@pytest.mark.usefixtures("ctrl_c")
def test_a_signal_saves_a_checkpoint_where_it_arrives(
    tiny: tuple[str, str],
    home: Path,
    sent: int,
    status: int,
    at: list[int],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Within a segment, twice in one, and at a segment's end; SB3 leaves no folder of its logger behind."""
    recipe, _ = tiny
    monkeypatch.setattr(tempfile, "tempdir", str(home))
    folder = folder_of(load_recipe(recipe), 0, home / "behaviour")
    words = ["behaviour", recipe, "--workers", "1"]
    left = list(at)
    interrupt_at(left, sent, monkeypatch)
    for step in at:
        with pytest.raises(SystemExit) as stopped:
            main(words)
        said = capfd.readouterr().err
        assert stopped.value.code == status
        assert f"stopped at step {step:,}, checkpoint saved" in said
        assert checkpoints.steps(folder)[0] == step
        assert "Traceback" not in said
    main(words)
    assert not left
    assert f"resuming from step {at[-1]:,} of" in capfd.readouterr().err
    assert_same_training(folder, undisturbed(tiny))
    assert checkpoints.steps(folder) == [2400, 2000]
    assert not list(home.glob("SB3-*"))


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_in_a_terminal_saves_a_checkpoint(tiny: tuple[str, str], home: Path) -> None:
    recipe, _ = tiny
    folder = folder_of(load_recipe(recipe), 0, home / "behaviour")
    command = [sys.executable, "-m", "offbench", "behaviour", recipe, "--workers", "1"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not (folder / "policies" / "000000860.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    (step,) = (int(number.replace(",", "")) for number in re.findall(r"stopped at step ([\d,]+), checkpoint", errors))
    assert checkpoints.steps(folder)[0] == step >= 860
    subprocess.run(command, check=True, capture_output=True)
    assert_same_training(folder, undisturbed(tiny))


@pytest.mark.usefixtures("ctrl_c")
def test_an_environment_that_does_not_repeat_itself_resumes_at_the_segments_start(
    tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    made, counter = sac.make_env, itertools.count()

    def other_each_time(spec: str) -> gym.Env[Any, Any]:
        return gym.wrappers.TransformReward(made(spec), lambda reward: float(reward) + 1e-3 * next(counter))

    monkeypatch.setattr(sac, "make_env", other_each_time)
    recipe = load_recipe(tiny[0])
    folder = TrainingFolder(recipe, 0, home / "training")
    interrupt_at([1000], signal.SIGINT, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train(folder, 1200)
    assert checkpoints.steps(folder.path) == [1000, 800]
    train(folder, 1200)
    said = capfd.readouterr().err
    assert "did not repeat the episodes before step 1,000 exactly" in said
    assert "resuming from step 800 of" in said
    assert checkpoints.steps(folder.path) == [1200, 800]
    with np.load(folder.transitions(1200)) as arrays:
        assert len(arrays["rewards"]) == 100


def test_other_versions_are_named_when_a_training_resumes(
    tiny: tuple[str, str], home: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = TrainingFolder(load_recipe(tiny[0]), 0, home / "training")
    train(folder, 400)
    path = folder.path / "training.json"
    recorded = json.loads(path.read_text())
    train(folder, 800)
    assert "was started with" not in capfd.readouterr().err
    recorded["versions"] |= {"mujoco": "3.1.0"}
    path.write_text(json.dumps(recorded))
    train(folder, 1200)
    assert re.search(r"was started with mujoco 3\.1\.0, not [\d.]+; its results may differ", capfd.readouterr().err)


def test_a_training_with_other_contact_margins_is_another_one(tiny: tuple[str, str], home: Path) -> None:
    recipe = load_recipe(tiny[0])
    folder = home / "training"
    train(TrainingFolder(recipe, 0, folder), 400)
    path = folder / "training.json"
    recorded = json.loads(path.read_text())
    assert recorded.pop("contact_margin") == "max"
    path.write_text(json.dumps(recorded))  # as earlier versions wrote it
    train(TrainingFolder(recipe, 0, folder), 400)
    with pytest.raises(OffbenchError, match="holds another training, with contact_margin max, not sum"):
        train(TrainingFolder(dataclasses.replace(recipe, contact_margin="sum"), 0, folder), 400)


def test_a_folder_of_an_earlier_version_is_resumed_and_gets_the_same_ladder(tiny: tuple[str, str], home: Path) -> None:
    """It has no policy within segments."""
    recipe, _ = tiny
    folder = folder_of(load_recipe(recipe), 0, home / "behaviour")
    shutil.copytree(undisturbed(tiny), folder, ignore=shutil.ignore_patterns("ladder"))
    for path in (folder / "policies").iterdir():
        if int(path.stem) % 400:
            path.unlink()
    ladder = offbench.behaviour(recipe, workers=1)
    steps = [rung.step for rung in ladder.rungs]
    assert steps
    assert not [step for step in steps if step % 400]
    assert ladder.expert_return == offbench.behaviour(recipe, behaviour_dir=tiny[1], workers=1).expert_return
    (folder / "checkpoint-000002400.safetensors").unlink()
    (folder / "policies" / "000002400.safetensors").unlink()
    train(TrainingFolder(load_recipe(recipe), 0, folder), 2400)
    name = "policies/000002400.safetensors"
    assert (folder / name).read_bytes() == (undisturbed(tiny) / name).read_bytes()


def test_policies_within_a_segment_are_kept_where_the_return_changed(tiny: tuple[str, str], home: Path) -> None:
    """A hundred in a segment, with its rung (they are small); those of a segment whose return stayed are deleted."""
    folder = TrainingFolder(load_recipe(tiny[0]), 0, undisturbed(tiny))
    rows = sac.read_rungs(folder.rungs)
    returns = [row["stochastic_return"] for row in rows]
    kept = set(folder.policy_steps())
    assert set(range(400, 2401, 400)) <= kept
    for i in range(1, len(rows)):
        within = {step for step in kept if 400 * i < step < 400 * (i + 1)}
        spread = max(returns[: i + 1]) - min(returns[: i + 1])
        changed = abs(returns[i] - returns[i - 1]) >= 0.05 * spread
        assert within == (set(range(400 * i + 4, 400 * (i + 1), 4)) if changed else set())
