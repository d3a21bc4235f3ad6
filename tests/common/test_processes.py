"""Worker processes end with their parent."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = """
import multiprocessing, os, sys, time
from offbench.common.processes import start_worker

def work(parent):
    if sys.argv[1] == "windows":
        os.getppid = lambda: parent  # as there, where it does not change
    start_worker(parent)
    print('working', flush=True)
    time.sleep(60)

if __name__ == "__main__":
    multiprocessing.get_context("spawn").Process(target=work, args=(os.getpid(),)).start()
    time.sleep(60)
"""


@pytest.mark.parametrize("system", ["linux", "windows"])
def test_a_worker_ends_when_its_parent_is_killed(system: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with subprocess.Popen([sys.executable, str(script), system], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout
        assert parent.stdout.readline() == "working\n"
        parent.kill()
        began = time.monotonic()
        parent.stdout.read()  # until the worker, which has the pipe too, ends
    assert time.monotonic() - began < 30
