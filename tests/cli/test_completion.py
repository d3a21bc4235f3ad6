"""Completion: the shells source `offbench completion SHELL`; offbench answers what may come next."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from offbench.cli.main import BY_NAME, main
from offbench.training.registry import algorithm_names
from tests.made_runs import made_run

OFFERED = {  # line: what is offered at its end
    "offbench coll": ["collect"],
    "offbench collect hop": ["hopper"],
    "offbench collect hopper --level medium-": ["medium-replay", "medium-expert"],
    "offbench collect hopper --le": ["--level"],
    "offbench benchmark paper-": ["paper-small"],
    "offbench normalize --format l": ["latex"],
    "offbench train td3_bc --be": [],
    "offbench train bdb --be": ["--beta", "--beta-scope"],
    "offbench train bdb --beta ad": ["adaptive"],
    "offbench train bdb --dataset my": ["my-data-v0"],
    "offbench show mujoco/h": ["mujoco/hopper/medium-v0"],
    # the shell needs its own special characters escaped
    "offbench compare bdb": ["bdb\\ \\(beta=0.5\\)", "bdb\\ \\(beta=0.75\\)"],
}
# asks as argcomplete's bash function does: the answer is on fd 8; a fork for each line saves its imports
ASK = """
import os, sys, torch
from offbench.analysis import results
from offbench.cli.main import main

for number, line in enumerate(sys.argv[1:]):
    if os.fork() == 0:
        os.dup2(os.open(f"answer-{number}", os.O_WRONLY | os.O_CREAT), 8)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 9)
        os.environ |= {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        main([])
    os.wait()
"""


def test_what_is_offered(home: Path) -> None:
    for dataset in ("my-data-v0", "mujoco/hopper/medium-v0"):
        (home / "minari" / dataset / "data").mkdir(parents=True)
        (home / "minari" / dataset / "data" / "metadata.json").write_text("{}")
    for variant in ("beta=0.5", "beta=0.75"):
        made_run(home / "runs", "hopper-medium-v0", "bdb", variant, 0, 50)
    lines = ["offbench ", "offbench train ", *OFFERED]
    shell = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    command = [sys.executable, "-W", "ignore", "-c", ASK, *lines]
    done = subprocess.run(command, env=os.environ | shell, capture_output=True, text=True, cwd=home, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    commands, algorithms, *answers = ((home / f"answer-{i}").read_text().splitlines() for i in range(len(lines)))
    assert set(commands) >= set(BY_NAME)
    assert [word for word in algorithms if not word.startswith("-")] == algorithm_names()
    assert dict(zip(OFFERED, answers, strict=True)) == OFFERED


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_shells_accept_their_script(shell: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["completion", shell])
    script = capsys.readouterr().out
    assert "offbench" in script
    if not shutil.which(shell):
        pytest.skip(f"no {shell} here: its script was not tried")
    (home / "script").write_text(script)
    done = subprocess.run([shell, "-n", "script"], capture_output=True, text=True, cwd=home, check=False)
    assert (done.returncode, done.stderr) == (0, "")
