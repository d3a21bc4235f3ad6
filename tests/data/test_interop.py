"""Every block of docs/interop.md runs: with our own packages, and d3rlpy's in an environment of its own."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import offbench
from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.envs.recipes import recipes_folder
from offbench.evaluation.export_policy import export_policy
from offbench.rollouts.policy import Policy, read_policy_file, uniform_policy
from offbench.training.run import Run
from tests import beside_d3rlpy
from tests.conftest import ROOT

DOC = (ROOT / "docs" / "interop.md").read_text()
D3RLPY = "d3rlpy==2.8.1"


@pytest.fixture(scope="session")
def d3rlpy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The Python of an environment that has d3rlpy and, from ours, what it needs and we have already."""
    folder = tmp_path_factory.mktemp("d3rlpy")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    site = next(folder.glob("lib/python*/site-packages"))
    (site / "ours.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    python = str(folder / "bin" / "python")
    done = subprocess.run([python, "-m", "pip", "install", "-q", D3RLPY], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{D3RLPY} cannot be installed here: {done.stderr.strip().splitlines()[-1]}")
    return python


@pytest.mark.slow
def test_every_block_of_the_page_runs(d3rlpy: str, home: Path) -> None:
    environment = dict(os.environ) | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
    }
    ran = []
    for language, place, content in re.findall(r"```(\w+) ?(\w*)\n(.*?)```", DOC, re.DOTALL):
        commands = [[d3rlpy if place == "d3rlpy" else sys.executable, "-c", content]]
        if language == "sh":
            commands = [command_of(line) for line in content.strip().splitlines()]
        for command in commands:
            done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{content}\n{done.stdout}\n{done.stderr}"
            ran.append((place or language, done.stdout))
    assert sum(place == "d3rlpy" for place, _ in ran) == 2
    assert len(ran) > 12
    mapped = offbench.load("inverted-pendulum-medium-v0")
    timeouts = int(mapped.masks[mapped.ends - 1].sum())  # d3rlpy has no observation after these, as the page says
    steps = [int(out.strip().splitlines()[-1].split()[0]) for place, out in ran if place == "d3rlpy"]
    assert steps == 2 * [len(mapped) - timeouts]
    assert minari_store.read_provenance(minari_store.read_metadata("back-v0")).content_sha256 == mapped.content_sha256


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["td3_bc", "bear"])
def test_d3rlpys_weights_act_here_as_there(algorithm: str, d3rlpy: str, medium: str, tmp_path: Path) -> None:
    data = offbench.export(medium, tmp_path / "data.npz")
    words = [d3rlpy, beside_d3rlpy.__file__, "learn", algorithm, str(data), "0", str(tmp_path), "20", "10"]
    subprocess.run(words, check=True, capture_output=True)
    assert [name for name in ("10", "20") if (tmp_path / f"{name}.npz").exists()] == ["10", "20"]
    _, length = beside_d3rlpy.play(tmp_path / "20.npz", offbench.load(medium).env_id)
    assert length >= 1


def command_of(line: str) -> list[str]:
    """Return a line of the page as a command of this Python."""
    program, *words = shlex.split(line)
    return [sys.executable, "-m", program, *words] if program == "offbench" else [program, *words]


def test_minaris_command_line_shows_lists_and_combines(
    tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    from typer.testing import CliRunner

    names = [offbench.collect(tiny[0], level, behaviour_dir=tiny[1], workers=1) for level in ("medium", "expert")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari
        from minari.cli import app

        shown = CliRunner().invoke(app, ["show", names[0]])
        combined = CliRunner().invoke(app, ["combine", *names, "--dataset-id", "both-v0"])
        listed = CliRunner().invoke(app, ["list", "local"])
        assert shown.exit_code == combined.exit_code == 0, combined.output
        assert "InvertedPendulum-v5" in shown.output
        assert "tiny-medium" in shown.output
        assert "tiny-medium" in listed.output
        both = minari.load_dataset("both-v0")
        few = both.filter_episodes(lambda episode: len(episode) > 20)
    assert both.total_steps == 1200
    assert 0 < few.total_episodes < both.total_episodes
    assert len(offbench.load("both-v0")) == 1200
    report = offbench.verify("both-v0", workers=1)
    assert report.ok, report.lines()
    assert any("one step at a time" in line for line in report.checked)


# PyTorch would rather see torch.export, see offbench/evaluation/export_policy.py
old_format = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
OBSERVATIONS = np.random.default_rng(0).normal(scale=3, size=(500, 11))


def hopper_expert() -> Path:
    """The file of the shipped expert."""
    ladder = read_ladder(recipes_folder() / "hopper" / "behaviour")
    assert ladder is not None
    return ladder.folder / "policies" / ladder.role("expert").policy


def onnx_actions(path: Path, observations: Any) -> Any:
    """Act with onnxruntime."""
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    return runtime.InferenceSession(path).run(None, {"observations": observations})[0]


@old_format
@pytest.mark.parametrize("kind", ["td3_bc", "bc", "the shipped expert"])
def test_a_policy_as_torchscript_acts_the_same(kind: str, medium: str, home: Path) -> None:
    if kind == "the shipped expert":
        source = hopper_expert()
        policy = read_policy_file(source)
    else:
        settings: dict[str, Any] = {"hidden": (16, 16), "batch_size": 32, "eval_every": 50, "eval_episodes": 1}
        (source,) = offbench.train(kind, medium, steps=50, **settings)
        policy = read_policy_file(Run(source).policy_path)
    out = offbench.export_policy(source, home / "policy.pt")
    extra = {"offbench.json": ""}
    scripted = torch.jit.load(out, _extra_files=extra)
    observations = OBSERVATIONS[:, : len(policy.observation_mean)]
    ours, theirs = policy.act(observations, None), scripted(torch.from_numpy(observations))
    assert theirs.dtype == torch.float32
    np.testing.assert_allclose(theirs.numpy(), ours, atol=1e-6)
    np.testing.assert_allclose(scripted(torch.from_numpy(observations[:1]).float()).numpy(), ours[:1], atol=1e-5)
    assert json.loads(extra["offbench.json"])["env_id"] == policy.env_id
    onnx = offbench.export_policy(source, home / "policy.onnx")
    found = onnx_actions(onnx, observations)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, ours, rtol=0, atol=1e-6)
    code = "import sys, torch; torch.jit.load('policy.pt')(torch.zeros(1, 11)[:, :int(sys.argv[1])]); " + (
        "assert not any(name.startswith('offbench') for name in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(observations.shape[1])], check=True, cwd=home)


@old_format
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("kind", ["tanh", "squashed_gaussian", "gaussian"])
def test_every_kind_that_acts_by_itself(kind: str, activation: str, home: Path, rng: np.random.Generator) -> None:
    """Bounds that are not symmetric, an odd normalization, both activations."""
    sizes = [(5, 9), (9, 7), (7, 2 if kind == "tanh" else 4)]
    layers = tuple((rng.normal(size=s).astype(np.float32), rng.normal(size=s[1]).astype(np.float32)) for s in sizes)
    mean, std = rng.normal(size=5).astype(np.float32), rng.uniform(0.1, 3, 5).astype(np.float32)
    low, high = np.array([-3, 0], np.float32), np.array([-1, 7], np.float32)
    policy = Policy(kind, layers, mean, std, low, high, "X-v0", activation=activation)
    policy.save(home / "policy.safetensors")
    scripted = torch.jit.load(export_policy(home / "policy.safetensors", home / "policy.pt"))
    observations = OBSERVATIONS[:, :5]
    ours = policy.act(observations, None)
    assert len(np.unique(ours)) > 100  # not only the bounds
    exported = export_policy(home / "policy.safetensors", home / "policy.onnx")
    for found in (scripted(torch.from_numpy(observations)).numpy(), onnx_actions(exported, observations)):
        np.testing.assert_allclose(found, ours, rtol=0, atol=1e-6)
        assert (found >= low).all()
        assert (found <= high).all()
    import onnx

    (origin,) = onnx.load(exported).metadata_props
    assert json.loads(origin.value) == {"env_id": "X-v0", "kind": kind, "origin": {}}


@pytest.mark.parametrize(("kind", "reason"), [("uniform", "is random"), ("best_by_q", "chooses among random actions")])
def test_policies_that_act_by_chance_are_refused(kind: str, reason: str, home: Path) -> None:
    one, actor, critic = (np.ones(shape, np.float32) for shape in (1, (4, 2), (5, 1)))
    policy = replace(uniform_policy(-one, one, 4, "X-v0"), kind=kind)
    if kind == "best_by_q":
        policy = replace(policy, layers=((actor, actor[0]),), critic=((critic, one),), samples=3)
    policy.save(home / "random.safetensors")
    for name in ("policy.pt", "policy.onnx"):
        with pytest.raises(OffbenchError, match=reason):
            export_policy(home / "random.safetensors", home / name)
        assert not (home / name).exists()


def test_onnx_export_names_the_package_it_needs(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)  # importing it fails
    with pytest.raises(OffbenchError, match=r"pip install 'offbench\[onnx\]'"):
        export_policy(hopper_expert(), home / "policy.onnx")
    assert not (home / "policy.onnx").exists()
