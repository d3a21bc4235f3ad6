"""Policy files, agents' zips and ladders of others: damage is noticed, and nothing that they name is imported."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch

import offbench
from offbench.agents.sb3_zip import read_sb3_zip
from offbench.common.errors import OffbenchError
from offbench.common.files import sha256_of
from offbench.common.seeds import Purpose, generator
from offbench.rollouts.policy import MAX_CRITIC_VALUES, Policy, uniform_policy
from offbench.rollouts.rollouts import NOISE_BLOCK, EpisodeTask, _RunningEpisode


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


def test_a_module_that_a_policy_names_is_not_imported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "evil.py").write_text("open('PWNED', 'w')")
    monkeypatch.syspath_prepend(str(home))
    low, high = np.array([-3.0], np.float32), np.array([3.0], np.float32)
    policy = uniform_policy(low, high, 4, "evil:Evil-v0")
    policy.save(home / "evil.safetensors")
    with pytest.raises(offbench.OffbenchError, match=r"'evil:Evil-v0'.*--env"):
        offbench.evaluate("evil.safetensors", episodes=1)
    dataclasses.replace(policy, env_id="evil:InvertedPendulum-v5").save(home / "known.safetensors")
    offbench.evaluate("known.safetensors", episodes=1)  # registered, so that no module is needed
    assert "evil" not in sys.modules
    assert not (home / "PWNED").exists()
