"""Keep the plain files of finished runs: `python -m tests.keep_runs RUNS docs/results/medium/runs --steps 300000`.

They are config.json, evaluations.csv, losses.csv and similarity.json, if there is one: all that `offbench report
--runs` reads. Of a run that was trained further than `--steps`, they are cut there (and similarity.json is left out):
what a run does up to a step does not depend on its length.
Commands lose the folders of the machine.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from pathlib import Path

from offbench.common.files import write_json
from offbench.training.run import Run, find_runs

FILES = ("config.json", "evaluations.csv", "losses.csv")
SIMILARITY = "similarity.json"


def keep(runs: Path, target: Path, steps: int | None = None) -> list[Path]:
    """Copy the files of each run that has reached `steps`, or its own last step, below `target`; return the copies.

    Args:
        steps: where to cut longer runs; they must have an evaluation there.
    """
    copies = []
    for run in find_runs(runs):
        last = run.config().steps if steps is None else steps
        if last not in run.evaluations() or run.diverged:
            continue
        copy = Run(target / run.folder.relative_to(runs))
        copy.folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copyfile(run.folder / name, copy.folder / name)
        config = json.loads(copy.config_path.read_text(encoding="utf-8"))
        config["command"] = without_folders(config["command"])
        if run.config().steps > last:
            copy.write_evaluations({step: e for step, e in run.evaluations().items() if step <= last})
            copy.write_losses([row for row in run.losses() if row["step"] <= last])
            config["steps"] = last
            if "sessions" in config:
                config["sessions"] = [session for session in config["sessions"] if session["step"] < last]
        elif (run.folder / SIMILARITY).exists():
            shutil.copyfile(run.folder / SIMILARITY, copy.folder / SIMILARITY)
        write_json(copy.config_path, config)
        copies.append(copy.folder)
    return copies


def without_folders(command: str) -> str:
    """Return a command without its --runs, and with the names of files in place of absolute paths."""
    command = re.sub(r" --runs \S+", "", command)
    return re.sub(r"/\S*/(\S+)", r"\1", command)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--steps", type=int)
    arguments = parser.parse_args()
    for folder in keep(arguments.runs, arguments.target, arguments.steps):
        print(folder)
