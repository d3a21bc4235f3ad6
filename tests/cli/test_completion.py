"""Completion: the shells source `offbench completion SHELL`; offbench answers what may come next."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from offbench.cli.main import BY_NAME
from offbench.training.registry import algorithm_names
from tests.made_runs import made_run

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def offered(home: Path) -> Callable[[str], list[str]]:
    """What is offered at the end of a line, as argcomplete's bash function asks for it: the answer is on fd 8."""

    def ask(line: str) -> list[str]:
        answer = home / "answer"
        asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line, "COMP_POINT": str(len(line))}
        command = f"{sys.executable} -m offbench 8>{answer} 9>/dev/null"
        done = subprocess.run(
            ["bash", "-c", command],
            env=os.environ | asked | {"_ARGCOMPLETE_SUPPRESS_SPACE": "1"},
            capture_output=True,
            text=True,
            cwd=home,
            check=False,
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        return answer.read_text().splitlines()

    return ask


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here")
def test_what_is_offered(offered: Callable[[str], list[str]], home: Path) -> None:
    assert set(offered("offbench ")) >= set(BY_NAME)
    assert offered("offbench coll") == ["collect"]
    assert offered("offbench collect hop") == ["hopper"]
    assert offered("offbench collect hopper --level medium-") == ["medium-replay", "medium-expert"]
    assert offered("offbench collect hopper --le") == ["--level"]
    assert [word for word in offered("offbench train ") if not word.startswith("-")] == algorithm_names()
    assert offered("offbench benchmark paper-") == ["paper-small"]
    assert offered("offbench normalize --format l") == ["latex"]
    assert "--beta" in offered("offbench train bdb --b")
    assert "--beta" not in offered("offbench train td3_bc --b")
    assert offered("offbench train bdb --beta ad") == ["adaptive"]
    for dataset in ("my-data-v0", "mujoco/hopper/medium-v0"):
        (home / "minari" / dataset / "data").mkdir(parents=True)
        (home / "minari" / dataset / "data" / "metadata.json").write_text("{}")
    assert offered("offbench train bdb --dataset my") == ["my-data-v0"]
    assert offered("offbench show mujoco/h") == ["mujoco/hopper/medium-v0"]
    for variant in ("beta=0.5", "beta=0.75"):
        made_run(home / "runs", "hopper-medium-v0", "bdb", variant, 0, 50)
    # the shell needs its own special characters escaped
    assert offered("offbench compare bdb") == ["bdb\\ \\(beta=0.5\\)", "bdb\\ \\(beta=0.75\\)"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_shells_accept_their_script(shell: str, offbench_cli: Cli, home: Path) -> None:
    script = offbench_cli("completion", shell).stdout
    assert "offbench" in script
    if not shutil.which(shell):
        pytest.skip(f"no {shell} here: its script was not tried")
    (home / "script").write_text(script)
    done = subprocess.run([shell, "-n", "script"], capture_output=True, text=True, cwd=home, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_shell_is_refused_in_one_line(offbench_cli: Cli) -> None:
    done = offbench_cli("completion", "tcsh")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "bash" in done.stderr
