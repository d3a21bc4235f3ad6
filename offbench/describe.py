"""`list` and `show`: what is here, and what is in a dataset."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offbench import dataset
from offbench.errors import OffbenchError
from offbench.ladder import read_ladder
from offbench.levels import LEVELS
from offbench.policy import Array
from offbench.recipes import load_recipe, names
from offbench.registry import algorithm_names
from offbench.scores import normalize

BINS = 12
BAR = 40


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
    for dataset_id in dataset.local_ids():
        try:
            metadata = dataset.read_metadata(dataset_id)
            counts = {key: int(metadata[key]) for key in ("total_steps", "total_episodes")}
        except (OffbenchError, KeyError, TypeError, ValueError):
            print(f"offbench: warning: {dataset_id} has damaged metadata", file=sys.stderr)
            continue
        datasets[dataset_id] = counts | {"algorithm_name": metadata.get("algorithm_name")}
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
    lines += ["algorithms", f"  {', '.join(found['algorithms'])}", f"datasets in {dataset.root()}"]
    for dataset_id, data in found["datasets"].items():
        lines.append(f"  {dataset_id:<32}{data['total_steps']:>10,} steps{data['total_episodes']:>8,} episodes")
    if not found["datasets"]:
        lines.append("  none; record one with `offbench collect ENV --level LEVEL`")
    return lines


@dataclass(frozen=True)
class Summary:
    """What is in a dataset: `lines()` for a terminal, `plot(path)` for a picture."""

    dataset_id: str
    metadata: dict[str, Any]
    returns: Array
    lengths: Array
    terminated: float

    def lines(self) -> list[str]:
        """Return spaces, episodes, a histogram of returns and the provenance as text."""
        ours, meta = dataset.provenance(self.metadata), self.metadata
        low, high = meta.get("ref_min_score"), meta.get("ref_max_score")
        lines = [
            f"{self.dataset_id}: {meta.get('description', 'no description')}",
            f"spaces       observations {_space(meta, 'observation_space')}, actions {_space(meta, 'action_space')}",
            f"episodes     {len(self.returns):,}, {int(self.lengths.sum()):,} transitions, "
            f"length {self.lengths.mean():.0f} ({self.lengths.min()} to {self.lengths.max()}), "
            f"{100 * self.terminated:.0f}% terminated",
            f"return       mean {self.returns.mean():.1f}, std {self.returns.std():.1f}, "
            f"{self.returns.min():.1f} to {self.returns.max():.1f}",
        ]
        if low is not None and high is not None and high > low:
            score = normalize(float(self.returns.mean()), float(low), float(high))
            lines.append(f"references   random {low:.1f}, expert {high:.1f}: normalized mean return {score:.1f}")
        lines += ["", *_histogram(self.returns), ""]
        for part in ours.get("parts", []):
            words = ", ".join(f"{key} {value}" for key, value in part.items())
            lines.append(f"made from    {words}")
        made = ", ".join(f"{name} {version}" for name, version in ours.get("versions", {}).items())
        told = {"seed": ours.get("seed"), "versions": made or None, "content": ours.get("content_sha256")}
        told["imported"] = ours.get("imported", {}).get("file")
        return lines + [f"{key:<12} {value}" for key, value in told.items() if value is not None]

    def plot(self, path: str | Path) -> Path:
        """Draw the histogram of returns. Raises OffbenchError if the picture cannot be written."""
        from offbench.plots import figure, picture_file, save

        path = picture_file(path)
        with figure() as (fig, (axes,)):
            axes.hist(self.returns, bins=40, color="#3b6ea5")
            axes.axvline(self.returns.mean(), color="#c44", linewidth=1.2, label=f"mean {self.returns.mean():.0f}")
            axes.set(xlabel="return", ylabel="episodes", title=self.dataset_id)
            axes.legend(frameon=False)
            return save(fig, path)


def show(dataset_id: str) -> Summary:
    """Summarise a local Minari dataset with Box spaces.

    Raises:
        OffbenchError: no such dataset, or it cannot be read.
    """
    from offbench import transitions

    data = transitions.load(dataset_id)
    lengths = np.diff(data.ends, prepend=0)
    terminated = float((data.masks[data.ends - 1] == 0).mean())
    return Summary(dataset_id, data.metadata, np.asarray(data.returns), lengths, terminated)


def _space(metadata: dict[str, Any], key: str) -> str:
    import json

    try:
        space = json.loads(metadata[key])
        return f"{space['type']} {tuple(space['shape'])} {space['dtype']}"
    except (KeyError, TypeError, ValueError, RecursionError):
        return "unknown"


def _histogram(values: Array) -> list[str]:
    """Return a histogram as lines of text."""
    if not len(values):
        raise OffbenchError("the dataset has no episodes")
    counts, edges = np.histogram(values, BINS)
    bars = ["█" * round(BAR * count / counts.max()) for count in counts]
    return [f"{edges[i]:>10.1f} to {edges[i + 1]:>9.1f}  {bars[i]:<{BAR}} {counts[i]:,}".rstrip() for i in range(BINS)]
