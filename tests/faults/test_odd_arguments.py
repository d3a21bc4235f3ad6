"""Arguments, paths and values that cannot be: one line, exit code 2."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.files import home_folder, open_regular, output_file
from offbench.data import minari_store
from tests.commands import refusal
from tests.made_runs import small_run

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


def test_a_fifo_is_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It would be waited for without end."""
    for name in ("grid.toml", "recipe.toml", "policy.safetensors", "ppo.zip"):
        os.mkfifo(tmp_path / name)
    names = {"benchmark": "grid.toml", "collect": "recipe.toml", "evaluate": "policy.safetensors"}
    for words in (*names.items(), ("collect inverted-pendulum --name x --policy", "ppo.zip")):
        line = refusal([*words[0].split(), str(tmp_path / words[1])], capsys)
        assert words[1] in line
        assert "not a regular file" in line


@pytest.mark.parametrize("kind", ["fifo", "/dev/full", "/dev/zero", "folder"])
def test_a_report_is_not_written_over_what_is_no_file(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An older page is read, to see whether offbench wrote it; a device would never end."""
    small_run(tmp_path / "runs" / "seed-0")
    page = tmp_path / "report" / "index.html"
    page.parent.mkdir()
    if kind == "fifo":
        os.mkfifo(page)
    elif kind == "folder":
        page.mkdir()
    else:
        page.symlink_to(kind)
    line = refusal(["report", "--runs", str(tmp_path / "runs"), "--out", str(page.parent)], capsys)
    assert f"{page} is not a report of offbench" in line
    assert list(page.parent.iterdir()) == [page]


@pytest.mark.parametrize("flag", ["--hidden", "--batch-size", "--workers"])
def test_absurd_sizes_are_one_line(flag: str, medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "bc", "--dataset", medium, "--workers", "1", "--steps", "2", flag, str(10**18)])
    assert stop.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "not enough memory" in last or "workers must be a whole number from 1 to 1,000" in last
