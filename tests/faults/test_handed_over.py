"""Links, exchanged files and changed flags in what was handed over are noticed; other files stay as they are."""

from __future__ import annotations

import json
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import exclusive_lock
from offbench.common.settings import setting
from offbench.data import minari_store, transitions
from offbench.envs.environments import make_env, untrusted_env
from offbench.evaluation.similarity import read_similarity
from offbench.training.spec import variant_name
from tests.faults.test_integrity import trained

SMALL: dict[str, Any] = {"eval_every": 50, "eval_episodes": 1, "workers": 1, "hidden": (8, 8), "batch_size": 16}


@pytest.mark.parametrize("kind", ["link", "fifo"])
def test_a_link_or_fifo_in_place_of_the_holder_file_is_replaced(kind: str, tmp_path: Path) -> None:
    precious, holder = tmp_path / "precious", tmp_path / "run" / ".lock.holder"
    precious.write_text("mine")
    holder.parent.mkdir()
    holder.symlink_to(precious) if kind == "link" else os.mkfifo(holder)
    with exclusive_lock(tmp_path / "run" / ".lock", "the run is being trained"):
        assert holder.read_text().startswith(f"process {os.getpid()} on ")
    assert precious.read_text() == "mine"
    assert not holder.exists()


def test_a_folder_named_like_an_allowed_package_is_not_imported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "gym" / "envs").mkdir(parents=True)
    for name in ("gym/__init__.py", "gym/envs/__init__.py", "gym/envs/evil.py"):
        (home / name).write_text("open('ran', 'w')")
    monkeypatch.syspath_prepend(home)
    spec = json.loads(make_env_spec()) | {"id": "Foo-v0", "entry_point": "gym.envs.evil:X"}
    with pytest.raises(OffbenchError, match=r"it would run gym\.envs\.evil from .*, where it is not installed"):
        untrusted_env(json.dumps(spec), "the run")
    assert not (home / "ran").exists()
    package = home / "gym-0.26.dist-info"  # installed elsewhere, and hidden by that folder
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: gym\nVersion: 0.26\n")
    (home / "site").mkdir()
    package.rename(home / "site" / package.name)
    monkeypatch.setattr(sys, "path", [*sys.path, str(home / "site")])
    with pytest.raises(OffbenchError, match=r"it would run gym\.envs\.evil from .*, where it is not installed"):
        untrusted_env(json.dumps(spec), "the run")
    assert not (home / "ran").exists()


def make_env_spec() -> str:
    from offbench.envs.recipes import load_recipe

    return load_recipe("inverted-pendulum").env_spec()


def test_the_environment_of_a_file_opens_no_window() -> None:
    spec = json.loads(make_env_spec())
    spec["kwargs"] = {"render_mode": "human"}
    env = make_env(json.dumps(spec))
    assert env.render_mode is None
    env.close()


def changed(dataset_id: str, column: str, value: float) -> None:
    (path,) = (minari_store.path_of(dataset_id) / "data").glob("*.hdf5")
    with h5py.File(path, "a") as file:
        file[f"episode_0/{column}"][0] = value


@pytest.mark.parametrize(("column", "value"), [("terminations", True), ("truncations", True), ("rewards", 9.0)])
def test_data_that_are_not_those_of_the_recorded_hash_are_neither_loaded_nor_exported(
    column: str, value: float, medium: str, home: Path
) -> None:
    changed(medium, column, value)
    with pytest.raises(OffbenchError, match="its arrays are not those of the content_sha256 in its metadata"):
        offbench.load(medium)
    for name in ("out.npz", "out.hdf5"):
        with pytest.raises(OffbenchError, match="its arrays are not those of the content_sha256 in its metadata"):
            offbench.export(medium, home / name)
    assert not list(home.glob("*out*"))


def test_the_checkpoint_of_other_settings_is_noticed(medium: str) -> None:
    (one,) = offbench.train("td3_bc", medium, steps=100, alpha=2.0, **SMALL)
    (other,) = offbench.train("td3_bc", medium, steps=100, alpha=3.0, **SMALL)
    for path in other.glob("checkpoint-*"):
        shutil.copy(path, one)
    with pytest.raises(OffbenchError, match=r"is of another run: its alpha is 3\.0, not 2\.0"):
        offbench.train("td3_bc", medium, steps=150, alpha=2.0, **SMALL)


def test_the_files_of_another_seed_are_noticed(medium: str) -> None:
    one, other = offbench.train("td3_bc", medium, seeds=[0, 1], steps=100, **SMALL)
    policy = (one / "policy.safetensors").read_bytes()
    shutil.copy(other / "policy.safetensors", one)
    with pytest.raises(OffbenchError, match="is of another run: its seed is 1"):
        offbench.evaluate(one, episodes=1, workers=1)
    with pytest.raises(OffbenchError, match="is of another run: its seed is 1"):
        offbench.load_policy(one)
    (one / "policy.safetensors").write_bytes(policy)
    for path in other.glob("checkpoint-*"):
        shutil.copy(path, one)
    evaluations = (one / "evaluations.csv").read_bytes()
    with pytest.raises(OffbenchError, match=r"the checkpoint in .* is of another run: its seed is 1, not 0"):
        offbench.train("td3_bc", medium, seeds=0, steps=150, **SMALL)
    assert (one / "evaluations.csv").read_bytes() == evaluations


def test_what_lies_in_the_cache_is_replaced(medium: str, home: Path) -> None:
    content = offbench.load(medium).content_sha256
    (folder,) = (path for path in transitions.cache().iterdir() if path.is_dir())
    shutil.rmtree(folder)
    (home / "precious").write_text("mine")
    folder.symlink_to(home / "precious")
    folder.with_name(f".{folder.name}.tmp").symlink_to(home / "precious")
    (transitions.cache() / "x").mkdir()
    (transitions.cache() / "x" / "meta.json").write_text("[" * 100_000)
    assert offbench.load(medium).content_sha256 == content
    assert folder.is_dir()
    assert not folder.is_symlink()
    assert (home / "precious").read_text() == "mine"


@pytest.mark.parametrize("flag", ["--hidden", "--batch-size", "--workers"])
def test_absurd_sizes_are_one_line(flag: str, medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "bc", "--dataset", medium, "--workers", "1", "--steps", "2", flag, str(10**18)])
    assert stop.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "not enough memory" in last or "workers must be a whole number from 1 to 1,000" in last


@pytest.mark.parametrize(
    ("steps", "fault"),
    [
        ([100, 300], "the evaluation of step 200 is missing"),
        ([200], "the evaluation of step 100 is missing"),
        ([100, 150, 200], "an evaluation of step 150"),
        ([0, 100], "step 0 of a run"),
    ],
)
def test_evaluations_at_other_steps_than_they_are_due_are_damage(tmp_path: Path, steps: list[int], fault: str) -> None:
    run = trained(tmp_path / "seed-0")
    config = json.loads(run.config_path.read_text()) | {"steps": 400, "eval_every": 100}
    run.config_path.write_text(json.dumps(config))
    two = [(1.0, 5), (2.0, 5)]
    run.write_evaluations(dict.fromkeys(steps, two))
    with pytest.raises(DamagedError, match=fault):
        offbench.normalize(tmp_path)
    run.write_evaluations(dict.fromkeys((100, 200, 250), two))  # as at the end of a run of 250 steps that goes on
    assert list(run.evaluations()) == [100, 200, 250]


@pytest.mark.parametrize(
    "rows", ["nan,1\n", "1e999,1\n", "-5,1\n", "200,1\n100,1\n", "100,1\n100,2\n", "1e300,1\n", ",1\n"]
)
def test_rows_of_losses_at_impossible_steps_are_damage(tmp_path: Path, rows: str) -> None:
    run = trained(tmp_path / "seed-0")
    run.losses_path.write_text("step,q_abs\n" + rows)
    with pytest.raises(DamagedError, match=r"losses\.csv"):
        run.losses()


def test_markup_in_a_name_is_text_in_markdown_and_latex(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = trained(tmp_path / "seed-0")
    name = "<script>|[x](javascript:y)\\input{x}"
    run.config_path.write_text(json.dumps(json.loads(run.config_path.read_text()) | {"dataset": name}))
    main(["normalize", "--runs", str(tmp_path), "--format", "markdown"])
    text = capsys.readouterr().out
    assert "<script>" not in text
    assert r"\|\[x\](javascript:y)" in text
    main(["normalize", "--runs", str(tmp_path), "--format", "latex"])
    assert r"\input" not in capsys.readouterr().out


def test_variants_keep_every_digit_and_letter() -> None:
    @dataclass(frozen=True)
    class Config:
        rate: float = setting(1.0, "")
        mode: str = setting("a", "")

    names = [
        variant_name(Config(rate, mode))
        for rate in (0.00012345678, 0.00012345679)
        for mode in ("B", "b", "x/y", "x,y")
    ]
    assert len({name.lower() if "mode=b" not in name.lower() else name for name in names}) == 8
    assert not any("/" in name for name in names)
    assert variant_name(Config(0.0003)) == "rate=0.0003"  # as ever


def test_a_setting_of_texts_is_one_folder_name() -> None:
    @dataclass(frozen=True)
    class Config:
        parts: tuple[str, ...] = setting((), "")

    names = [variant_name(Config(parts)) for parts in (("a", "b"), ("axb",), ("a/../../b",), ("a,b",))]
    assert names == ["parts=axb", "parts=a%78b", "parts=a%2F..%2F..%2Fb", "parts=a%2Cb"]


@pytest.mark.parametrize("change", [{"q_similar": 1e308}, {"action_similar": -50}, {"samples": -1}, {"tolerance": -1}])
def test_a_similar_score_out_of_range_is_damage(change: dict[str, float], tmp_path: Path) -> None:
    run = trained(tmp_path / "seed-0")
    sound = {
        "step": 1,
        "samples": 5,
        "q_similar": 99.0,
        "tolerance": 0.05,
        "action_similar": 9.0,
        "action_tolerance": 0.1,
    }
    (run.folder / "similarity.json").write_text(json.dumps(sound))
    assert read_similarity(run) is not None
    (run.folder / "similarity.json").write_text(json.dumps(sound | change))
    with pytest.raises(DamagedError, match="out of range"):
        read_similarity(run)
