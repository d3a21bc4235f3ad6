"""Shared set-up: every test has its own Minari folder and cache; one tiny behaviour agent serves them all."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import threadpoolctl
import torch

from offbench.training import registry

ROOT = Path(__file__).parent.parent

# pytest-xdist runs a process for each core, so each process computes with one thread
torch.set_num_threads(1)
threadpoolctl.threadpool_limits(1)

# A real training, as small as it can be: two seconds, and its expert beats chance.
TINY_RECIPE = """
name = "tiny"
env_id = "InvertedPendulum-v5"
dataset_steps = 600

[sac]
steps = 2400
segment = 400
learning_starts = 400
gradient_steps = 0.5
hidden = [16, 16]
batch_size = 64
learning_rate = 3e-3
rung_episodes = 4

[measure]
rung_episodes = 8
reference_episodes = 20
rungs = 4
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the slow tests, so that no core waits for a long one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture
def bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow bfloat16 on any processor; PyTorch emulates it, slowly, where users are refused it."""
    monkeypatch.setattr("offbench.training.devices.has_bfloat16", lambda: True)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A recipe file and a behaviour folder in which its agent is trained already."""
    from offbench.agents.behaviour import behaviour

    folder = tmp_path_factory.mktemp("tiny")
    recipe = folder / "tiny.toml"
    recipe.write_text(TINY_RECIPE)
    behaviour(str(recipe), behaviour_dir=folder / "behaviour", workers=1)
    return str(recipe), str(folder / "behaviour")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Datasets, cache and runs of one test, away from the user's own; what it imports and registers is forgotten."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("OFFBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_user_algorithms", {})
    monkeypatch.setenv(registry.USER_ALGORITHMS_VARIABLE, "{}")
    yield tmp_path
    forget_modules(tmp_path)


def forget_modules(folder: Path) -> None:
    """Let modules that were imported from a folder be imported anew."""
    for name, module in sys.modules.copy().items():
        about = getattr(module, "__dict__", {})  # a test may have put None in a module's place
        where = [about.get("__file__"), *(about.get("__path__") or ())]  # a folder has no file
        if any(str(path).startswith(str(folder)) for path in where):
            del sys.modules[name]


@pytest.fixture(scope="session")
def recorded_once(tiny: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari folder with a small dataset of the tiny recipe."""
    import offbench

    folder = tmp_path_factory.mktemp("recorded")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("OFFBENCH_CACHE", str(folder / "cache"))
        offbench.collect(tiny[0], "medium", behaviour_dir=tiny[1], workers=1)
    return folder / "minari"


@pytest.fixture
def medium(recorded_once: Path, home: Path) -> str:
    """The id of a copy of that dataset in the test's own Minari folder."""
    shutil.copytree(recorded_once, home / "minari", dirs_exist_ok=True)
    return "tiny-medium-v0"


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Let Ctrl-C and SIGHUP work where the tests run in the background of a shell or of nohup, which ignore them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGHUP, before[1])


@pytest.fixture
def offbench_cli(home: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command line in a process of its own."""

    def run(*words: str, **kwargs: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "offbench", *words]
        kwargs = {"capture_output": True, "text": True, "cwd": home, "env": dict(os.environ), "timeout": 300} | kwargs
        return subprocess.run(command, check=False, **kwargs)  # type: ignore[call-overload,no-any-return]

    return run


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator for test data."""
    return np.random.default_rng(20260101)
