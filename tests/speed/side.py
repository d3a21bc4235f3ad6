"""A side of a comparison: a process with one thread that works when told to.

The parent writes a number of seconds on a line; the side works about that long and answers with one line of JSON:
the units of work it did, the seconds they took, and the peak memory of its processes in MB. This file imports
nothing but the standard library, because d3rlpy's environment runs it too.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

Work = Callable[[], int]  # does a little and returns how many units that was


def serve(make: Callable[..., Work]) -> None:
    """Answer the parent until it hangs up. Arguments of the form key=value go to `make`."""
    work = make(**dict(word.split("=", 1) for word in sys.argv[2:]))
    work()  # warm
    print("ready", flush=True)
    for line in sys.stdin:
        count, began = 0, time.perf_counter()
        while time.perf_counter() - began < float(line):
            count += work()
        spent = time.perf_counter() - began
        usage = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        print(json.dumps({"count": count, "seconds": spent, "memory": max(usage) / 1024}), flush=True)


class Side:
    """The parent's end of a side."""

    def __init__(self, command: list[str], environment: dict[str, str], core: int | None = None) -> None:
        """Start `command`; with `core`, it and all its threads run on that core alone (Linux)."""
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        if core is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self.process.pid, {core})
        self.memory = 0.0
        if self._answer() != "ready":
            raise SystemExit(f"{' '.join(command)} did not start")

    def _answer(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(("ready", "{")):  # libraries may print, too
                return line.strip()
        raise SystemExit(f"{self.process.args!r} ended with {self.process.wait()}")

    def rate(self, seconds: float) -> float:
        """Let it work; return its units a second."""
        assert self.process.stdin is not None
        print(seconds, file=self.process.stdin, flush=True)
        found: dict[str, Any] = json.loads(self._answer())
        self.memory = max(self.memory, found["memory"])
        return float(found["count"] / found["seconds"])

    def close(self) -> None:
        """Hang up."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()
