"""`list`: environments, levels, algorithms, local datasets and runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.levels import LEVELS
from offbench.envs.recipes import load_recipe, names
from offbench.training.registry import algorithm_names


def inventory(what: str | None = None, *, runs: str | Path = "runs") -> dict[str, Any]:
    """Return what is here.

    Args:
        what: `environments` (with their shipped ladders), `levels`, `algorithms`, `datasets` (local ones) or `runs`;
            None for all but the runs.
        runs: the folder of the runs.

    Raises:
        OffbenchError: the folder of the runs holds none, or an unknown `what`.
    """
    parts: dict[str, Callable[[], Any]] = {
        "environments": _environments,
        "levels": lambda: list(LEVELS),
        "algorithms": algorithm_names,
        "datasets": _datasets,
        "runs": lambda: _runs(runs),
    }
    if what is not None and what not in parts:
        raise OffbenchError(f"no list of {what!r}; there are {', '.join(parts)}")
    return {name: part() for name, part in parts.items() if name == what or (what is None and name != "runs")}


def _environments() -> dict[str, Any]:
    environments = {}
    for name in names():
        recipe = load_recipe(name)
        ladder = read_ladder(recipe.folder / "behaviour") if recipe.folder else None
        environments[name] = {
            "env_id": recipe.env_id,
            "expert_return": ladder.expert_return if ladder else None,
            "random_return": ladder.random_return if ladder else None,
        }
    return environments


def _datasets() -> dict[str, Any]:
    datasets = {}
    for dataset_id in minari_store.local_ids():
        try:
            metadata = minari_store.read_metadata(dataset_id)
            counts = {key: int(metadata[key]) for key in ("total_steps", "total_episodes")}
        except (OffbenchError, KeyError, TypeError, ValueError):
            print(f"offbench: warning: {dataset_id} has damaged metadata", file=sys.stderr)
            continue
        full = minari_store.provenance(metadata).get("full_size")
        short = isinstance(full, int) and counts["total_steps"] < full
        more = {"algorithm_name": metadata.get("algorithm_name"), "short_of": full if short else None}
        datasets[dataset_id] = counts | more
    return datasets


def _runs(root: str | Path) -> list[dict[str, Any]]:
    from offbench.analysis.results import read_results

    results = read_results(root)
    rows: list[dict[str, Any]] = []
    for entry in results.entries.values():
        rows += [
            {
                "dataset": entry.task.name,
                "method": entry.method.label,
                "seed": trained.seed,
                "step": trained.reached,
                "steps": trained.steps,
                "state": trained.state,
                "folder": str(trained.run.folder),
            }
            for trained in entry.runs
        ]
    return rows


Section = tuple[str, list[str], list[list[str]]]


def sections(contents: Mapping[str, Any]) -> Iterator[Section]:
    """Return `inventory` as (title, header, rows) of tables; the header is empty where rows are lines of text."""
    if "environments" in contents:
        rows = [
            [name, env["env_id"], *_numbers(env, "random_return", "expert_return")]
            for name, env in contents["environments"].items()
        ]
        yield "environments", ["name", "Gymnasium id", "random return", "expert return"], rows
    for name, more in (("levels", ", or a fraction such as 0.6"), ("algorithms", "")):
        if name in contents:
            yield name, [], [[", ".join(contents[name]) + more]]
    if "datasets" in contents:
        found = contents["datasets"].items()
        rows = [[name, _transitions(data), f"{data['total_episodes']:,}"] for name, data in found]
        none = [["none; record one with `offbench collect ENV --level LEVEL`"]]
        header = ["id", "transitions", "episodes"] if rows else []
        yield f"datasets in {minari_store.root()}", header, rows or none
    if "runs" in contents:
        rows = [
            [run["dataset"], run["method"], str(run["seed"]), f"{run['step']:,}", f"{run['steps']:,}", run["state"]]
            for run in contents["runs"]
        ]
        yield "runs", ["dataset", "method", "seed", "step", "of", "state"], rows


def _transitions(data: Mapping[str, Any]) -> str:
    short = f" of {data['short_of']:,}" if data["short_of"] else ""
    return f"{data['total_steps']:,}{short}"


def _numbers(values: Mapping[str, Any], *keys: str) -> Sequence[str]:
    return [f"{values[key]:.0f}" if values[key] is not None else "-" for key in keys]
