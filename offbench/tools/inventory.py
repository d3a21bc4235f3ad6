"""`list`: environments, levels, algorithms and local datasets."""

from __future__ import annotations

import sys
from typing import Any

from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.levels import LEVELS
from offbench.envs.recipes import load_recipe, names
from offbench.training.registry import algorithm_names


def inventory() -> dict[str, Any]:
    """Return environments (with their shipped ladders), levels, algorithms and local datasets."""
    environments = {}
    for name in names():
        recipe = load_recipe(name)
        ladder = read_ladder(recipe.folder / "behaviour") if recipe.folder else None
        environments[name] = {
            "env_id": recipe.env_id,
            "expert_return": ladder.expert_return if ladder else None,
            "random_return": ladder.random_return if ladder else None,
        }
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
        datasets[dataset_id] = counts | {
            "algorithm_name": metadata.get("algorithm_name"),
            "short_of": full if short else None,
        }
    return {
        "environments": environments,
        "levels": list(LEVELS),
        "algorithms": algorithm_names(),
        "datasets": datasets,
    }


def inventory_lines() -> list[str]:
    """Return `inventory` as text."""
    found = inventory()
    lines = ["environments"]
    for name, env in found["environments"].items():
        known = "no behaviour agent shipped: the first collect trains one"
        if env["expert_return"] is not None:
            known = f"expert {env['expert_return']:.0f}, random {env['random_return']:.0f}"
        lines.append(f"  {name:<20}{env['env_id']:<24}{known}")
    lines += ["levels", f"  {', '.join(found['levels'])}, or a fraction such as 0.6"]
    lines += ["algorithms", f"  {', '.join(found['algorithms'])}", f"datasets in {minari_store.root()}"]
    for dataset_id, data in found["datasets"].items():
        short = f"   short of {data['short_of']:,} steps" if data["short_of"] else ""
        lines.append(f"  {dataset_id:<32}{data['total_steps']:>10,} steps{data['total_episodes']:>8,} episodes{short}")
    if not found["datasets"]:
        lines.append("  none; record one with `offbench collect ENV --level LEVEL`")
    return lines
