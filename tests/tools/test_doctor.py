"""`offbench doctor` tells a sound machine from a broken one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import pytest

from offbench.cli.main import main
from offbench.common.provenance import versions
from offbench.tools import doctor
from tests.conftest import ROOT

Cli = Callable[..., subprocess.CompletedProcess[str]]


def test_a_sound_machine_has_nothing_broken(offbench_cli: Cli) -> None:
    done = offbench_cli("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    for text in (f"mujoco {versions()['mujoco']}", "transitions replayed", "td3_bc", "GB free", "GB memory"):
        assert text in done.stdout
    assert "broken" not in done.stdout


@pytest.mark.parametrize("package", ["h5py", "torch"])
def test_a_package_that_does_not_import_is_named(package: str, home: Path) -> None:
    """The other checks are done all the same."""
    (home / package).mkdir()
    (home / package / "__init__.py").write_text("raise ImportError('libfoo.so.1: cannot open shared object file')")
    words = [sys.executable, "-m", "offbench", "doctor", "--json"]
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": f"{home}:{ROOT}"}, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert any(row["state"] == "broken" and "libfoo.so.1" in row["text"] for row in found)
    assert {row["name"]: row["state"] for row in found}["runs"] == "ok"
    assert not any("none is registered" in row["text"] for row in found)


def test_folders_that_cannot_be_written_are_broken(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "file").write_text("not a folder")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / "file" / "minari"))
    monkeypatch.setenv("OFFBENCH_CACHE", "/proc/x")
    with pytest.raises(SystemExit) as stopped:
        main(["doctor", "--json"])
    assert stopped.value.code == 1
    found = {row["name"]: row["state"] for row in json.loads(capsys.readouterr().out)}
    assert found["datasets"] == found["cache"] == "broken"
    assert found["physics"] == found["runs"] == "ok"


def test_the_physics_check_sees_other_physics(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.replay_error(16) <= doctor.TOLERANCE
    make = gymnasium.make

    def lighter(*args: object, **kwargs: object) -> gymnasium.Env:
        env = make(*args, **kwargs)  # type: ignore[arg-type]
        env.unwrapped.model.opt.gravity[2] *= 0.999  # type: ignore[attr-defined]
        mujoco.mj_setConst(env.unwrapped.model, env.unwrapped.data)  # type: ignore[attr-defined]
        return env

    monkeypatch.setattr(gymnasium, "make", lighter)
    ((state, text),) = doctor._physics()
    assert state == "broken"
    assert "mujoco" in text


def test_a_broken_algorithm_and_a_missing_package_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from offbench.training import registry

    monkeypatch.setattr(registry, "algorithm_names", lambda: ["td3_bc", "gone"])
    monkeypatch.setattr(doctor, "versions", lambda: {"python": "3.11", "minari": "not installed"})
    found = {(f.name, f.state): f.text for f in doctor.doctor()}
    assert "gone" in found["algorithms", "broken"]
    assert "td3_bc" in found["algorithms", "ok"]
    assert "minari not installed" in found["versions", "broken"]


def test_a_folder_with_the_name_of_an_extra_is_no_package(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """W&B writes a folder `wandb`, which Python takes for a package without files."""
    (home / "wandb_of_mine").mkdir()
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.setattr(doctor, "EXTRAS", {"wandb_of_mine": "live views"})
    assert list(doctor._extras()) == [("note", "wandb_of_mine is not installed (live views)")]


def test_no_renderer_is_worth_a_note_and_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    from offbench.evaluation import renderer

    monkeypatch.setattr(renderer, "working_backend", lambda: None)
    ((state, text),) = doctor._renderer()
    assert state == "note"
    assert "libegl1" in text
    assert "libosmesa6" in text
