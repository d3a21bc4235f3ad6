"""`normalize`: the score table of runs, the scores of returns, and their output as text."""

from __future__ import annotations

import contextlib
import json
import math
import shlex
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from offbench.agents.ladder import BEHAVIOUR, folder_of, read_ladder, shipped_ladder
from offbench.analysis.methods import Method, unnamed_settings
from offbench.analysis.results import SHORT_HASH, Entry, differing_settings_notes, entries_of, mixed_code, read_results
from offbench.analysis.statistics import iqm
from offbench.common import scores
from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import JsonObject, csv_bytes
from offbench.common.tables import latex, markdown, plain, tabular
from offbench.common.text import aligned, compact, no_formula, printable
from offbench.envs.recipes import load_recipe
from offbench.training.run import Run, find_runs

Row: TypeAlias = JsonObject
FORMATS = ("table", "json", "csv", "markdown", "latex")


def score_runs(runs: str | Path = "runs", steps: int | None = None) -> list[Row]:
    """Return one row for each (dataset, algorithm, variant) below a folder, seeds averaged.

    A run's score is the mean of its last 10 evaluations; a row has the mean and the standard deviation over
    seeds, normalized by the dataset's own reference (`score`) and by D4RL's constants (`d4rl_score`), and the
    interquartile mean of `score` with its 95% bootstrap interval (`iqm`, in JSON and CSV). Only if one id stands for
    several contents, rows have the first digits of the content's hash (`content`). `window` (in JSON and CSV) has the
    steps of the evaluations behind the scores, and is empty if they differ between seeds: only scores of one window
    compare. `differing_settings` (in JSON and CSV) says in which settings the runs of a row differ.

    Args:
        runs: the folder of the run directories.
        steps: score the runs as they were after so many updates; shorter ones as they are.

    Raises:
        OffbenchError: the folder holds no evaluated run. Damaged ones are named on stderr and left out.
    """
    return _rows(read_results(runs, steps=steps).entries.values())


def score_rows_of(runs: Iterable[Run]) -> list[Row]:
    """Return the rows of `score_runs` for these runs alone; [] if none is evaluated."""
    return _rows(entries_of(runs)[0])


def without_evaluation(runs: str | Path, steps: int | None = None) -> tuple[int, int]:
    """Return how many runs below a folder have no evaluation yet, and how many diverged before their first one.

    Damaged ones are not counted. With `steps`, only evaluations within so many updates count.
    """
    diverged = []
    last = math.inf if steps is None else steps
    for run in find_runs(Path(runs)):
        with contextlib.suppress(OffbenchError, OSError):
            evaluations = run.evaluations()
            if not any(step <= last for step in evaluations):
                diverged.append(run.diverged and not evaluations)
    return diverged.count(False), diverged.count(True)


def _rows(entries: Collection[Entry]) -> list[Row]:
    ambiguous, mixed = any(entry.task.ambiguous for entry in entries), mixed_code(entries)
    return [
        _row(entry, ambiguous)
        | {
            "one_code": (entry.task, entry.method.algorithm) not in mixed,
            "differing_settings": "; ".join(differing_settings_notes([entry])),
        }
        for entry in entries
    ]


def _row(entry: Entry, ambiguous: bool) -> Row:
    mean_return, _ = entry.mean_std(None) or (None, None)
    row: Row = {
        "dataset": entry.task.dataset,
        **({"content": entry.task.content_sha256[:SHORT_HASH]} if ambiguous else {}),
        "method": entry.method.label,
        "algorithm": entry.method.algorithm,
        "variant": entry.runs[0].config.variant,
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
            estimate = None if mean is None else iqm({"": [run.score(reference) for run in entry.runs]})
            ends = (estimate.low, estimate.high) if estimate else (None, None)
            row |= {"iqm": estimate.value if estimate else None, "iqm_low": ends[0], "iqm_high": ends[1]}
    return row


def score_returns(env: str | Path, returns: Sequence[float]) -> list[Row]:
    """Return one row for each return: its score by our reference (if there is a ladder) and by D4RL's constants.

    Raises:
        OffbenchError: unknown environment, a return that is not finite, or no reference at all.
    """
    recipe = load_recipe(env)
    returns = list(map(float, returns))  # NumPy's numbers are not JSON
    if not all(abs(value) < scores.MAX_VALUE for value in returns):
        raise OffbenchError(f"returns must be finite numbers below {scores.MAX_VALUE:g}, not {list(returns)}")
    ladder = shipped_ladder(recipe) or read_ladder(folder_of(recipe, 0, BEHAVIOUR) / "ladder")
    if ladder:
        ladder.check(recipe)
    own_reference = (ladder.random_return, ladder.expert_return) if ladder else None
    d4rl = recipe.d4rl_reference()
    if not own_reference and not d4rl:
        raise OffbenchError(
            f"{env} has no reference scores yet; measure them with `offbench behaviour {shlex.quote(str(env))}`"
        )
    return [
        {
            "environment": recipe.env_id,
            "return": value,
            "score": scores.normalize(value, *own_reference) if own_reference else None,
            "d4rl_score": scores.normalize(value, *d4rl) if d4rl else None,
        }
        for value in returns
    ]


def normalize(
    runs: str | Path | None = None,
    *,
    steps: int | None = None,
    env: str | Path | None = None,
    returns: float | Sequence[float] = (),
) -> list[Row]:
    """Score all runs below a folder (default: runs); or, with `env`, one or several `returns` of that environment.

    With `steps`, the runs are scored as they were after so many updates (shorter ones as they are).

    Rows are dictionaries; `offbench.analysis.normalize.render(rows, "markdown")` prints them.
    """
    returns = list(returns) if isinstance(returns, Iterable) else [returns]
    if env is None:
        if returns:
            raise OffbenchError("returns need their environment: give --env, e.g. --env hopper 1234.5")
        return score_runs("runs" if runs is None else runs, steps)
    for flag, given in (("steps", steps is not None), ("runs", runs is not None)):
        if given:
            raise OffbenchError(f"--{flag} has no effect with --env; leave it out")
    if not returns:
        raise OffbenchError(f"give the returns to normalize, e.g. --env {env} 1234.5 987")
    return score_returns(env, returns)


TITLES: dict[str, str | None] = {
    "algorithm": None,
    "variant": None,
    "window": None,
    "one_code": None,
    "differing_settings": None,
    "of_steps": None,  # shown as 50,000 of 1,000,000 in the steps column
    "score": "score (own ref.)",
    "score_std": None,
    "iqm": None,  # only in JSON and CSV: over the few seeds of one dataset it is close to the mean
    "iqm_low": None,
    "iqm_high": None,
    "d4rl_score": "score (D4RL ref.)",
    "d4rl_score_std": None,
}
NARROW: dict[str, str | None] = {"score": "score", "d4rl_score": "D4RL score", "evaluations": "evals"}  # on a terminal
NAMES = ("dataset", "content", "method", "environment")  # columns of text


def render(rows: Sequence[Row], style: str = "table") -> str:
    """Return rows as text: an aligned table, JSON, CSV, Markdown or LaTeX.

    Raises:
        OffbenchError: there is no such style.
    """
    if style not in FORMATS:
        raise unknown("format", style, FORMATS)
    if style == "json":
        return json.dumps(list(rows), indent=1)
    if not rows:
        return ""
    if style == "csv":
        values = ([no_formula(value) for value in row.values()] for row in rows)
        return csv_bytes(list(rows[0]), values).decode().rstrip("\n")
    keys = _shown(rows)
    header = [TITLES.get(key, key) or key for key in keys]
    cells = [[_cell(row, key) for key in keys] for row in rows]
    names = sum(key in NAMES for key in keys)
    if style == "markdown":
        header, *cells = [[plain(text) for text in line] for line in [header, *cells]]
        return "\n".join(
            [*markdown(header, cells), *(line for note in notes(rows) for line in ("", f"note: {plain(note)}"))]
        )
    if style == "latex":
        header, *cells = [[latex(text) for text in line] for line in [header, *cells]]
        comments = (f"% note: {printable(' '.join(note.split()))}" for note in notes(rows))
        return "\n".join([*tabular(header, cells, names), *comments])
    lines = aligned(header, cells, names)
    return "\n".join([*lines, *(f"note: {note}" for note in notes(rows))])


def score_table(rows: Sequence[Row], terminal: bool) -> JsonObject:
    """Return the rows as the arguments of `offbench.common.terminal.print_table`.

    Args:
        terminal: short titles and numbers, so that the table fits 80 columns; the best score of a dataset is marked.
    """
    keys = _shown(rows)
    titles = TITLES | NARROW if terminal else TITLES
    cells = [[_cell(row, key, short=terminal) for key in keys] for row in rows]
    best = _best(rows) if "score" in keys else set()
    return {
        "header": [titles.get(key, key) or key for key in keys],
        "rows": cells,
        "names": sum(key in NAMES for key in keys),
        "group": "dataset" in keys,
        "optional": [titles.get(key) or key for key in ("evaluations", "return", "d4rl_score")],
        "marked": {(i, keys.index("score")) for i in best},
    }


def _shown(rows: Sequence[Row]) -> list[str]:
    """Return the columns for a reader: without those that no row has, such as D4RL's score."""
    keys = [key for key in rows[0] if TITLES.get(key, key) is not None]
    return [key for key in keys if any(row[key] is not None for row in rows) or key == "score"]


def _best(rows: Sequence[Row]) -> set[int]:
    """Return the indices of the rows with the highest score of their dataset, where its scores compare."""
    groups: dict[tuple[str | None, str | None], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row.get("dataset"), row.get("content")), []).append(i)
    best = set()
    for members in groups.values():
        windows = {rows[i].get("window") for i in members}
        scores = {i: f"{rows[i]['score']:.1f}" for i in members if rows[i]["score"] is not None}
        if len(windows) == 1 and None not in windows and len(scores) > 1:
            top = f"{max(rows[i]['score'] for i in scores):.1f}"
            best |= {i for i, score in scores.items() if score == top}
    return best


def notes(rows: Sequence[Row]) -> list[str]:
    """Return the notes on a score table: scores that are not comparable, and settings that names leave out."""
    windows: dict[tuple[str, str | None], set[str | None]] = {}
    for row in rows:
        if "window" in row:
            windows.setdefault((row["dataset"], row.get("content")), set()).add(row["window"])
    incomparable = sorted({dataset for (dataset, _), steps in windows.items() if len(steps) > 1 or None in steps})
    lines = []
    if incomparable:
        lines.append(
            f"scores of {', '.join(incomparable)} are of evaluations at different steps and cannot be compared"
        )
    mixed = dict.fromkeys((row["algorithm"], row["dataset"]) for row in rows if not row.get("one_code", True))
    lines += [f"the runs of {algorithm} on {dataset} were trained by different code" for algorithm, dataset in mixed]
    lines += [row["differing_settings"] for row in rows if row.get("differing_settings")]
    if any("method" in row for row in rows):
        datasets: dict[Method, dict[str, None]] = {}
        for row in rows:
            method = Method(row["algorithm"], row["variant"], None, row["method"])
            datasets.setdefault(method, {})[row["dataset"]] = None
        variants = Counter(method.label for method in datasets)
        for method, where in datasets.items():  # a method may have other settings on each dataset
            name = method.label + (f" on {', '.join(where)}" if variants[method.label] > 1 else "")
            lines += [f"settings of {text}" for text in unnamed_settings([replace(method, name=name)])]
    return lines


def _cell(row: Row, key: str, short: bool = False) -> str:
    value = row[key]
    if value is None:
        return "-"
    if key == "steps":
        count = compact if short else "{:,}".format
        return count(value) if value == row["of_steps"] else f"{count(value)} of {count(row['of_steps'])}"
    if isinstance(value, float):
        return scores.plus_minus((value, row[f"{key}_std"])) if f"{key}_std" in row else f"{value:z.1f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
