"""The files that are kept of a longer run are those of a run that ended there."""

from __future__ import annotations

from pathlib import Path

import offbench
from offbench.evaluation.similarity import similarity
from offbench.training.run import find_runs
from tests.keep_runs import keep, without_folders


def test_a_run_cut_at_a_step_has_the_files_of_a_run_that_ended_there(medium: str) -> None:
    arguments = {"eval_every": 100, "eval_episodes": 2, "hidden": (16, 16), "batch_size": 32}
    offbench.train("bdb", medium, steps=200, runs="short", **arguments)
    offbench.train("bdb", medium, steps=400, runs="long", **arguments)
    for run in find_runs(Path()):
        similarity(run.folder, samples=10)
    (cut,) = keep(Path("long"), Path("cut"), steps=200)
    (whole,) = keep(Path("short"), Path("whole"))
    for name in ("evaluations.csv", "losses.csv", "config.json"):
        ours, theirs = (cut / name).read_text(), (whole / name).read_text()
        assert ours.replace("runs='long'", "runs='short'") == theirs, name
    assert [(folder / "similarity.json").exists() for folder in (cut, whole)] == [False, True]
    assert keep(Path("short"), Path("none"), steps=400) == []


def test_kept_commands_name_no_folder_of_the_machine() -> None:
    command = "offbench benchmark /home/me/mine.toml --workers 1 --runs /scratch/runs --precision bfloat16"
    assert without_folders(command) == "offbench benchmark mine.toml --workers 1 --precision bfloat16"
