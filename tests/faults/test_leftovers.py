"""What killed processes leave: it never blocks, never counts as data, and goes with the next command."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.agents.ladder import find_ladder
from offbench.common.checkpoints import KEPT, path_of, steps
from offbench.common.errors import OffbenchError
from offbench.common.files import exclusive_lock
from offbench.data import minari_store, transitions
from offbench.envs.recipes import load_recipe
from offbench.evaluation.similarity import read_similarity, similarity
from offbench.training import run as run_module
from offbench.training.run import Run

SMALL: dict[str, Any] = {"eval_every": 50, "eval_episodes": 1, "workers": 1, "hidden": (8, 8), "batch_size": 16}


def leave(path: Path, kind: str, elsewhere: Path) -> None:
    """Put a FIFO, a file, a link or a folder at `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "file":
        path.write_bytes(b"x")
    elif kind == "folder":
        (path / "data").mkdir(parents=True)
        (path / "data" / "main_data.hdf5").write_bytes(b"half")
    else:
        path.symlink_to(elsewhere if kind == "link" else elsewhere / "nowhere")


@pytest.mark.parametrize("kind", ["fifo", "file", "folder", "link", "broken link"])
@pytest.mark.parametrize("ending", ["partial", "old"])
def test_leftovers_of_a_recording_of_any_kind_are_removed(
    kind: str, ending: str, tiny: tuple[str, str], home: Path
) -> None:
    (home / "elsewhere").mkdir()
    (home / "elsewhere" / "mine").touch()
    words: dict[str, Any] = {"behaviour_dir": tiny[1], "workers": 1, "steps": 60}
    leave(home / "minari" / f".offbench-tiny-random-v0.{ending}", kind, home / "elsewhere")
    name = offbench.collect(tiny[0], "random", **words)
    assert [path.name for path in (home / "minari").iterdir() if path.suffix != ".lock"] == [name]
    leave(home / "minari" / f".offbench-{name}.{ending}", kind, home / "elsewhere")
    offbench.collect(tiny[0], "random", **words)  # is recorded already
    assert [path.name for path in (home / "minari").iterdir() if path.suffix != ".lock"] == [name]
    assert not minari_store.path_of(name).is_symlink()
    assert os.listdir(home / "elsewhere") == ["mine"]


def test_half_of_a_replaced_dataset_is_not_put_back(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed while it deletes the dataset that it has replaced."""
    path = minari_store.path_of(medium)
    shutil.copytree(path, minari_store.hidden_path(path, "old"))

    def killed(folder: Path) -> None:
        for file in [file for file in folder.rglob("*.hdf5") if file.is_file()]:
            file.unlink()
        if folder.exists():
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(minari_store, "delete", killed)
        with pytest.raises(KeyboardInterrupt):
            minari_store.recover(path)
    shutil.rmtree(path)
    assert not minari_store.exists(medium)
    minari_store.tidy(medium)
    assert not minari_store.exists(medium)


def test_folders_that_are_only_named_like_a_leftover(home: Path) -> None:
    for name in (".offbench-..old", ".offbench-...old", ".offbench-.old"):
        (home / "minari" / name / "data").mkdir(parents=True)
    assert minari_store.local_ids() == []


@pytest.mark.parametrize("deleted", range(7))
def test_fresh_that_is_killed_while_it_deletes_starts_over(
    deleted: int, medium: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=100, **SMALL)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    similarity(folder)
    calls: list[Path] = []

    def killed(path: Path) -> None:
        if len(calls) == deleted:
            raise KeyboardInterrupt
        calls.append(path)
        path.unlink(missing_ok=True)

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "delete", killed)
        with pytest.raises(KeyboardInterrupt):
            Run(folder).clear()
    assert len(calls) == deleted
    offbench.train("td3_bc", medium, steps=100, **SMALL)
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert after.pop("similarity.json", None) is None or not deleted
    assert {name: data for name, data in after.items() if name != "config.json"} == {
        name: data for name, data in before.items() if name != "config.json"
    }
    assert read_similarity(Run(folder)) is None or not deleted


def test_a_checkpoint_too_many_goes_when_the_run_goes_on(medium: str) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=100, **SMALL)
    shutil.copy(path_of(folder, 50), path_of(folder, 25))
    assert len(steps(folder)) > KEPT
    (folder / ".evaluations.csv.123.tmp").touch()
    rows = (folder / "evaluations.csv").read_text().splitlines(keepends=True)
    (folder / "evaluations.csv").write_text("".join(rows[:-1]))  # killed before its last evaluation was written
    offbench.train("td3_bc", medium, steps=100, **SMALL)
    assert steps(folder) == [100, 50]
    assert (folder / "evaluations.csv").read_text() == "".join(rows)
    assert not list(folder.glob(".*.tmp"))


def test_a_conversion_that_is_killed_while_it_deletes_the_earlier_one(
    medium: str, tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offbench.load(medium)
    offbench.collect(tiny[0], "medium", behaviour_dir=tiny[1], workers=1, seed=1, overwrite=True)

    def killed(folder: Path, **_: object) -> None:
        (folder / "meta.json").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(transitions.shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            offbench.load(medium)
    offbench.load(medium)
    assert len([path for path in (home / "cache").iterdir() if path.suffix != ".lock"]) == 1


def test_a_folder_that_cannot_be_deleted_is_named_before_the_recording(
    tiny: tuple[str, str], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = home / "minari" / ".offbench-tiny-random-v0.partial"
    left.mkdir(parents=True)

    def refuse(path: Path) -> None:
        if path == left:
            raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(minari_store, "delete", refuse)
    with pytest.raises(OffbenchError, match=r"cannot write .*\.offbench-tiny-random-v0\.partial: Permission denied"):
        offbench.collect(tiny[0], "random", behaviour_dir=tiny[1], workers=1, steps=60)


def test_a_ladder_whose_replacement_was_killed_is_put_back(tiny: tuple[str, str], home: Path) -> None:
    recipe, folder = load_recipe(tiny[0]), home / "behaviour"
    shutil.copytree(tiny[1], folder)
    ladder = find_ladder(recipe, folder)
    assert ladder is not None
    ladder.folder.rename(ladder.folder.with_name(".ladder.old"))
    assert find_ladder(recipe, folder) == ladder


def test_two_processes_do_not_build_one_ladder(tiny: tuple[str, str], home: Path) -> None:
    shutil.copytree(tiny[1], home / "behaviour")
    with (
        exclusive_lock(home / "behaviour/tiny/seed-0/.lock", "held"),
        pytest.raises(OffbenchError, match="is being trained"),
    ):
        offbench.behaviour(tiny[0], behaviour_dir=home / "behaviour", workers=1)
