"""kill -9 at random moments: nothing half-written is ever seen, and the same command ends as if undisturbed."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import offbench
from offbench.analysis.normalize import score_runs
from offbench.common import checkpoints
from offbench.data import minari_store
from offbench.data.content_hash import ContentHash
from offbench.data.export import export
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.rollouts.policy import read_policy_file
from offbench.training.run import Run, find_runs
from tests.conftest import ROOT

KILLS = {"collect": 60, "overwrite": 40, "import": 20, "train": 100}  # at least 200 over collect and train
NEW = int(os.environ.get("OFFBENCH_KILLS", "0"))  # as many in all, at other moments every time
if NEW:
    KILLS = {kind: -(-NEW * count // sum(KILLS.values())) for kind, count in KILLS.items()}
PARTS = {kind: max(1, count // 50) if NEW else 1 for kind, count in KILLS.items()}  # a test each, for `make nightly`
RUN = ["--steps", "160", "--eval-every", "40", "--eval-episodes", "1", "--hidden", "16,16", "--batch-size", "16"]


class Warm:
    """Runs commands in forks of a warmed-up process."""

    def __init__(self) -> None:
        environment = dict(os.environ) | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.warm"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=ROOT,
        )

    def run(self, words: list[str], folder: Path, kill_after: float | None = None) -> dict[str, Any]:
        """Run one command in `folder`, with datasets and cache below it; kill it after so many seconds."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        environment = {"MINARI_DATASETS_PATH": str(folder / "minari"), "OFFBENCH_CACHE": str(folder / "cache")}
        command = {"words": words, "environment": environment, "folder": str(folder), "kill_after": kill_after}
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        assert "Traceback" not in answer["stderr"], answer["stderr"]
        return answer

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        assert self.process.wait(timeout=60) == 0
        self.process.stdout.close()


@pytest.fixture
def warm() -> Iterator[Warm]:
    process = Warm()
    yield process
    process.close()


def whole(name: str) -> str:
    """Read a visible dataset to its end; return its content hash, which is the recorded one."""
    content = ContentHash()
    for e in episodes_of(open_minari(name)):
        content.add(e.observations, e.actions, e.rewards, e.terminations, e.truncations)
    assert content.hexdigest() == minari_store.read_provenance(minari_store.read_metadata(name)).content_sha256
    return content.hexdigest()


def facts(name: str) -> dict[str, Any]:
    return {key: value for key, value in minari_store.read_metadata(name).items() if key != "dataset_size"}


Check = Callable[[Path], object]
Record = Callable[[str, object], None]


def trials(
    warm: Warm,
    words: list[str],
    kind: str,
    home: Path,
    patch: pytest.MonkeyPatch,
    prepare: Check,
    look: Check,
    record_property: Record,
) -> None:
    """Kill a command at moments spread over its whole duration until it was killed often enough.

    For each trial: `prepare` its folder (datasets and cache are below it), run and kill, `look` at what is there.
    """
    rng = np.random.default_rng(None if NEW else len(kind))
    wanted = -(-KILLS[kind] // PARTS[kind])
    kills, trial, seconds = 0, 0, 0.0
    while kills < wanted:
        trial += 1
        assert trial < 4 * wanted + 10, "the command is too short to be killed"
        folder = home / f"{kind}-{trial}"
        folder.mkdir()
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("OFFBENCH_CACHE", str(folder / "cache"))
        prepare(folder)
        if not seconds:  # how long it takes, undisturbed
            answer = warm.run(words, folder)
            assert answer["status"] == 0, answer["stderr"]
            seconds = answer["seconds"]
        else:
            kills += warm.run(words, folder, rng.uniform(0, seconds))["status"] == -9
        look(folder)
        shutil.rmtree(folder)
    record_property("kills", kills)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "part"), [(kind, i) for kind in ("collect", "overwrite") for i in range(PARTS[kind])]
)
def test_collect_survives_kill_9(
    kind: str,
    part: int,
    tiny: tuple[str, str],
    home: Path,
    warm: Warm,
    monkeypatch: pytest.MonkeyPatch,
    record_property: Record,
) -> None:
    """A new id is absent or whole; one that is replaced is the old dataset or the new one. Then it is the new one."""
    words = ["collect", tiny[0], "--behaviour-dir", tiny[1], "--workers", "1", "--steps", "600"]
    name, again = "tiny-medium-v0", [*words, "--overwrite"]
    undisturbed = home / "undisturbed"
    undisturbed.mkdir()
    assert warm.run(words, undisturbed)["status"] == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(undisturbed / "minari"))
    right, known = whole(name), facts(name)
    old: list[str] = []

    def prepare(folder: Path) -> None:
        if kind == "overwrite":
            assert warm.run([*words[:-2], "--seed", "7"], folder)["status"] == 0
            old.append(whole(name))

    def look(folder: Path) -> None:
        seen = minari_store.local_ids()
        content = whole(name) if seen else None
        assert seen in ([], [name])
        assert content in (right, old[-1] if kind == "overwrite" else None)
        answer = warm.run(again if kind == "overwrite" else words, folder)
        assert answer["status"] == 0 or (content == right and "exists already" in answer["stderr"])
        assert whole(name) == right
        assert facts(name) == known
        assert [p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")] == [name]

    trials(warm, again if kind == "overwrite" else words, kind, home, monkeypatch, prepare, look, record_property)


KILLED_BETWEEN = """
import os, signal, sys
from pathlib import Path
from offbench.cli.main import main

replace = Path.replace
def kill_at_the_second(path, target):
    if path.name.endswith(".partial"):
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(path, target)
Path.replace = kill_at_the_second
main(sys.argv[1:])
"""


@pytest.mark.parametrize(
    "look", [minari_store.exists, lambda name: name in minari_store.local_ids()], ids=["id", "list"]
)
def test_killed_between_the_two_renames(look: Callable[[str], bool], medium: str, tiny: tuple[str, str]) -> None:
    """The old dataset is renamed already, the new one not yet: the next look puts the old one back."""
    old = whole(medium)
    words = ["collect", tiny[0], "--behaviour-dir", tiny[1], "--workers", "1", "--steps", "600", "--overwrite"]
    killed = subprocess.run([sys.executable, "-c", KILLED_BETWEEN, *words], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not minari_store.path_of(medium).exists()
    assert look(medium)
    assert whole(medium) == old
    assert [p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")] == [medium]


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS["import"]))
def test_import_survives_kill_9(
    part: int, medium: str, home: Path, warm: Warm, monkeypatch: pytest.MonkeyPatch, record_property: Record
) -> None:
    file, right = export(medium, home / "out.hdf5"), whole(medium)
    words = ["import-d4rl", str(file), "--id", "back-v0"]

    def look(folder: Path) -> None:
        seen = minari_store.local_ids()
        assert seen in ([], ["back-v0"])
        answer = warm.run(words, folder)
        assert answer["status"] == 0 or (seen and "exists already" in answer["stderr"])
        assert whole("back-v0") == right

    trials(warm, words, "import", home, monkeypatch, lambda _: None, look, record_property)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS["train"]))
def test_training_survives_kill_9_at_any_moment(
    part: int, medium: str, home: Path, warm: Warm, monkeypatch: pytest.MonkeyPatch, record_property: Record
) -> None:
    """Killed, then left alone: every file that counts has the undisturbed run's bytes."""
    words = ["train", "td3_bc", "--dataset", medium, *RUN]
    minari = home / "minari"
    undisturbed = home / "undisturbed"

    def prepare(folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        (folder / "minari").symlink_to(minari)

    prepare(undisturbed)
    assert warm.run(words, undisturbed)["status"] == 0
    (right,) = find_runs(undisturbed / "runs")
    names = ("evaluations.csv", "losses.csv", "policy.safetensors", "checkpoint-000000160.safetensors")
    wanted = {name: (right.folder / name).read_bytes() for name in names}
    last: list[int] = []

    def look(folder: Path) -> None:
        for run in find_runs(folder / "runs"):
            last.append(sound(run))
        assert warm.run(words, folder)["status"] == 0
        (run,) = find_runs(folder / "runs")
        assert {name: (run.folder / name).read_bytes() for name in names} == wanted
        assert run.config().dataset_sha256 == right.config().dataset_sha256

    trials(warm, words, "train", home, monkeypatch, prepare, look, record_property)
    assert KILLS["train"] < 50 or (0 in last and {40, 80, 120} & set(last))  # killed early and late


def sound(run: Run) -> int:
    """Check that every visible file of a killed run is whole; return its newest checkpoint's step."""
    run.config()
    run.evaluations()
    run.losses()
    if run.policy_path.exists():
        read_policy_file(run.policy_path)
    steps = checkpoints.steps(run.folder)
    assert all(checkpoints.load_checkpoint(run.folder, step) for step in steps)
    return max(steps, default=0)


@pytest.mark.slow
def test_two_recordings_of_one_id_at_the_same_time(tiny: tuple[str, str], home: Path) -> None:
    """Real processes, started together: one records, the other names it or finds the dataset there."""
    words = ["collect", tiny[0], "--behaviour-dir", tiny[1], "--workers", "1", "--steps", "30000"]
    command = [sys.executable, "-m", "offbench", *words]
    both = [subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) for _ in range(2)]
    said = {process.pid: process.communicate(timeout=300)[1] for process in both}
    assert sorted(process.returncode for process in both) == [0, 2]
    winner, loser = sorted(both, key=lambda process: process.returncode)
    assert f"is being recorded by process {winner.pid} on " in said[loser.pid] or "exists already" in said[loser.pid]
    whole("tiny-medium-v0")


def test_the_holder_of_an_id_is_named(medium: str, tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    import socket

    with minari_store.claimed("new-v0", False):
        command = [sys.executable, "-m", "offbench", "collect", tiny[0], "--id", "new-v0"]
        found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert f"new-v0 is being recorded by process {os.getpid()} on {socket.gethostname()}" in found.stderr
    assert offbench.show(medium).returns.size
    assert [p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")] == [medium]


@pytest.mark.slow
def test_a_grid_survives_five_kill_9(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed at random moments, recordings and trainings: the table is an undisturbed one's."""
    smoke = (ROOT / "offbench" / "grids" / "smoke.toml").read_text()
    (home / "grid.toml").write_text(smoke.replace("seeds = 2", "seeds = 1"))
    words = [sys.executable, "-m", "offbench", "benchmark", "./grid.toml", "--workers", "2", "--runs"]

    def table(folder: str) -> list[dict[str, Any]]:
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / folder / "minari"))
        return score_runs(home / folder / "runs")

    def start(folder: str) -> subprocess.Popen[bytes]:
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / folder / "minari"))
        return subprocess.Popen([*words, f"{folder}/runs"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    began = time.monotonic()
    assert start("whole").wait() == 0
    took, rng, kills, undisturbed = time.monotonic() - began, random.Random(0), 0, table("whole")
    while kills < 5:  # the fifth may come in a second grid
        shutil.rmtree(home / "killed", ignore_errors=True)
        done = False
        while not done:
            process = start("killed")
            try:
                done = process.wait(rng.uniform(0.15, 0.7) * took if kills < 5 else None) == 0
                assert done
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                kills += 1
                time.sleep(1.5)  # its workers notice within a second that it is gone
        assert json.dumps(table("killed")) == json.dumps(undisturbed)
