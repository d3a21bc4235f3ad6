"""Planning: a grid at one place, the runs that are left of it, and what they cost there."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offbench.benchmarks.datasets import check_recorded
from offbench.benchmarks.grid import Entry, Grid, Source, Times, load_grid
from offbench.benchmarks.throughput import Rate, measure, operations, step_seconds
from offbench.common.errors import OffbenchError
from offbench.common.processes import default_workers
from offbench.common.progress import duration
from offbench.common.text import counted
from offbench.data import minari_store
from offbench.data.levels import full_size, parse_level
from offbench.data.recorded_env import evaluation_spec
from offbench.envs.environments import believed_env, make_env
from offbench.envs.recipes import Recipe, load_recipe
from offbench.training.devices import check_precision, pick_device
from offbench.training.grouping import finished
from offbench.training.jobs import Order
from offbench.training.registry import load_algorithm
from offbench.training.run import Run, run_folder, settings_dict, variant
from offbench.training.train import configurations

# What a large GPU is taken to do of a stack's small float32 products where there is none to measure: a seventh of an
# H100's 67 Tflop/s.
GPU_SPEED = 1e13


@dataclass(frozen=True)
class Variant:
    """One algorithm with one set of settings: a column of the table."""

    algorithm: str
    config: Any
    times: Times

    @property
    def name(self) -> str:
        """Algorithm and settings in words."""
        return f"{self.algorithm} {variant(self.config)}".removesuffix(" default")


@dataclass(frozen=True)
class Benchmark:
    """A grid at one place: what `Plan` describes and `run` does."""

    grid: Grid
    variants: tuple[Variant, ...]
    runs: Path
    device: str
    workers: int
    precision: str = "float32"
    stack: int | str = "auto"

    @property
    def processes(self) -> int:
        """Stacks that train at a time."""
        return self.workers if self.device == "cpu" else 1

    def orders(self, one: Variant) -> list[Order]:
        """Return a variant's runs on every dataset."""
        settings, name = settings_dict(one.config), variant(one.config, self.precision)
        return [
            Order(
                one.algorithm,
                source.id,
                settings,
                seed,
                str(run_folder(self.runs, source.id, one.algorithm, name, seed)),
            )
            for source in self.grid.datasets
            for seed in one.times.seeds
        ]

    def begun(self) -> list[Run]:
        """Return the grid's runs that there are; its folder may hold other grids' too."""
        runs = [Run(Path(order.folder)) for one in self.variants for order in self.orders(one)]
        return [run for run in runs if run.config_path.exists()]

    def missing(self) -> list[Source]:
        """Return the datasets that are not recorded yet."""
        here = set(minari_store.local_ids())
        return [source for source in self.grid.datasets if source.id not in here]


def prepare(
    grid: str,
    *,
    runs: str | Path = "runs",
    device: str = "auto",
    workers: int | None = None,
    stack: int | str = "auto",
    precision: str = "float32",
) -> Benchmark:
    """Read and check a grid.

    Args:
        grid: a shipped grid's name or a file (`./mine.toml`).
        runs: the folder of all run directories.
        device, workers, stack, precision: as in `train`.

    Raises:
        OffbenchError: anything wrong in it.
    """
    read = load_grid(grid)
    variants = [Variant(e.algorithm, config, e.times) for e in read.entries for config in _configs(e)]
    if len({(v.algorithm, variant(v.config)) for v in variants}) < len(variants):
        raise OffbenchError(f"{read.name}: an algorithm with the same settings comes twice")
    if len({source.id for source in read.datasets}) < len(read.datasets):
        raise OffbenchError(f"{read.name}: a dataset comes twice")
    for source in read.datasets:
        check_recorded(source)
    place = pick_device(device)
    check_precision(precision, place)
    return Benchmark(read, tuple(variants), Path(runs), place, default_workers(workers), precision, stack)


def _configs(entry: Entry) -> list[Any]:
    kind = load_algorithm(entry.algorithm)
    return configurations(kind.Config, entry.settings, entry.algorithm)


class Plan:
    """What a grid is and what is left of it costs here, told line by line; a finished grid costs no calibration.

    Attributes:
        update_seconds: of each algorithm that was measured while the lines were told, what a run's update takes,
            evaluations included.
    """

    def __init__(self, bench: Benchmark) -> None:
        self.bench = bench
        self.update_seconds: dict[str, float] = {}
        self._seconds = self._disk = self._products = 0.0  # of all that is left, summed up as it is told

    def __iter__(self) -> Iterator[str]:
        bench = self.bench
        runs = {one: bench.orders(one) for one in bench.variants}
        left = {
            one: [order for order in orders if not finished(Run(Path(order.folder)), one.times.steps)]
            for one, orders in runs.items()
        }
        sizes = {"dataset": len(bench.grid.datasets), "variant": len(runs), "run": sum(map(len, runs.values()))}
        words = ", ".join(counted(size, noun) for noun, size in sizes.items())
        yield f"{bench.grid.name}: {words}, {sum(map(len, left.values()))} to train"
        if not any(left.values()):
            return
        specs = {source.env: _recipe(source).env_spec() for source in bench.grid.datasets if source.env}
        specs = specs or {"": _known_spec(bench.grid.datasets[0])}
        spec = next(iter(specs.values()))  # for the shapes, which differ little
        play = float(np.mean([step_seconds(spec) for spec in specs.values()]))
        self._seconds = self._disk = self._products = 0.0
        for one, orders in left.items():
            if orders:
                yield self._variant(one, len(orders), spec, play)
        if missing := bench.missing():
            yield self._recording(missing, spec, play)
        yield from self._total()

    def _variant(self, one: Variant, runs: int, spec: str, play: float) -> str:
        bench, times = self.bench, one.times
        rate = measure(one.algorithm, one.config, spec, bench.device, precision=bench.precision)
        each = _cost(times, rate, play, spec)
        self.update_seconds[one.algorithm] = each / times.steps
        cost = runs * each / bench.processes
        self._seconds += cost
        self._disk += 2 * rate.bytes_per_run * runs
        if bench.device == "cpu":
            self._products += runs * times.steps * operations(one.algorithm, one.config, spec)
        return (
            f"  {one.name:<40}{runs:>4} runs x {times.steps:>9,} updates, "
            f"{rate.updates:>8,.0f} a second: {duration(cost)}"
        )

    def _recording(self, missing: Sequence[Source], spec: str, play: float) -> str:
        steps = sum(_size(source) for source in missing)
        self._seconds += steps * play / self.bench.workers
        self._disk += steps * _bytes_per_step(spec)
        return f"  to record first: {', '.join(source.id for source in missing)} ({steps:,} transitions)"

    def _total(self) -> Iterator[str]:
        bench, cpu = self.bench, self.bench.device == "cpu"
        where = f"{bench.processes} processes of one thread" if cpu else bench.device
        yield (
            f"  on {where} about {duration(self._seconds)}, {self._disk / 1e9:.1f} GB of disk "
            "(measured for a moment, just now)"
        )
        if cpu:
            yield (
                f"  on a GPU: not measured here; {self._products:.2g} operations in matrix products, which take "
                f"{duration(self._products / GPU_SPEED)} if it does {GPU_SPEED / 1e12:.0f} Tflop/s of them"
            )


def _cost(times: Times, rate: Rate, play: float, spec: str) -> float:
    """Return the seconds of one run: its updates and its evaluations, full-length episodes assumed."""
    length = json.loads(spec).get("max_episode_steps") or 1000
    episodes = -(-times.steps // times.eval_every) * times.eval_episodes
    return times.steps / rate.updates + episodes * length * play


def _recipe(source: Source) -> Recipe:
    return load_recipe(source.env)


def _known_spec(source: Source) -> str:
    spec = evaluation_spec(minari_store.read_metadata(source.id))
    if spec is None:
        raise OffbenchError(f"{source.id} names no environment to plan by; give its env in the grid")
    believed_env(spec, source.id).close()
    return spec


def _size(source: Source) -> int:
    """Return the transitions of a dataset that is to be recorded, about."""
    if source.steps or not source.env:
        return source.steps or 0
    _, parts = parse_level(source.level)
    return full_size(parts, _recipe(source).dataset_steps)


def _bytes_per_step(spec: str) -> int:
    """Return what a transition takes on disk: in the dataset (float64 observations) and in the cache (float32)."""
    env = make_env(spec)
    observations, actions = env.observation_space.shape, env.action_space.shape
    env.close()
    assert observations is not None
    assert actions is not None
    return 12 * observations[0] + 8 * actions[0] + 34
