"""Handed-over files whose hashes match: a ladder's replay, checkpoints, policies, a run's settings and losses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import save_file

import offbench
from offbench.analysis.normalize import render
from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.common.files import sha256_of
from offbench.common.seeds import Purpose, generator
from offbench.evaluation.similarity import similarity
from offbench.rollouts.policy import MAX_CRITIC_VALUES, Policy
from offbench.rollouts.rollouts import NOISE_BLOCK, EpisodeTask, _RunningEpisode
from offbench.training.run import Run
from tests.made_runs import made_run

SMALL: dict[str, Any] = {"eval_every": 50, "eval_episodes": 1, "workers": 1, "hidden": (8, 8), "batch_size": 16}


def replaced(file: h5py.File, name: str, **changes: Any) -> None:
    data = changes.pop("data", None)
    del file[name]
    if data is not None or changes:
        file.create_dataset(name, data=data, **changes)


def elsewhere(file: h5py.File) -> None:
    size = len(file["rewards"])
    np.arange(size, dtype=np.float32).tofile("secret.bin")
    replaced(file, "rewards", shape=(size,), dtype="f4", external=[("secret.bin", 0, 4 * size)])


def soft_link(file: h5py.File) -> None:
    del file["rewards"]
    file["rewards"] = h5py.SoftLink("/nowhere")


SPOILED: dict[str, Callable[[h5py.File], None]] = {
    "external storage": elsewhere,
    "a link": soft_link,
    "an external link": lambda f: f.__setitem__("more", h5py.ExternalLink("x.hdf5", "/")),
    "no actions": lambda f: replaced(f, "actions"),
    "short rewards": lambda f: replaced(f, "rewards", data=f["rewards"][:100]),
    "text": lambda f: replaced(f, "rewards", data=["x"] * len(f["rewards"])),
    "NaN actions": lambda f: replaced(f, "actions", data=np.full(f["actions"].shape, np.nan, np.float32)),
    "infinite rewards": lambda f: replaced(f, "rewards", data=np.full(f["rewards"].shape, np.inf, np.float32)),
    "wide actions": lambda f: replaced(f, "actions", data=np.zeros((len(f["actions"]), 5), np.float32)),
    "narrow observations": lambda f: replaced(f, "observations", data=f["observations"][:, :2]),
    "complex observations": lambda f: replaced(f, "observations", data=f["observations"][()].astype(complex)),
    "lengths as floats": lambda f: replaced(f, "lengths", data=f["lengths"][()].astype(float)),
    "one length": lambda f: replaced(f, "lengths", data=np.int64(3)),
    "negative lengths": lambda f: replaced(f, "lengths", data=-f["lengths"][()]),
    "huge lengths": lambda f: replaced(f, "lengths", data=f["lengths"][()] * 10**15),
    "no lengths": lambda f: replaced(f, "lengths", data=f["lengths"][()] * 0),
    "short ends": lambda f: replaced(f, "terminated", data=f["terminated"][:-1]),
    "a huge array": lambda f: replaced(f, "rewards", shape=(2**31,), dtype="f4", chunks=(2**20,), compression="gzip"),
}


@pytest.mark.parametrize("fault", SPOILED)
def test_a_damaged_replay_of_a_ladder_is_not_recorded(fault: str, tiny: tuple[str, str], home: Path) -> None:
    shutil.copytree(tiny[1], home / "behaviour")
    ladder = home / "behaviour" / "tiny" / "seed-0" / "ladder"
    with h5py.File(ladder / "medium-replay.hdf5", "a") as file:
        SPOILED[fault](file)
    info = json.loads((ladder / "ladder.json").read_text())
    info["medium_replay"]["sha256"] = sha256_of(ladder / "medium-replay.hdf5")
    (ladder / "ladder.json").write_text(json.dumps(info))
    with pytest.raises(OffbenchError, match=r"medium-replay\.hdf5 is damaged .*build the ladder again"):
        offbench.collect(tiny[0], "medium-replay", behaviour_dir=home / "behaviour", workers=1)


def forge(path: Path, **changes: object) -> None:
    """Change a checkpoint's state, with a hash that matches."""
    with safe_open(path, framework="pt") as file:
        state = json.loads(file.metadata()["offbench"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del state["sha256"]
    state |= changes
    state["sha256"] = checkpoints._sha256(tensors, state)
    save_file(tensors, path, {"offbench": json.dumps(state)})


@pytest.mark.parametrize(
    "change",
    [
        *({"origin": value} for value in ([], "text", [["a", "b"]], 5)),
        *({"unlogged": value} for value in (5, "abc", [1], [["a", 1]], {"a": 1}, None, [["a", "x", 1]])),
        *({"unlogged": [["q_abs", *value]]} for value in ((1.0, "x"), ([], 2), (1.0, 0), (1.0, True))),
    ],
)
def test_a_forged_state_of_a_checkpoint_is_damage(
    change: dict[str, Any], medium: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=100, **SMALL)
    before = (folder / "evaluations.csv").read_bytes()
    forge(checkpoints.path_of(folder, 100), **change)
    offbench.train("td3_bc", medium, steps=150, **SMALL)  # from the checkpoint before it
    assert "checkpoint-000000100.safetensors is damaged" in capsys.readouterr().err
    assert (folder / "evaluations.csv").read_bytes().startswith(before)


def test_settings_that_are_not_the_checkpoints_make_no_network(medium: str) -> None:
    (folder,) = offbench.train("td3_bc", medium, steps=50, **SMALL)
    path = Run(folder).config_path
    config = json.loads(path.read_text())
    config["settings"]["hidden"] = [200_000, 200_000]  # 300 GB
    path.write_text(json.dumps(config))
    with pytest.raises(OffbenchError, match=r"its hidden is \[8, 8\], not \[200000, 200000\]"):
        similarity(folder)


def test_a_beta_of_several_lines_is_one_line(home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    config = json.loads(run.config_path.read_text())
    config["settings"]["beta"] = "x\n| forged | 99.9 |" + "y" * 10**5
    run.config_path.write_text(json.dumps(config))
    lines = render(offbench.normalize(home / "runs")).splitlines()
    assert not [line for line in lines if line.startswith("| forged")]
    assert max(map(len, lines)) < 400


@pytest.mark.parametrize("values", [(1e308, -1e308), (1e308, 1e308), (1e16, 1.0)])
def test_losses_of_any_size_are_drawn(values: tuple[float, float], home: Path) -> None:
    run = made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    run.write_losses([{"step": 1000.0 * (i + 1), "q_abs": value} for i, value in enumerate(values)])
    assert offbench.report(home / "runs", home / "out").exists()


def best_by_q(samples: int, width: int) -> Policy:
    """A policy of zeros for InvertedPendulum: 4 observations, 1 action."""
    actor = ((np.zeros((4, 2), np.float32), np.zeros(2, np.float32)),)
    critic = ((np.zeros((5, width), np.float32), np.zeros(width, np.float32)),)
    critic += ((np.zeros((width, 1), np.float32), np.zeros(1, np.float32)),)
    zeros, ones = np.zeros(4, np.float32), np.ones(1, np.float32)
    name = "InvertedPendulum-v5"
    return Policy("best_by_q", actor, zeros, zeros + 1, -ones, ones, name, critic=critic, samples=samples)


@pytest.mark.parametrize("samples", [1, 100, 5000])
def test_noise_is_drawn_in_blocks_that_change_no_number(samples: int) -> None:
    policy, task = best_by_q(samples, 8), EpisodeTask("", b"", 0, (), (0,), False)
    with gym.make(policy.env_id) as env:
        lane = _RunningEpisode(env, policy, task, 0)
        rows = []
        for _ in range(30):
            rows.append(lane.next_noise())
            lane.actions.append(np.zeros(1))
    expected = policy.draw(generator(0, Purpose.ACTION, 0), 30)
    assert np.array_equal(rows, expected)
    assert len(lane.noise) * samples <= max(NOISE_BLOCK, samples)


def test_a_policy_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    best_by_q(100, 256).save(tmp_path / "small.safetensors")
    offbench.load_policy(tmp_path / "small.safetensors")
    path = tmp_path / "large.safetensors"
    best_by_q(10_000, MAX_CRITIC_VALUES // 10_000 + 1).save(path)
    with pytest.raises(OffbenchError, match="would fill the memory"):
        offbench.load_policy(path)
