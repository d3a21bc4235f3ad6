"""Keep the plain files of finished runs: `python -m tests.keep_runs RUNS docs/results/medium/runs`.

They are config.json, evaluations.csv and losses.csv, which is all that `offbench report --runs` reads.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from offbench.training.run import find_runs

FILES = ("config.json", "evaluations.csv", "losses.csv")


def keep(runs: Path, place: Path) -> list[Path]:
    """Copy each finished run's files below `place`; return the runs' folders there."""
    kept = []
    for run in find_runs(runs):
        if run.finished(run.config().steps):
            folder = place / run.folder.relative_to(runs)
            folder.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                shutil.copyfile(run.folder / name, folder / name)
            kept.append(folder)
    return kept


if __name__ == "__main__":
    for folder in keep(*map(Path, sys.argv[1:])):
        print(folder)
