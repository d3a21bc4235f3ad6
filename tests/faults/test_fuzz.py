"""Readers of files that others may have written: whatever is in them, an OffbenchError or an answer, and no pickle.

Each case takes a sound file and spoils it: bits flipped, pieces cut, doubled or put in, JSON values and table cells
replaced by odd ones. `CASES` of them for each reader in the slow run, a few in the fast one; the same ones every time,
so that what fails is what a change has broken. `OFFBENCH_FUZZ=100000` looks for new ones, that many for each reader.
"""

from __future__ import annotations

import contextlib
import csv
import datetime
import io
import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from offbench.agents.ladder import read_ladder
from offbench.analysis.normalize import render, score_runs
from offbench.benchmarks.plan import prepare
from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.import_d4rl import import_d4rl
from offbench.data.show import Summary
from offbench.data.transitions import Transitions
from offbench.envs.physics import warn_other_physics
from offbench.envs.recipes import load_recipe, read_recipe, recipes_folder
from offbench.rollouts.policy import Policy, read_policy_file
from offbench.training.run import Run
from tests.data.test_import_and_export import d4rl_file
from tests.faults.spoil import WOUNDS, spoiled_json, spoiled_tensors, spoiled_words, wounded

NEW = int(os.environ.get("OFFBENCH_FUZZ", "0"))
CASES = NEW or 10_000  # of each of the readers below, in the slow run
PARTS = max(1, NEW // 10_000)  # a test each, for `make nightly`
FEW = 40  # in the fast one
QUICK = datetime.timedelta(seconds=20)  # a case that takes longer hangs
LADDER = recipes_folder() / "inverted-pendulum" / "behaviour"


class Unpickled(BaseException):
    """Something is being unpickled. Not an Exception: readers turn all of those into a refusal."""


@pytest.fixture(autouse=True)
def no_unpickling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail wherever a reader turns to pickle, by whichever door."""

    def refuse(*_: object, **__: object) -> None:
        raise Unpickled

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(module, name, refuse)


# ---- sound files, and what reads them

Reader = Callable[[Path, bytes], object]


def recipe(folder: Path, data: bytes) -> object:
    (folder / "my.toml").write_bytes(data)
    found = read_recipe(folder / "my.toml", None)
    assert found.dataset_steps >= 1
    assert found.sac.cycle()[1] > 0
    return found.sha256()


def policy(folder: Path, data: bytes) -> object:
    (folder / "policy.safetensors").write_bytes(data)
    found = read_policy_file(folder / "policy.safetensors")
    observations = np.zeros((2, len(found.observation_mean)))
    noise = found.draw(np.random.default_rng(0), 2) if found.needs_noise(deterministic=True) else None
    actions = found.act(observations, noise)
    assert np.isfinite(actions).all()
    return actions


def checkpoint(folder: Path, data: bytes) -> object:
    path = folder / "checkpoint-000000100.safetensors"
    path.unlink(missing_ok=True)  # an earlier case's may still be mapped
    path.write_bytes(data)
    found = checkpoints.load_newest(folder)
    return None if found is None else {name: tensor.sum() for name, tensor in found[0].items()}


def metadata(folder: Path, data: bytes) -> object:
    path = minari_store.root() / "fuzzed-v0" / "data" / "metadata.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    found = minari_store.read_metadata("fuzzed-v0")
    empty: dict[str, Any] = dict.fromkeys(Transitions.__dataclass_fields__)
    flat = Transitions(**empty | {"dataset_id": "fuzzed-v0", "metadata": found})
    warn_other_physics("fuzzed-v0", minari_store.read_provenance(found).versions, load_recipe("hopper").env_spec())
    summary = Summary("fuzzed-v0", found, np.arange(4.0), np.arange(1, 5), 0.5)
    return flat.env_id, flat.references, summary.lines()


def ladder(folder: Path, data: bytes) -> object:
    shutil.copyfile(LADDER / "ladder.csv", folder / "ladder.csv")
    (folder / "ladder.json").write_bytes(data)
    return _climb(folder)


def rungs(folder: Path, data: bytes) -> object:
    shutil.copyfile(LADDER / "ladder.json", folder / "ladder.json")
    (folder / "ladder.csv").write_bytes(data)
    return _climb(folder)


def _climb(folder: Path) -> object:
    if not (folder / "policies").exists():
        shutil.copytree(LADDER / "policies", folder / "policies")
    found = read_ladder(folder)
    assert found is not None
    assert found.random_return < found.expert_return
    assert all(folder in (folder / "policies" / rung.policy).resolve().parents for rung in found.rungs)
    return found.nearest(0.5), found.fraction(found.role("medium")), found.role("expert")


def run_folder(folder: Path, **files: bytes) -> Run:
    """Return a run whose files are sound but for those given."""
    run = Run(folder / "runs" / "seed-0")
    run.folder.mkdir(parents=True, exist_ok=True)
    for name, content in SOUND_RUN.items():
        (run.folder / name).write_bytes(files.get(name.partition(".")[0], content))
    return run


def config(folder: Path, data: bytes) -> object:
    run_folder(folder, config=data)
    return [render(score_runs(folder), style) for style in ("table", "json")]


def evaluations(folder: Path, data: bytes) -> object:
    run_folder(folder, evaluations=data)
    rows = score_runs(folder)
    assert all(np.isfinite(row["return"]) for row in rows)
    return rows


def losses(folder: Path, data: bytes) -> object:
    return [row.get("step") for row in run_folder(folder, losses=data).losses()]


def _csv(header: list[str], rows: list[list[Any]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue().encode()


CONFIG = {
    "format": "offbench-run-1",
    "algorithm": "bdb",
    "variant": "beta=0.5",
    "settings": {"beta": 0.5},
    "seed": 0,
    "dataset": "hopper-medium-v0",
    "dataset_sha256": "ab" * 32,
    "steps": 1000,
    "env_id": "Hopper-v5",
    "references": {"dataset": [18.6, 3420.9], "d4rl": [-20.3, 3234.3]},
}
SOUND_RUN = {
    "config.json": json.dumps(CONFIG).encode(),
    "evaluations.csv": _csv(
        ["step", "episode", "return", "length"], [[s, e, 12.5 + e, 40] for s in (500, 1000) for e in (0, 1)]
    ),
    "losses.csv": _csv(["step", "critic_loss", "actor_loss"], [[500, 0.25, ""], [1000, 0.125, -3.5]]),
}
RECIPE = (
    b'name = "my-env"\nenv_id = "Hopper-v5"\nversion = 1\ndataset_steps = 5000\nd4rl_min = -20.3\nd4rl_max = 3234.3\n'
)
RECIPE += (
    b"[env_kwargs]\nframe_skip = 4\n[sac]\nsteps = 4000\nsegment = 400\nenvs = 4\nhidden = [16, 16]\ntau = 0.01\n"
)
RECIPE += (
    b"learning_starts = 100\ngradient_steps = 0.5\nlearning_rate = 1e-3\n[measure]\nrung_episodes = 8\nrungs = 4\n"
)


def _policy() -> bytes:
    rng = np.random.default_rng(0)
    sizes = [(4, 8), (8, 2)]
    layers = tuple((rng.normal(size=size).astype(np.float32), np.zeros(size[1], np.float32)) for size in sizes)
    zeros, ones = np.zeros(4, np.float32), np.ones(4, np.float32)
    bounds = -np.ones(1, np.float32), np.ones(1, np.float32)
    return Policy("squashed_gaussian", layers, zeros, ones, *bounds, "Hopper-v5", {"step": 5}).to_bytes()


def _checkpoint() -> bytes:
    from safetensors.torch import save

    tensors = {"actor.flat": torch.arange(20.0).reshape(1, 1, 20), "actor.step": torch.tensor(3)}
    folder = Path(__file__).parent  # never written to: the bytes are taken on their way
    taken: list[bytes] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints, "write_bytes", lambda _, data: taken.append(data))
        checkpoints.save_checkpoint(folder, 100, tensors, {"step": 100})
    assert taken[0] != save(tensors)
    return taken[0]


def _metadata() -> bytes:
    parts = [{"source": "medium", "transitions": 10, "return": 12.5, "interval": [11.0, 14.0], "episodes": 8}]
    found = {
        "total_episodes": 3,
        "total_steps": 10,
        "data_format": "hdf5",
        "dataset_id": "fuzzed-v0",
        "observation_space": '{"type": "Box", "dtype": "float64", "shape": [4], "low": [0], "high": [1]}',
        "env_spec": '{"id": "Hopper-v5", "kwargs": {}}',
        "eval_env_spec": '{"id": "Hopper-v5"}',
        "description": "x",
        "algorithm_name": "SAC",
        "ref_min_score": 1.5,
        "ref_max_score": 100,
        "offbench": {"seed": 0, "parts": parts, "versions": {"mujoco": "3.4.0"}, "content_sha256": "ab" * 32},
    }
    return json.dumps(found).encode()


def d4rl(folder: Path, data: bytes) -> object:
    path = folder / "hopper_medium-v2.hdf5"
    path.unlink(missing_ok=True)
    path.write_bytes(data)
    return import_d4rl(path, "fuzzed-v0", overwrite=True)


def _d4rl() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hopper.hdf5"
        d4rl_file(path, [(30, "terminal"), (20, "timeout")], 2, np.random.default_rng(0))
        return path.read_bytes()


GRID = b'datasets = ["hopper-medium-v0", {id = "x-v0", env = "hopper", level = "0.5", steps = 5}]\nseeds = [0, 2]\n'
GRID += b'steps = 5\neval_every = 5\n[[algorithms]]\nname = "bdb"\nbeta = [0.5, "adaptive"]\nsteps = 1_000\n'


def grid(folder: Path, data: bytes) -> object:
    path = folder / "grid.toml"
    path.write_bytes(data)
    return prepare(str(path), workers=1)


SOUND = {
    "recipe": RECIPE,
    "grid": GRID,
    "policy": _policy(),
    "checkpoint": _checkpoint(),
    "metadata": _metadata(),
    **{key: (LADDER / key).read_bytes() for key in ("ladder.json", "ladder.csv")},
    **SOUND_RUN,
    "d4rl.hdf5": _d4rl(),
}
READERS: dict[str, tuple[Reader, st.SearchStrategy[bytes]]] = {
    "recipe": (recipe, spoiled_words(SOUND["recipe"], " \n=[],")),
    "grid": (grid, spoiled_words(SOUND["grid"], " \n=[],")),
    "policy": (policy, spoiled_tensors(SOUND["policy"])),
    "checkpoint": (checkpoint, spoiled_tensors(SOUND["checkpoint"])),
    "metadata": (metadata, spoiled_json(SOUND["metadata"])),
    "ladder.json": (ladder, spoiled_json(SOUND["ladder.json"])),
    "ladder.csv": (rungs, spoiled_words(SOUND["ladder.csv"], ",\n")),
    "config.json": (config, spoiled_json(SOUND["config.json"])),
    "evaluations.csv": (evaluations, spoiled_words(SOUND["evaluations.csv"], ",\n")),
    "losses.csv": (losses, spoiled_words(SOUND["losses.csv"], ",\n")),
    "d4rl.hdf5": (d4rl, st.builds(wounded, st.just(SOUND["d4rl.hdf5"]), WOUNDS)),
}
SLOW_READERS = {"d4rl.hdf5": CASES // 5}  # libhdf5 takes its time


def fuzz(name: str, folder: Path, cases: int) -> tuple[int, int]:
    """Read `cases` spoiled files; return how many were read, and how many of those were refused."""
    read, spoiled = READERS[name]
    seen = [0, 0]

    @settings(
        max_examples=cases,
        deadline=QUICK,
        database=None,
        derandomize=not NEW,
        suppress_health_check=list(HealthCheck),
    )
    @given(spoiled)
    def case(data: bytes) -> None:
        seen[0] += 1
        try:
            found = read(folder, data)
        except OffbenchError:
            found = None
        seen[1] += found is None

    with contextlib.redirect_stderr(io.StringIO()):  # what is said of damaged checkpoints
        read(folder, SOUND[name])  # what is imported on the way is no case's time
        case()
    return seen[0], seen[1]


@pytest.mark.parametrize("name", READERS)
def test_a_sound_file_is_read(name: str, home: Path) -> None:
    assert READERS[name][0](home, SOUND[name]) is not None


@pytest.mark.parametrize("name", READERS)
def test_spoiled_files_give_an_error_or_an_answer(name: str, home: Path) -> None:
    cases, refused = fuzz(name, home, FEW)
    assert cases >= FEW
    assert refused


@pytest.mark.parametrize("field", ["observation_space", "action_space", "env_spec", "eval_env_spec"])
def test_a_bomb_inside_a_text_of_the_metadata(field: str, home: Path) -> None:
    """JSON within JSON: its nesting breaks Python's parser only when the inner text is read."""
    found = json.loads(_metadata()) | {field: "[" * 100_000}
    with contextlib.suppress(OffbenchError):  # refused where it is needed, "unknown" where it is only shown
        assert metadata(home, json.dumps(found).encode()) is not None


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("name", READERS)
def test_many_spoiled_files(name: str, part: int, home: Path, record_property: Callable[[str, object], None]) -> None:
    assert NEW or CASES * (len(READERS) - len(SLOW_READERS)) >= 100_000
    wanted = -(-SLOW_READERS.get(name, CASES) // PARTS)
    cases, refused = fuzz(name, home, wanted)
    record_property("files", cases)
    record_property("refused", refused)
    assert cases >= wanted
    assert refused


@pytest.mark.parametrize("name", ["policy", "checkpoint"])
def test_no_flipped_bit_is_another_number(name: str, home: Path) -> None:
    """Every bit of the file in turn: refused, or the same answer as before (a bit that nothing reads)."""
    read, data = READERS[name][0], _policy() if name == "policy" else _checkpoint()
    before, refused = read(home, data), 0
    with contextlib.redirect_stderr(io.StringIO()):
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            try:
                found = read(home, bytes(flipped))
            except OffbenchError:
                found = None
            if found is None:
                refused += 1
                continue
            assert str(found) == str(before), f"bit {bit}"
    assert refused > 4 * len(data)
