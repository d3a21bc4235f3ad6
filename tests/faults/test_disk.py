"""A disk that is full, read-only or refuses: one clear line, and what was there before is as it was."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.cli.main import main
from offbench.data import minari_store
from offbench.data.export import export
from offbench.training.run import Run
from tests.commands import refusal
from tests.faults.test_kill import facts, whole
from tests.made_runs import made_run

SMALL = ["--steps", "40", "--eval-every", "20", "--eval-episodes", "1", "--hidden", "8,8", "--batch-size", "8"]


@pytest.fixture
def small_disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A file system of its own of 700 kB, where this process may mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=700k", "tmpfs", str(place)]
    done = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("mount") else None
    if done is None or done.returncode:
        pytest.skip("needs the right to mount a small tmpfs; test_every_write_in_turn covers the same promises")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.fixture
def no_look_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recording begin although it will not fit, as when another program fills the disk meanwhile."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: type("Usage", (), {"free": 10**12})())


def state(folder: Path) -> dict[str, bytes]:
    """Return every visible file below a folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in files if not any(x.startswith(".") for x in p.parts)}


@pytest.mark.usefixtures("no_look_ahead")
def test_a_full_disk_while_recording(
    tiny: tuple[str, str], small_disk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """HDF5 itself meets the end of the disk; the old dataset of that id stays, and room makes it work again."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(small_disk))
    words = ["collect", tiny[0], "--behaviour-dir", tiny[1], "--workers", "1"]
    main([*words, "--steps", "100"])
    right = whole("tiny-medium-v0")
    line = refusal([*words, "--steps", "20000", "--overwrite"], capsys)
    assert "No space left on device" in line
    assert minari_store.local_ids() == ["tiny-medium-v0"]
    assert whole("tiny-medium-v0") == right
    assert [p.name for p in small_disk.iterdir() if not p.name.endswith(".lock")] == ["tiny-medium-v0"]
    main([*words, "--steps", "120", "--overwrite"])
    assert minari_store.read_metadata("tiny-medium-v0")["total_steps"] == 120


def test_a_full_disk_while_training(
    medium: str, small_disk: Path, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last checkpoint stays, and the same command goes on once there is room."""
    words = ["train", "td3_bc", "--dataset", medium, *SMALL, "--workers", "1"]
    main([*words, "--runs", str(home / "undisturbed")])
    (run,) = offbench.training.run.find_runs(home / "undisturbed")
    runs = small_disk / "runs"
    main(
        [
            "train",
            "td3_bc",
            "--dataset",
            medium,
            *["20" if word == "40" else word for word in SMALL],
            "--runs",
            str(runs),
        ]
    )
    filler = small_disk / "filler"
    with open(filler, "wb") as file:
        left = shutil.disk_usage(small_disk).free - 8192
        file.write(b"x" * max(0, left))
    before = state(runs)
    line = refusal([*words, "--runs", str(runs)], capsys)
    assert "No space left on device" in line
    kept = [name for name in before if "checkpoint" in name]
    assert kept
    assert {name: state(runs)[name] for name in kept} == {name: before[name] for name in kept}
    filler.unlink()
    main([*words, "--runs", str(runs)])
    (again,) = offbench.training.run.find_runs(runs)
    for name in ("evaluations.csv", "policy.safetensors", "checkpoint-000000040.safetensors"):
        assert (again.folder / name).read_bytes() == (run.folder / name).read_bytes()


def test_a_read_only_disk(
    tiny: tuple[str, str],
    medium: str,
    small_disk: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(minari_store.path_of(medium), small_disk / medium)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    cache = os.environ["OFFBENCH_CACHE"]
    for words in (
        ["train", "td3_bc", "--dataset", medium, *SMALL, "--runs", str(small_disk / "runs")],
        ["export", medium, "--out", str(small_disk / "out.hdf5")],
        ["show", medium, "--plot", str(small_disk / "out.png")],
    ):
        assert "cannot write" in refusal(words, capsys)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(small_disk))
    line = refusal(["collect", tiny[0], "--behaviour-dir", tiny[1], "--id", "new-v0"], capsys)
    assert "Read-only file system" in line
    offbench.load(medium)  # reading needs no writing but the cache's
    monkeypatch.setenv("OFFBENCH_CACHE", str(small_disk / "cache"))
    assert "cannot write" in refusal(["show", medium], capsys)
    assert Path(cache).exists()


@contextmanager
def without(rights: int, *folders: Path) -> Iterator[None]:
    """Take these rights from folders and all that is in them."""
    paths = [path for folder in folders for path in (folder, *folder.rglob("*"))]
    before = {path: path.stat().st_mode for path in paths}
    for path in reversed(paths):
        path.chmod(before[path] & ~rights)
    try:
        yield
    finally:
        for path in paths:
            path.chmod(before[path])


@pytest.mark.slow
def test_folders_without_the_right_to_write_or_read(home: Path) -> None:
    """As those of another user. Root may do everything, so its commands run without that capability here."""
    capable = (
        ["setpriv", "--bounding-set=-dac_override,-dac_read_search", "--inh-caps=-all"] if not os.geteuid() else []
    )
    if capable and subprocess.run([*capable, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs setpriv, or a user other than root")

    def run(*words: str) -> tuple[int, str, str]:
        command = [*capable, sys.executable, "-m", "offbench", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "Traceback" not in done.stderr
        return done.returncode, done.stdout, done.stderr.splitlines()[-1] if done.stderr else ""

    name = offbench.collect("inverted-pendulum", "random", steps=300, workers=1)
    train = ["train", "td3_bc", "--dataset", name, "--workers", "1", *SMALL]
    main(train)
    (first,) = (run.folder for run in offbench.training.run.find_runs(home / "runs"))
    made_run(home / "runs", name, "cql", "default", 0, 50)
    minari, cache, runs = home / "minari", home / "cache", home / "runs"
    before = state(home)
    with without(0o222, minari, cache, runs):
        for words in (["show", name], ["normalize"], ["evaluate", str(first), "--episodes", "1"], train):
            assert run(*words)[0] == 0
        for words in (
            ["evaluate", str(first), "--similarity"],
            [*train, "--steps", "60"],
            ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--id", "new-v0"],
        ):
            code, _, line = run(*words)
            assert (code, "Permission denied; check its permissions or choose" in line) == (2, True), line
    with without(0o777, cache):
        code, _, line = run("show", name)
        assert (code, "Permission denied" in line) == (2, True)
    with without(0o777, minari):
        for words in (["train", "bc", "--dataset", name], ["export", name, "--out", "out.npz"]):
            code, _, line = run(*words)
            assert (code, f"cannot read {minari / name}" in line, "check its permissions" in line) == (2, True, True)
    for folder in (minari, minari / name, minari / name / "data"):
        with without(0o777, folder):
            code, _, line = run("list", "datasets")
            assert (code, f"warning: left out: cannot read {folder}: Permission denied" in line) == (0, True), line
    for folder in (first, first.parents[1]):  # one run, and all of an algorithm
        with without(0o777, folder):
            code, table, line = run("normalize")
            assert (code, "cql" in table, "td3_bc" in table) == (0, True, False)
            assert f"warning: left out: cannot read {folder.relative_to(home)}: Permission denied" in line
    with without(0o777, runs):
        for command in ("normalize", "report", "compare cql td3_bc"):
            code, _, line = run(*command.split())
            assert (code, "cannot read runs: Permission denied; check its permissions" in line) == (2, True), line
    assert state(home) == before


def limited(size: int) -> Callable[[], None]:
    """Let no file of this process grow beyond `size` bytes: writes fail in the system itself, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("work", ["collect", "import", "export", "npz"])
def test_a_file_that_cannot_grow(
    work: str, tiny: tuple[str, str], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wherever the file stops growing, by whichever library: one line, and the old state."""
    recipe, behaviour = tiny
    name = offbench.collect(recipe, "medium", behaviour_dir=behaviour, workers=1, steps=6000)
    export(name, home / "in.hdf5")
    for ending in ("hdf5", "npz"):
        (home / f"out.{ending}").write_text("old")
    collect = f"collect {recipe} --behaviour-dir {behaviour} --workers 1 --steps 6000 --seed 1 --overwrite"
    words = {
        "collect": collect.split(),
        "import": ["import-d4rl", str(home / "in.hdf5"), "--id", name, "--overwrite"],
        "export": ["export", name, "--out", str(home / "out.hdf5")],
        "npz": ["export", name, "--out", str(home / "out.npz")],
    }[work]
    right, known = whole(name), facts(name)
    capsys.readouterr()
    for size in (0, 1, 100, 1_000, 5_000, 50_000, 200_000):
        restore = limited(size)
        try:
            line = refusal(words, capsys)
        finally:
            restore()
        assert "File too large" in line or "cannot write" in line, (size, line)
        assert (whole(name), facts(name)) == (right, known), size
        assert {path.read_text() for path in home.glob("out.*")} == {"old"}, size
        assert not list(home.glob(".out*")), size
        assert [p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")] == [name], size


def test_a_report_is_replaced_whole_or_not_at_all(home: Path) -> None:
    """The page is the largest file: the tables and figures fit on the disk, and it does not."""
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    page = offbench.report("runs", "report", title="old")
    before = state(home)
    assert any(name.endswith("scores.csv") for name in before)
    made_run(home / "runs", "hopper-medium-v0", "bc", "default", 0, 20)
    restore = limited(page.stat().st_size - 1000)
    try:
        with pytest.raises(offbench.OffbenchError, match=r"cannot write report/index.html: File too large"):
            offbench.report("runs", "report", title="new")
    finally:
        restore()
    assert {name: data for name, data in state(home).items() if name.startswith("report")} == {
        name: data for name, data in before.items() if name.startswith("report")
    }
    assert not list((home / "report").rglob(".*"))


def test_every_write_in_turn(medium: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The n-th write of a training fails, for every n: an error, sound files, and the same command ends as if not."""
    words = ["train", "td3_bc", "--dataset", medium, *SMALL, "--workers", "1"]
    offbench.load(medium)
    main([*words, "--runs", "undisturbed"])
    (right,) = offbench.training.run.find_runs(home / "undisturbed")
    names = ("evaluations.csv", "losses.csv", "policy.safetensors", "checkpoint-000000040.safetensors")
    wanted = {name: (right.folder / name).read_bytes() for name in names}
    real, count, failing = os.replace, [0], [0]

    def replace(*arguments: Any, **options: Any) -> None:
        count[0] += 1
        if count[0] == failing[0]:
            raise OSError(28, "No space left on device")
        real(*arguments, **options)

    monkeypatch.setattr("offbench.common.files.os.replace", replace)
    refused = 0
    for failing[0] in range(1, 100):
        count[0] = 0
        runs = f"runs-{failing[0]}"
        try:
            main([*words, "--runs", runs])
            break
        except SystemExit as stopped:
            refused += stopped.code == 2
        failing_now, failing[0] = failing[0], 0
        for run in offbench.training.run.find_runs(home / runs):
            sound(run)
        main([*words, "--runs", runs])
        failing[0] = failing_now
        (run,) = offbench.training.run.find_runs(home / runs)
        assert {name: (run.folder / name).read_bytes() for name in names} == wanted
    assert refused >= 8  # config, and at each of two checkpoints evaluations, losses, policy and the checkpoint


def sound(run: Run) -> None:
    run.config()
    run.evaluations()
    run.losses()
    assert not [path for path in run.folder.iterdir() if path.name.endswith(".tmp")]


def test_an_id_that_is_a_link_does_not_lead_out(
    tiny: tuple[str, str], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Replacing a link replaces the link, never what it leads to; a namespace that leads out is refused."""
    outside = home / "outside"
    (outside / "data").mkdir(parents=True)
    (outside / "data" / "thesis.tex").write_text("years of work")
    minari_store.root().mkdir(parents=True)
    (minari_store.root() / "tiny-medium-v0").symlink_to(outside)
    (minari_store.root() / "space").symlink_to(outside)
    words = ["collect", tiny[0], "--behaviour-dir", tiny[1], "--workers", "1", "--steps", "100"]
    assert "leads out of" in refusal([*words, "--id", "space/x-v0"], capsys)
    main([*words, "--overwrite"])
    assert not (minari_store.root() / "tiny-medium-v0").is_symlink()
    assert state(outside) == {"data/thesis.tex": b"years of work"}
    names = {path.name for path in minari_store.root().iterdir() if not path.name.endswith(".lock")}
    assert names == {"tiny-medium-v0", "space"}
