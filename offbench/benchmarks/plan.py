"""Planning: the unfinished runs of a grid, and the time and disk space that they need on a machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offbench.analysis.methods import method_of
from offbench.benchmarks.datasets import check_recorded
from offbench.benchmarks.grid import Grid, Source, load_grid
from offbench.benchmarks.throughput import Rate, measure, operations, step_seconds
from offbench.common.errors import OffbenchError
from offbench.common.progress import duration
from offbench.common.text import counted
from offbench.data import minari_store
from offbench.data.levels import full_size, parse_level
from offbench.data.recorded_env import evaluation_spec
from offbench.envs.environments import make_env, parse_spec, spaces_of, time_limit, untrusted_env
from offbench.envs.recipes import load_recipe
from offbench.training.devices import Machine, pick_machine
from offbench.training.run import Run
from offbench.training.spec import RunSpec, settings_json, specs_of

# operations a second assumed of a large GPU where none can be measured: a seventh of an H100's 67 Tflop/s, as the
# products of a stack are small
GPU_SPEED = 1e13


@dataclass(frozen=True)
class Benchmark:
    """A grid on a machine: what `Plan` describes and `benchmark` runs.

    Attributes:
        variants: the runs of each algorithm with one combination of settings, on all its datasets.
    """

    grid: Grid
    variants: tuple[tuple[RunSpec, ...], ...]
    machine: Machine
    precision: str = "float32"

    def started(self) -> list[Run]:
        """Return the grid's runs that have a folder; the folder of all runs may hold those of other grids too."""
        runs = [spec.run for variant in self.variants for spec in variant]
        return [run for run in runs if run.config_path.exists()]

    def missing(self) -> list[Source]:
        """Return the datasets that are not recorded yet."""
        local = set(minari_store.local_ids())
        return [source for source in self.grid.datasets if source.id not in local]


def prepare(
    grid: str,
    *,
    env: str | Path | None = None,
    runs: str | Path = "runs",
    device: str = "auto",
    workers: int | None = None,
    stack: int | str = "auto",
    precision: str = "float32",
) -> Benchmark:
    """Read and check a grid.

    Args:
        grid: a shipped grid's name or a file (`./mine.toml`).
        env: the recipe's name or file of the environment to evaluate in, instead of those that the datasets name.
        runs: the folder of all run folders.
        device, workers, stack, precision: as in `train`.

    Raises:
        OffbenchError: anything wrong in it.
    """
    read = load_grid(grid)
    datasets = [source.id for source in read.datasets]
    env_spec = load_recipe(env).env_spec() if env is not None else None
    variants = [
        variant
        for entry in read.entries
        for variant in specs_of(
            entry.algorithm,
            entry.settings,
            entry.datasets,
            entry.schedule,
            Path(runs),
            precision,
            env_spec,
            label=entry.label,
        )
    ]
    folders = [spec.folder for variant in variants for spec in variant]
    if len(set(datasets)) < len(datasets):
        raise OffbenchError(f"{read.name}: a dataset comes twice")
    if len(set(folders)) < len(folders):
        raise OffbenchError(f"{read.name}: an algorithm with the same settings comes twice")
    for source in read.datasets:
        check_recorded(source)
    return Benchmark(read, tuple(variants), pick_machine(device, workers, stack, precision), precision)


def shard_of(bench: Benchmark, shard: tuple[int, int]) -> list[list[RunSpec]]:
    """Return a shard's runs: a share of each variant. It depends only on the grid, because the machines may differ.

    Raises:
        OffbenchError: there is no such shard.
    """
    index, count = shard
    if not 0 <= index < count:
        raise OffbenchError(f"a shard is i/n with i from 0 to n - 1, not {index}/{count}")
    shares = []
    offset = 0
    for variant in bench.variants:
        share = np.array_split(np.arange(len(variant)), count)[(index - offset) % count]
        shares.append([variant[i] for i in share])
        offset += len(variant)  # the first shares may have one run more; the next variant starts after them
    return shares


def is_longer(spec: RunSpec) -> bool:
    """Return whether a run has more updates already than its grid asks for."""
    return spec.run.newest_checkpoint() > spec.steps


class Plan:
    """The lines of a plan: a grid's size, and the cost of its unfinished runs here. A finished grid is not measured.

    Attributes:
        update_seconds: seconds per update of one run, evaluations included, of each algorithm in the lines so far.

    Args:
        shard: (i, n): of the i-th of n shares of the runs only.
    """

    def __init__(self, bench: Benchmark, shard: tuple[int, int] = (0, 1)) -> None:
        self.bench, self.shard = bench, shard
        self.update_seconds: dict[str, float] = {}

    def __iter__(self) -> Iterator[str]:
        bench, (index, count) = self.bench, self.shard
        shares = shard_of(bench, self.shard)
        longer = sum(is_longer(spec) for share in shares for spec in share)
        left = [[spec for spec in share if not _is_done(spec)] for share in shares]
        sizes = {
            "dataset": len(bench.grid.datasets),
            "variant": len(bench.variants),
            "run": sum(map(len, bench.variants)),
        }
        text = ", ".join(counted(size, noun) for noun, size in sizes.items())
        by_shard = f" by shard {index}/{count}" if count > 1 else ""
        yield f"{bench.grid.name}: {text}, {sum(map(len, left))} to train{by_shard}"
        if longer:
            yield f"  left as they are: {counted(longer, 'run')} with more updates than the grid's steps"
        if not any(left):
            return
        env_specs = {source.env: load_recipe(source.env).env_spec() for source in bench.grid.datasets if source.env}
        chosen = bench.variants[0][0].env_spec
        env_specs = {"": chosen} if chosen else env_specs or {"": _recorded_env_spec(bench.grid.datasets[0])}
        env_spec = next(iter(env_specs.values()))  # for the shapes, which differ little
        step_time = float(np.mean([step_seconds(text) for text in env_specs.values()]))
        self._seconds = self._disk = self._products = 0.0  # of the lines so far
        to_train = [specs for specs in left if specs]
        names = _names(to_train)
        widths = max(map(len, names)), max(len(f"{specs[0].steps:,}") for specs in to_train)
        for name, specs in zip(names, to_train, strict=True):
            yield self._variant(specs, env_spec, step_time, f"{name:<{widths[0]}}", widths[1])
        if missing := bench.missing():
            yield self._recording(missing, env_spec, step_time)
        yield from self._total()

    def _variant(self, specs: Sequence[RunSpec], env_spec: str, step_time: float, name: str, width: int) -> str:
        spec, machine, runs = specs[0], self.bench.machine, len(specs)
        rate = measure(spec, env_spec, machine.device)
        run_seconds = _cost(spec, rate, step_time, env_spec)
        self.update_seconds[spec.algorithm] = run_seconds / spec.steps
        left = sum(1 - spec.run.newest_checkpoint() / spec.steps for spec in specs)  # of a whole run each
        cost = left * run_seconds / machine.processes
        self._seconds += cost
        self._disk += 2 * rate.bytes_per_run * runs
        if machine.device == "cpu":
            self._products += left * spec.steps * operations(spec, env_spec)
        size = f"{counted(runs, 'run'):>9} x {spec.steps:>{width},} updates"
        return f"  {name}{size} at {rate.updates:>5,.0f}/s: {duration(cost)}"

    def _recording(self, missing: Sequence[Source], env_spec: str, step_time: float) -> str:
        steps = sum(_size(source) for source in missing)
        self._seconds += steps * step_time / self.bench.machine.workers
        self._disk += steps * _bytes_per_step(env_spec)
        return f"  to record first: {', '.join(source.id for source in missing)} ({steps:,} transitions)"

    def _total(self) -> Iterator[str]:
        machine = self.bench.machine
        cpu = machine.device == "cpu"
        processes = "one process" if machine.processes == 1 else f"{machine.processes} processes"
        where = f"{processes} of one thread" if cpu else machine.device
        yield (f"  on {where} about {duration(self._seconds)}, {self._disk / 1e9:.1f} GB of disk (measured just now)")
        if cpu:
            yield (
                f"  on a GPU: not measured here; {self._products:.2g} operations in matrix products, which take "
                f"{duration(self._products / GPU_SPEED)} if it does {GPU_SPEED / 1e12:.0f} Tflop/s of them"
            )


def _is_done(spec: RunSpec) -> bool:
    return spec.run.finished(spec.steps) or spec.run.diverged or is_longer(spec)


def _cost(spec: RunSpec, rate: Rate, step_time: float, env_spec: str) -> float:
    """Return the seconds of one run: its updates and its evaluations, full-length episodes assumed."""
    length = time_limit(parse_spec(env_spec)) or 1000
    episodes = -(-spec.steps // spec.eval_every) * spec.eval_episodes
    return spec.steps / rate.updates + episodes * length * step_time


def _recorded_env_spec(source: Source) -> str:
    spec = evaluation_spec(minari_store.read_metadata(source.id))
    if spec is None:
        raise OffbenchError(f"{source.id} names no environment: give one to evaluate in with --env RECIPE")
    untrusted_env(spec, source.id).close()
    return spec


def _size(source: Source) -> int:
    """Return about how many transitions a dataset to be recorded will have."""
    if source.steps or not source.env:
        return source.steps or 0
    _, parts = parse_level(source.level)
    return full_size(parts, load_recipe(source.env).dataset_steps)


def _bytes_per_step(env_spec: str) -> int:
    """Return the bytes of a transition on disk: in the dataset (float64 observations) and in the cache (float32)."""
    observations, actions = spaces_of(make_env(env_spec), "the environment")
    return 12 * observations.shape[0] + 8 * actions.shape[0] + 34


def _names(variants: Sequence[Sequence[RunSpec]]) -> list[str]:
    """Return the variants' methods as tables name them; those of one name with their datasets."""
    first = [specs[0] for specs in variants]
    names = [spec.label or method_of(spec.algorithm, spec.variant, settings_json(spec.config)).label for spec in first]
    datasets = [", ".join(dict.fromkeys(spec.dataset for spec in specs)) for specs in variants]
    return [f"{name} ({ids})" if names.count(name) > 1 else name for name, ids in zip(names, datasets, strict=True)]
