"""Odd files, texts and machines: one line, exit code 2; what a file names is judged before it is made."""

from __future__ import annotations

import io
import json
import os
import socket
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch

import offbench
from offbench.agents.sb3_zip import read_sb3_zip
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.files import home_folder, open_regular, output_file
from offbench.data import minari_store
from offbench.envs.environments import box, make_env, untrusted_env
from tests.faults.test_integrity import refusal


@pytest.mark.parametrize("key", ["env_spec", "eval_env_spec"])
@pytest.mark.parametrize("entry_point", ["os:mkdir", "canary:Env"])
def test_a_d4rl_file_runs_nothing_that_it_names(
    key: str, entry_point: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without timeouts and next observations, the environment is made to compare the rows with its resets."""
    (home / "canary.py").write_text("open('imported', 'w').close()")
    monkeypatch.syspath_prepend(home)
    spec: dict[str, Any] = {
        "id": "A-v0",
        "entry_point": entry_point,
        "kwargs": {"path": "made"} if entry_point.startswith("os") else {},
        "additional_wrappers": [],
        "max_episode_steps": 100,
        **dict.fromkeys(("reward_threshold", "vector_entry_point")),
        **dict.fromkeys(("nondeterministic", "order_enforce", "disable_env_checker"), False),
    }
    with h5py.File("evil.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((200, 4)), np.zeros((200, 1), np.float32)
        file["rewards"], file["terminals"] = np.ones(200, np.float32), np.arange(200) % 20 == 19
        sound = {"env_spec": json.dumps(spec | {"entry_point": "gymnasium.envs.mujoco.hopper_v5:HopperEnv"})}
        file.attrs["offbench"] = json.dumps(sound | {key: json.dumps(spec)})
    if key == "env_spec":
        offbench.import_d4rl("evil.hdf5", "evil-v0")  # it is kept as text
    else:
        with pytest.raises(OffbenchError, match=r"evil\.hdf5: .*--trust"):
            offbench.import_d4rl("evil.hdf5", "evil-v0")
    assert not Path("made").exists()
    assert not Path("imported").exists()


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_a_damaged_sb3_zip_is_one_line(method: int, tmp_path: Path) -> None:
    """Whatever zipfile, zlib, lzma and torch raise for damaged bytes."""
    weights = io.BytesIO()
    torch.save({"actor.mu.weight": torch.randn(3, 4)}, weights, _use_new_zipfile_serialization=False)
    path = tmp_path / "agent.zip"
    rng = np.random.default_rng(0)
    for _ in range(60):
        body = bytearray(weights.getvalue())
        if method == zipfile.ZIP_STORED:  # damage to the weights themselves
            body[int(rng.integers(len(body)))] ^= int(rng.integers(1, 256))
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr("data", "{}")
            archive.writestr("policy.pth", bytes(body))
        if method != zipfile.ZIP_STORED:  # or to their compressed bytes
            data = bytearray(path.read_bytes())
            data[int(rng.integers(60, len(data) - 200))] ^= int(rng.integers(1, 256))
            path.write_bytes(data)
        with pytest.raises(OffbenchError, match=r"agent\.zip"):
            read_sb3_zip(path, -np.ones(3, np.float32), np.ones(3, np.float32), "X-v0")


ABSTRACT = {"model_path": "inverted_pendulum.xml", "frame_skip": 2, "observation_space": None}
HUGE = "0x" + "F" * 5000  # TOML has no limit for it, Python prints no number of 5,000 digits
DEEP = ".a" * 1000


@pytest.mark.parametrize("line", [f"env_kwargs = {HUGE}", f"sac = {HUGE}", f"env_kwargs{DEEP} = 1", f"name = {HUGE}"])
def test_a_value_of_a_recipe_that_cannot_be_printed(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("r.toml").write_text(f'env_id = "InvertedPendulum-v5"\n{line}\n')
    assert "r.toml: " in refusal(["collect", "./r.toml"], capsys)


@pytest.mark.parametrize(
    "line",
    [f"seeds = {HUGE}", f"seeds = [{HUGE}]", f"seeds{DEEP} = 1", f"datasets = [{HUGE}]", f"steps = {HUGE}"],
)
@pytest.mark.parametrize("where", ["grid", "algorithm"])
def test_a_value_of_a_grid_that_cannot_be_printed(line: str, where: str, capsys: pytest.CaptureFixture[str]) -> None:
    datasets = "" if where == "grid" and line.startswith("datasets") else 'datasets = ["hopper-medium-v0"]\n'
    above, below = (line, "") if where == "grid" else ("", line)
    Path("g.toml").write_text(f'{datasets}{above}\n[[algorithms]]\nname = "bc"\n{below}\n')
    assert "g.toml: " in refusal(["benchmark", "./g.toml"], capsys)


@pytest.mark.parametrize("name", ["~nobody-has-this-name/x.py", "x\\u0000.py"])
def test_an_algorithm_file_that_cannot_be(name: str, medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("g.toml").write_text(f'datasets = ["{medium}"]\n[[algorithms]]\nname = "{name}"\n')
    assert "no algorithm file" in refusal(["benchmark", "./g.toml"], capsys)


def test_no_home_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(OffbenchError, match="set HOME or OFFBENCH_CACHE"):
        home_folder("OFFBENCH_CACHE")
    monkeypatch.delenv("MINARI_DATASETS_PATH")
    assert "set HOME or MINARI_DATASETS_PATH" in refusal(["list", "datasets"], capsys)


def test_an_output_that_is_no_file(medium: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo("fifo.npz")
    for name in ("fifo.npz", ".", "/dev/null", "", "minari"):
        with pytest.raises(OffbenchError, match="is not a file; choose another name"):
            output_file(name)
    refusal(["export", medium, "--out", "fifo.npz"], capsys)
    refusal(["card", medium, "--huggingface", "--out", "."], capsys)
    assert Path("fifo.npz").is_fifo()


def test_a_socket_is_no_file(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("s")  # below the current folder: its path may have 100 bytes
        with pytest.raises(OSError, match="is not a regular file"):
            open_regular("s")


def test_links_in_a_circle_are_listed_once(medium: str, home: Path) -> None:
    (home / "minari" / "d").mkdir()
    for name in "xyz":
        (home / "minari" / "d" / name).symlink_to(".")
    (home / "minari" / "up").symlink_to("..")
    began = time.monotonic()
    assert minari_store.local_ids() == [medium]
    assert time.monotonic() - began < 10


def test_seeds_without_number(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal(["train", "bc", "--dataset", medium, "--seeds", "0:1000000000000"], capsys)
    assert "more than 100,000 seeds" in line


def test_runs_are_in_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo("runs-fifo")
    assert "is not a folder of runs" in refusal(["list", "runs", "--runs", "runs-fifo"], capsys)


@pytest.mark.parametrize("redirection", ["2>&-", ">&- 2>&-", ""])
def test_an_argument_that_is_not_utf8(redirection: str, home: Path) -> None:
    command = f"exec '{sys.executable}' -m offbench import-d4rl $'\\xff' --id a-v0 {redirection}"
    assert subprocess.run(["bash", "-c", command], capture_output=True, check=False).returncode == 2


def test_ctrl_c_while_the_program_starts(home: Path) -> None:
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "class Stop:\n def find_spec(self, name, *_):\n  if name == 'offbench.cli.main': raise KeyboardInterrupt\n"
    code += "sys.meta_path.insert(0, Stop())\nfrom offbench.__main__ import main\nmain()"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, b"")


def test_a_completion_without_its_line(
    medium: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command runs, as without the variable."""
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    main(["list", "datasets"])
    assert medium in capsys.readouterr().out


def spec_of(**changes: Any) -> str:
    return json.dumps(json.loads(gym.spec("InvertedPendulum-v5").to_json()) | changes)


def wrapped(name: str, times: int, **kwargs: Any) -> list[dict[str, Any]]:
    return [{"name": name, "entry_point": f"gymnasium.wrappers.{name}", "kwargs": kwargs}] * times


@pytest.mark.parametrize("mode", ["human", "human_list", "rgb_array_list", "rgb_array", "nonsense", 3])
def test_no_render_mode_of_a_file_is_used(mode: object) -> None:
    env = make_env(spec_of(kwargs={"render_mode": mode}))
    env.reset(seed=0)
    assert env.render_mode is None
    env.close()


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"additional_wrappers": wrapped("stateful_action:RepeatAction", 3, num_repeats=100)}, "1,000,000"),
        ({"additional_wrappers": wrapped("stateful_observation:MaxAndSkipObservation", 4, skip=20)}, "160,000"),
        ({"additional_wrappers": wrapped("stateful_observation:FrameStackObservation", 2, stack_size=300)}, "90,000"),
        ({"entry_point": "gymnasium.envs.registration:Env"}, "not a class derived from"),
        ({"entry_point": "gymnasium:Env"}, "not among the environments"),
        ({"max_episode_steps": True}, "its time limit is True"),
        ({"max_episode_steps": 0}, "its time limit is 0"),
        (
            {"entry_point": "gymnasium.envs.mujoco.mujoco_env:MujocoEnv", "kwargs": ABSTRACT},
            "has no observation_space",
        ),
    ],
)
def test_an_environment_of_a_file_that_is_none_or_never_ends(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(OffbenchError, match=fault):
        untrusted_env(spec_of(**changes), "file")


@pytest.mark.parametrize(
    "change",
    [
        {"ref_min_score": 1e300},
        {"ref_max_score": True},
        {"description": "\ud800"},
        {"offbench": {"level": 5}},
        {"offbench": {"seed": "x"}},
        {"offbench": {"parts": 5}},
    ],
)
def test_damaged_metadata_of_a_d4rl_file_replace_no_dataset(change: dict[str, Any], medium: str) -> None:
    offbench.export(medium, "in.hdf5")
    with h5py.File("in.hdf5", "a") as file:
        about = json.loads(file.attrs["offbench"])
        about |= {key: about[key] | value if isinstance(value, dict) else value for key, value in change.items()}
        file.attrs["offbench"] = json.dumps(about)
    before = minari_store.read_metadata(medium)
    with pytest.raises(OffbenchError, match=r"in\.hdf5.*damaged"):
        offbench.import_d4rl("in.hdf5", medium, overwrite=True)
    assert minari_store.read_metadata(medium) == before


def test_odd_metadata_of_a_dataset_are_no_bug(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = minari_store.path_of(medium) / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["dataset_id"] = "\x1b[31mother"
    metadata["requirements"] = [f"mujoco>={'9' * 5000}"]
    nested: Any = "uniform"
    for _ in range(600):
        nested = [nested]
    metadata["offbench"]["parts"][0]["source"] = nested
    path.write_text(json.dumps(metadata))
    main(["show", medium])
    with pytest.raises(SystemExit) as stopped:
        main(["verify", medium])
    assert stopped.value.code == 1
    said = capsys.readouterr()
    assert "bug" not in said.err
    assert "\x1b" not in said.err + said.out
    assert f"verifying {medium}" in said.err


def test_a_huge_space_is_refused_at_once() -> None:
    with pytest.raises(OffbenchError, match="must be a"):
        box(gym.spaces.Discrete(10**12), "observations")
