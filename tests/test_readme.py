"""Every command and every Python block of the README runs, in its order, with no other set-up.

A training of a million updates is stopped with Ctrl-C after its first checkpoint, as the README says one may.
`make demo` and `make test` are run by CI itself, and the installation by test_packaging.py.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
ELSEWHERE = ("make demo", "make test", "pip install -c constraints.txt .")


def blocks(text: str) -> list[tuple[str, str]]:
    """Return (language, content) of every fenced block."""
    return re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL)


def run_and_stop(command: list[str], home: Path) -> None:
    """Start a long training, stop it with Ctrl-C once it has been evaluated, and check what it says."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 900
    while process.poll() is None and time.monotonic() < deadline:
        if any(len(path.read_text().splitlines()) > 1 for path in home.glob("runs/hopper*/**/evaluations.csv")):
            break
        time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "the same command goes on" in errors


@pytest.mark.slow
def test_every_block_of_the_readme_runs(home: Path) -> None:
    environment = dict(os.environ) | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    ran = 0
    for language, content in blocks(README):
        if language == "python":
            (home / "script.py").write_text(content)  # as a user would run it: a plain script
            subprocess.run([sys.executable, "script.py"], check=True, cwd=home, env=environment)
            continue
        for line in content.strip().splitlines():
            if line in ELSEWHERE:
                continue
            command = [sys.executable, "-m", *shlex.split(line)]
            if command[3] == "train" and "--steps" not in command:
                run_and_stop(command, home)
            else:
                done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True)
                assert done.returncode == 0, f"{line}\n{done.stderr}"
            ran += 1
    assert ran > 10


def test_ci_calls_the_readmes_two_commands() -> None:
    ci = (ROOT / ".ci" / "run").read_text().splitlines()
    assert {"make demo", "make test"} <= set(ci)
    assert ("sh", "make demo\nmake test\n") in blocks(README)
