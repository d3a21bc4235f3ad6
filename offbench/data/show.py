"""`show`: what is in a dataset."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offbench.common.arrays import Array
from offbench.common.files import JsonObject
from offbench.common.plotting import default_style, figure, picture_file, save
from offbench.common.scores import normalize
from offbench.common.settings import short_repr
from offbench.data import minari_store, transitions

BINS = 12
BAR = 40


@dataclass(frozen=True, repr=False)
class Summary:
    """The contents of a dataset: `lines()` for a terminal, `plot(path)` for a figure."""

    dataset_id: str
    metadata: JsonObject
    returns: Array
    lengths: Array
    terminated: float

    def lines(self) -> list[str]:
        """Return spaces, episodes, a histogram of returns and the provenance as text."""
        provenance, meta = minari_store.read_provenance(self.metadata), self.metadata
        lines = [
            f"{self.dataset_id}: {meta.get('description', 'no description')}",
            f"spaces          observations {space(meta, 'observation_space')}, actions {space(meta, 'action_space')}",
            f"episodes        {len(self.returns):,}, {int(self.lengths.sum()):,} transitions, "
            f"length {self.lengths.mean():.0f} ({self.lengths.min()} to {self.lengths.max()}), "
            f"{100 * self.terminated:.0f}% terminated",
            f"return          mean {self.returns.mean():.1f}, std {self.returns.std():.1f}, "
            f"{self.returns.min():.1f} to {self.returns.max():.1f}",
        ]
        if references := minari_store.references(meta):
            low, high = references
            score = normalize(float(self.returns.mean()), low, high)
            lines.append(f"references      random {low:.1f}, expert {high:.1f}: normalized mean return {score:z.1f}")
        lines += ["", *_histogram(self.returns), ""]
        lines.append("provenance")
        for part in provenance.parts or ():
            lines += ["part", *(f"  {key:<13} {format_value(value)}" for key, value in part.items())]
        origin = {
            name: getattr(provenance, name) for name in ("env", "level", "seed", "content_sha256", "recipe_sha256")
        }
        origin["imported from"] = provenance.imported.get("file")
        origin["versions"] = ", ".join(f"{name} {version}" for name, version in provenance.versions.items()) or None
        shown = [f"{key:<15} {format_value(value)}" for key, value in origin.items() if value is not None]
        lines += shown or ["not recorded by offbench"]
        return [" ".join(line.splitlines()) for line in lines]  # a line break in a text would begin a line of its own

    def __repr__(self) -> str:
        """Return id and size, and how to see more."""
        return f"Summary({self.dataset_id}, {len(self.returns):,} episodes; `lines()` has more)"

    def plot(self, path: str | Path) -> Path:
        """Draw the histogram of returns. Raises OffbenchError if the figure cannot be written."""
        path = picture_file(path)
        with default_style():
            fig, (axes,) = figure()
            axes.hist(self.returns, bins=40, range=bin_range(self.returns), color="#3b6ea5")
            axes.axvline(self.returns.mean(), color="#c44", linewidth=1.2, label=f"mean {self.returns.mean():.0f}")
            axes.set(xlabel="return", ylabel="episodes", title=self.dataset_id)
            axes.legend(frameon=False)
            return save(fig, path)


def show(dataset_id: str) -> Summary:
    """Summarize a local Minari dataset with Box spaces.

    Raises:
        OffbenchError: no such dataset, or it cannot be read.
    """
    data = transitions.load(dataset_id)
    lengths = np.diff(data.ends, prepend=0)
    terminated = float((data.masks[data.ends - 1] == 0).mean())
    return Summary(dataset_id, data.metadata, np.asarray(data.returns), lengths, terminated)


def format_value(value: object) -> str:
    """Return a value of the metadata as text."""
    if isinstance(value, bool) or not isinstance(value, int | float | list):
        return str(value)
    if isinstance(value, list):
        return " to ".join(short_repr(item) if isinstance(item, list) else format_value(item) for item in value)
    return f"{value:,}" if isinstance(value, int) else f"{value:,.4g}" if abs(value) < 100 else f"{value:,.1f}"


def space(metadata: JsonObject, key: str) -> str:
    """Return a space of the metadata, e.g. `Box (11,) float64`."""
    try:
        space = json.loads(metadata[key])
        return f"{space['type']} {tuple(space['shape'])} {space['dtype']}"
    except (KeyError, TypeError, ValueError, RecursionError):
        return "unknown"


def bin_range(values: Array) -> tuple[float, float]:
    """Return the range of a histogram; wider than the values' if they differ by rounding at most."""
    low, high = float(values.min()), float(values.max())
    if high - low > 1e-9 * (1 + abs(high)):
        return low, high
    return low - 0.5, high + 0.5


def _histogram(values: Array) -> list[str]:
    """Return a histogram as lines of text."""
    counts, edges = np.histogram(values, BINS, bin_range(values))
    bars = ["█" * round(BAR * count / counts.max()) for count in counts]
    return [f"{edges[i]:>10.1f} to {edges[i + 1]:>9.1f}  {bars[i]:<{BAR}} {counts[i]:,}".rstrip() for i in range(BINS)]
