"""Ways to run the command line."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from offbench.cli.main import main


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command line in this process; return its one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(words)
    out, err = capsys.readouterr()
    assert stopped.value.code == 2
    notices = ("converting ", "offbench: using the behaviour agent")
    said = [line for line in err.splitlines() if not line.startswith(notices)]
    lines = [line for line in said if not re.fullmatch(r"\S+ on \S+: resuming from step [\d,]+", line)]
    assert len(lines) == 1, err
    assert lines[0].startswith("offbench: ")
    assert "Traceback" not in out + err
    return lines[0]


def run_offbench(*words: str, before: str = "", **how: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own.

    Args:
        before: shell commands before it, such as `exec >/dev/full;`.
        how: environment variables.
    """
    command = f'{before} exec "$0" -m offbench "$@"'
    environment = os.environ | how
    return subprocess.run(
        ["sh", "-c", command, sys.executable, *words], env=environment, capture_output=True, text=True, check=False
    )
