"""A process that has imported everything and forks for each command: a start costs milliseconds, not seconds.

Reads one JSON line a command, {"words", "environment", "folder", "kill_after"}; answers with one JSON line,
{"status", "seconds", "stderr"}: the exit status, or -9 if the child was killed after `kill_after` seconds.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import minari  # noqa: F401
import torch._dynamo  # noqa: F401 (what the first optimiser would import)

import offbench.algos.td3_bc
import offbench.data.collect
import offbench.data.import_d4rl
import offbench.rollouts.rollouts
import offbench.training.train
import offbench.training.trainer
from offbench.cli.main import main
from offbench.envs.environments import env_spec


class HereRollouts(offbench.rollouts.rollouts.Rollouts):
    """Evaluations in the training process itself: 200 trainings need not start 200 worker processes.

    Trainings with their workers are killed in test_interrupts.py.
    """

    def __init__(self, spec: str, workers: int = 0) -> None:
        super().__init__(spec, 0)


def child(command: dict[str, Any]) -> NoReturn:
    """Run one command as the command line would, and exit with its status."""
    status = 1
    try:
        os.environ |= command["environment"]
        os.chdir(command["folder"])
        with open("stderr.txt", "w") as file:
            os.dup2(file.fileno(), 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        offbench.training.trainer.Rollouts = HereRollouts  # type: ignore[misc]
        main(command["words"])
        status = 0
    except SystemExit as done:
        status = int(done.code or 0)
    finally:
        os._exit(status)


def serve() -> None:
    """Answer commands until the input ends."""
    env_spec("InvertedPendulum-v5")  # imports MuJoCo
    for line in sys.stdin:
        command = json.loads(line)
        began = time.perf_counter()
        pid = os.fork()
        if pid == 0:
            child(command)
        if command["kill_after"] is not None:
            time.sleep(command["kill_after"])
            os.kill(pid, signal.SIGKILL)  # it may be a zombie by now: then this changes nothing
        _, status = os.waitpid(pid, 0)
        seconds = time.perf_counter() - began
        said = (
            (Path(command["folder"]) / "stderr.txt").read_text()
            if (Path(command["folder"]) / "stderr.txt").exists()
            else ""
        )
        answer = {"status": os.waitstatus_to_exitcode(status), "seconds": seconds, "stderr": said}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    serve()
