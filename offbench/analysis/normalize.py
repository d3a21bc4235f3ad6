"""`normalize`: runs to a score table, returns to scores, and tables to text."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from offbench.agents.ladder import read_ladder
from offbench.analysis.results import Entry, entries_of, read_results
from offbench.analysis.statistics import iqm
from offbench.common.errors import OffbenchError
from offbench.common.scores import normalize
from offbench.common.tables import markdown
from offbench.common.text import no_formula
from offbench.envs.recipes import load_recipe
from offbench.training.run import DIGITS, Run, find_runs

Row = dict[str, Any]
FORMATS = ("table", "json", "csv", "markdown", "latex")


def score_runs(runs: str | Path = "runs") -> list[Row]:
    """Return one row for each (dataset, algorithm, variant) below a folder, seeds averaged.

    A run's score is the mean of its last 10 evaluations; a row has the mean and the standard deviation over
    seeds, normalised by the dataset's own reference (`score`) and by D4RL's constants (`d4rl_score`), and the
    interquartile mean of `score` with its 95% bootstrap interval (`iqm`, in JSON and CSV). Only if one id stands for
    several contents, rows have the first digits of the content's hash (`content`). `window` (in JSON and CSV) has the
    steps of the evaluations behind the scores, and is empty if they differ between seeds: only scores of one window
    compare.

    Raises:
        OffbenchError: the folder holds no evaluated run. Damaged ones are named on stderr and left out.
    """
    return _rows(read_results(runs).entries.values())


def score_some(runs: Iterable[Run]) -> list[Row]:
    """Return the rows of `score_runs` for these runs alone; [] if none is evaluated."""
    return _rows(entries_of(runs)[0])


def count_waiting(runs: str | Path) -> int:
    """Return how many runs below a folder have no evaluation yet; damaged ones are not counted."""
    return sum(map(_is_waiting, find_runs(Path(runs))))


def _is_waiting(run: Run) -> bool:
    try:
        return not run.evaluations()
    except OffbenchError:
        return False


def _rows(entries: Collection[Entry]) -> list[Row]:
    twins = any(entry.task.twin for entry in entries)
    return [_row(entry, twins) for entry in entries]


def _row(entry: Entry, twins: bool) -> Row:
    mean_return, _ = entry.mean_std(None) or (None, None)
    row: Row = {
        "dataset": entry.task.dataset,
        **({"content": entry.task.content[:DIGITS]} if twins else {}),
        "algorithm": entry.method.algorithm,
        "variant": entry.method.variant,
        "seeds": len(entry.runs),
        "steps": entry.reached,
        "of_steps": entry.steps,
        "evaluations": entry.evaluations,
        "window": " ".join(map(str, entry.window)) if entry.window else None,
        "return": mean_return,
    }
    for column, reference in (("score", "dataset"), ("d4rl_score", "d4rl")):
        mean, std = entry.mean_std(reference) or (None, None)
        row |= {column: mean, f"{column}_std": std}
        if reference == "dataset":
            middle = None if mean is None else iqm({"": [trained.score(reference) for trained in entry.runs]})
            ends = (middle.low, middle.high) if middle else (None, None)
            row |= {"iqm": middle.value if middle else None, "iqm_low": ends[0], "iqm_high": ends[1]}
    return row


def score_returns(env: str, returns: Sequence[float], behaviour_dir: str | Path = "behaviour") -> list[Row]:
    """Return one row for each return: its score by our reference (if there is a ladder) and by D4RL's constants.

    Raises:
        OffbenchError: unknown environment, a return that is not finite, or no reference at all.
    """
    recipe = load_recipe(env)
    if not np.isfinite(returns).all():
        raise OffbenchError(f"returns must be finite numbers, not {list(returns)}")
    folders = [recipe.folder / "behaviour"] if recipe.folder else []
    folders.append(Path(behaviour_dir) / recipe.name / "seed-0" / "ladder")
    ladder = next((found.check(recipe) for folder in folders if (found := read_ladder(folder))), None)
    ours = (ladder.random_return, ladder.expert_return) if ladder else None
    d4rl = (recipe.d4rl_min, recipe.d4rl_max) if recipe.d4rl_min is not None else None
    if not ours and not d4rl:
        raise OffbenchError(
            f"{env} has no reference scores yet; measure them with `offbench behaviour {shlex.quote(env)}`"
        )
    return [
        {
            "environment": recipe.env_id,
            "return": value,
            "score": normalize(value, *ours) if ours else None,
            "d4rl_score": normalize(value, *d4rl) if d4rl else None,  # type: ignore[arg-type]
        }
        for value in returns
    ]


def normalize_runs_or_returns(
    runs: str | Path = "runs", *, env: str | None = None, returns: Sequence[float] = ()
) -> list[Row]:
    """Score all runs below a folder; or, with `env`, score `returns` of that environment.

    Rows are dictionaries; `offbench.analysis.normalize.render(rows, "markdown")` prints them.
    """
    if env is None:
        if returns:
            raise OffbenchError("returns need their environment: give --env, e.g. --env hopper 1234.5")
        return score_runs(runs)
    if not returns:
        raise OffbenchError(f"give the returns to normalise, e.g. --env {env} 1234.5 987")
    return score_returns(env, returns)


TITLES = {
    "window": None,
    "of_steps": None,  # shown as 50,000/1,000,000 in the steps column
    "score": "score (own ref.)",
    "score_std": None,
    "iqm": None,  # of one dataset's few seeds it is near the mean: for programs, not for the eye
    "iqm_low": None,
    "iqm_high": None,
    "d4rl_score": "score (D4RL ref.)",
    "d4rl_score_std": None,
}


def render(rows: Sequence[Row], style: str = "table") -> str:
    """Return rows as text: an aligned table, JSON, CSV, Markdown or LaTeX."""
    if style == "json":
        return json.dumps(list(rows), indent=1)
    if style == "csv":
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([list(rows[0]), *([no_formula(cell) for cell in row.values()] for row in rows)])
        return text.getvalue().rstrip("\n")
    keys = [key for key in rows[0] if TITLES.get(key, key) is not None]
    header = [TITLES.get(key, key) or key for key in keys]
    cells = [[_cell(row, key, "$\\pm$" if style == "latex" else "±") for key in keys] for row in rows]
    notes = _window_notes(rows)
    if style == "markdown":
        return "\n".join([*markdown(header, cells), *(line for note in notes for line in ("", note))])
    if style == "latex":
        return "\n".join([_latex(header, cells), *(f"% {note}" for note in notes)])
    widths = [max(len(line[i]) for line in [header, *cells]) for i in range(len(header))]
    lines = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in [header, *cells]]
    rule = ["-" * width for width in widths]
    return "\n".join(["  ".join(line).rstrip() for line in [lines[0], rule, *lines[1:]]] + notes)


def _window_notes(rows: Sequence[Row]) -> list[str]:
    """Return a note if scores of one dataset are of evaluations at different steps."""
    windows: dict[tuple[Any, Any], set[Any]] = {}
    for row in rows:
        if "window" in row:
            windows.setdefault((row["dataset"], row.get("content")), set()).add(row["window"])
    torn = sorted({dataset for (dataset, _), found in windows.items() if len(found) > 1 or None in found})
    if not torn:
        return []
    return [f"note: scores of {', '.join(torn)} are of evaluations at different steps and cannot be compared"]


def _cell(row: Mapping[str, Any], key: str, plus_minus: str) -> str:
    value = row[key]
    if value is None:
        return "-"
    if key == "steps" and value != row["of_steps"]:
        return f"{value:,} of {row['of_steps']:,}"
    if isinstance(value, float):
        std = row.get(f"{key}_std")
        # one seed has no spread: say so rather than print 0
        spread = "" if f"{key}_std" not in row else f" {plus_minus} " + ("?" if std is None else f"{std:.1f}")
        return f"{value:.1f}{spread}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _latex(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    def line(parts: Sequence[str]) -> str:
        return " & ".join(part.replace("_", "\\_") for part in parts) + " \\\\"

    body = [line(header), "\\midrule", *map(line, cells)]
    return "\n".join(
        [f"\\begin{{tabular}}{{{'l' * len(header)}}}", "\\toprule", *body, "\\bottomrule", "\\end{tabular}"]
    )
