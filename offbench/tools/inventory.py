"""`list`: environments, levels, algorithms, local datasets and runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.terminal import warn
from offbench.data import minari_store
from offbench.data.levels import LEVELS
from offbench.envs.recipes import load_recipe, shipped_recipes
from offbench.training.registry import algorithm_names

if TYPE_CHECKING:
    from offbench.analysis.evaluated_run import EvaluatedRun
    from offbench.training.run import Run
    from offbench.training.run_config import RunConfig


def inventory(what: str | None = None, *, runs: str | Path | None = None) -> JsonObject:
    """Return the available environments, levels, algorithms, datasets and runs.

    Args:
        what: `environments` (with their shipped ladders), `levels`, `algorithms`, `datasets` (local ones) or `runs`;
            None for all but the runs.
        runs: the folder of the runs (default: runs). A run's `step` is the newest that was evaluated, or that of its
            newest checkpoint if none was; `score` and `d4rl_score` are those of `offbench.normalize`, None without
            such a reference.

    Raises:
        OffbenchError: an unknown `what`, no such folder of runs, or a duplicated run. Damaged runs are named on
            stderr and left out.
    """
    parts: dict[str, Callable[[], object]] = {
        "environments": _environments,
        "levels": lambda: list(LEVELS),
        "algorithms": algorithm_names,
        "datasets": _datasets,
        "runs": lambda: _runs(runs),
    }
    if what is not None and what not in parts:
        raise OffbenchError(f"no list of {what!r}; there are {', '.join(parts)}")
    return {name: part() for name, part in parts.items() if name == what or (what is None and name != "runs")}


def _environments() -> JsonObject:
    environments = {}
    for name in shipped_recipes():
        recipe = load_recipe(name)
        ladder = read_ladder(recipe.folder / "behaviour") if recipe.folder else None
        environments[name] = {
            "env_id": recipe.env_id,
            "expert_return": ladder.expert_return if ladder else None,
            "random_return": ladder.random_return if ladder else None,
        }
    return environments


def _datasets() -> JsonObject:
    datasets = {}
    for dataset_id in minari_store.local_ids(_warn_of_unreadable):
        try:
            metadata = minari_store.read_metadata(dataset_id)
            counts = {key: int(metadata[key]) for key in ("total_steps", "total_episodes")}
        except (OffbenchError, KeyError, TypeError, ValueError):
            warn(f"{dataset_id} has damaged metadata")
            continue
        full = minari_store.read_provenance(metadata).full_size
        short = full is not None and counts["total_steps"] < full
        more = {"algorithm_name": metadata.get("algorithm_name"), "short_of": full if short else None}
        datasets[dataset_id] = counts | more
    return datasets


def _warn_of_unreadable(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        warn(f"left out: cannot read {error.filename}: {error.strerror}; check its permissions")


def _runs(folder: str | Path | None) -> list[JsonObject]:
    from offbench.analysis.methods import method_of
    from offbench.analysis.results import entries_of
    from offbench.training.run import find_runs

    root = Path("runs" if folder is None else folder)
    if not root.is_dir() and (folder is not None or root.exists()):
        raise OffbenchError(f"{root} is not a folder of runs")
    entries, unevaluated = entries_of(find_runs(root), compared=False)
    rows = [
        _run(entry.task.name, entry.method.label, run.files, run.config, run)
        for entry in entries
        for run in entry.runs
    ]
    for run in unevaluated:
        config = run.config()
        method = config.label or method_of(config.algorithm, config.variant, config.settings).label
        rows.append(_run(config.dataset, method, run, config, None))
    return rows


def _run(dataset: str, method: str, run: Run, config: RunConfig, evaluated: EvaluatedRun | None) -> JsonObject:
    """Return a run's row; `evaluated` is None if it was not evaluated yet."""

    def score(reference: str) -> float | None:
        return evaluated.score(reference) if evaluated and config.references.get(reference) else None

    return {
        "dataset": dataset,
        "method": method,
        "seed": config.seed,
        "step": evaluated.reached if evaluated else run.newest_checkpoint(),
        "steps": config.steps,
        "state": evaluated.state if evaluated else "diverged" if run.diverged else "unfinished",
        "return": evaluated.score(None) if evaluated else None,
        "score": score("dataset"),
        "d4rl_score": score("d4rl"),
        "folder": str(run.folder),
    }


Section = tuple[str, list[str], list[list[str]]]


def sections(contents: JsonObject) -> Iterator[Section]:
    """Return `inventory` as (title, header, rows) of tables; the header is empty where rows are lines of text."""
    if "environments" in contents:
        rows = [
            [name, env["env_id"], *_numbers(env, "random_return", "expert_return")]
            for name, env in contents["environments"].items()
        ]
        yield "environments", ["name", "Gymnasium id", "random return", "expert return"], rows
    for name, more in (("levels", ", or a fraction (0.6)"), ("algorithms", "")):
        if name in contents:
            yield name, [], [[", ".join(contents[name]) + more]]
    if "datasets" in contents:
        datasets = contents["datasets"].items()
        rows = [[name, _transitions(data), f"{data['total_episodes']:,}"] for name, data in datasets]
        none = [["none; record one with `offbench collect ENV --level LEVEL`"]]
        header = ["id", "transitions", "episodes"] if rows else []
        yield f"datasets in {minari_store.root()}", header, rows or none
    if "runs" in contents:
        yield _run_section(contents["runs"])


def _run_section(runs: Sequence[JsonObject]) -> Section:
    if not runs:
        return "runs", [], [["none; start one with `offbench train ALGO --dataset ID`"]]
    titles = {"score": "score", "d4rl_score": "D4RL score"}
    scores = [key for key in titles if any(run[key] is not None for run in runs)] or ["return"]
    rows = [
        [
            *(run["dataset"], run["method"], str(run["seed"]), f"{run['step']:,}", f"{run['steps']:,}"),
            *("-" if run[key] is None else f"{run[key]:z.1f}" for key in scores),
            run["state"],
        ]
        for run in runs
    ]
    return "runs", ["dataset", "method", "seed", "step", "of", *(titles.get(k, k) for k in scores), "state"], rows


def _transitions(data: JsonObject) -> str:
    short = f" of {data['short_of']:,}" if data["short_of"] else ""
    return f"{data['total_steps']:,}{short}"


def _numbers(values: JsonObject, *keys: str) -> Sequence[str]:
    return [f"{values[key]:.0f}" if values[key] is not None else "-" for key in keys]
