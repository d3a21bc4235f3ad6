"""Planning: the unfinished runs of a grid, and the time and disk space that they need on a machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offbench.analysis.methods import method_of
from offbench.benchmarks.datasets import check_recorded
from offbench.benchmarks.grid import Grid, GridDataset, load_grid
from offbench.benchmarks.throughput import Rate, measure, operations, step_seconds
from offbench.common.errors import OffbenchError
from offbench.common.progress import duration
from offbench.common.text import counted
from offbench.data import minari_store
from offbench.data.card import expected_episode_length
from offbench.data.levels import full_size, parse_level
from offbench.data.minari_writer import BYTES_PER_EPISODE
from offbench.data.recorded_env import evaluation_spec
from offbench.envs.environments import make_env, parse_spec, spaces_of, time_limit, untrusted_env
from offbench.envs.recipes import load_recipe
from offbench.training.devices import Machine, pick_machine
from offbench.training.run import Run
from offbench.training.spec import RunSpec, settings_json, specs_of

# operations a second that are assumed for a large GPU if there is none to measure: a seventh of an H100's 67 Tflop/s,
# because the products of a stack are small
GPU_SPEED = 1e13


@dataclass(frozen=True)
class Benchmark:
    """A grid on a machine.

    Attributes:
        variants: the runs of each algorithm with one combination of settings, on all its datasets.
    """

    grid: Grid
    variants: tuple[tuple[RunSpec, ...], ...]
    machine: Machine

    def started(self) -> list[Run]:
        """Return the grid's runs that have a folder; the folder of all runs may hold those of other grids too."""
        runs = [spec.run for variant in self.variants for spec in variant]
        return [run for run in runs if run.config_path.exists()]

    def missing(self) -> list[GridDataset]:
        """Return the datasets that are not recorded yet."""
        local = set(minari_store.local_ids())
        return [dataset for dataset in self.grid.datasets if dataset.id not in local]


def prepare(
    grid: str | Path,
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
    read = load_grid(str(grid))
    datasets = [dataset.id for dataset in read.datasets]
    env_spec = load_recipe(env).env_spec() if env is not None else None
    variants = [
        variant
        for entry in read.algorithms
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
        raise OffbenchError(f"{read.name}: a dataset is listed twice")
    if len(set(folders)) < len(folders):
        raise OffbenchError(f"{read.name}: an algorithm with the same settings is listed twice")
    for dataset in read.datasets:
        check_recorded(dataset)
    return Benchmark(read, tuple(variants), pick_machine(device, workers, stack, precision))


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


@dataclass(frozen=True)
class Cost:
    """What a line of a plan costs on this machine.

    Attributes:
        disk: bytes.
        products: floating-point operations in matrix products, counted on a CPU only.
    """

    seconds: float
    disk: float
    products: float = 0.0


def write_plan(
    bench: Benchmark, shard: tuple[int, int] = (0, 1), say: Callable[[str], None] = print
) -> dict[str, float]:
    """Measure what a grid's unfinished runs cost here, and write a line about each variant as soon as it is measured.

    Args:
        shard: (i, n): only the i-th of n shares of the runs.
        say: receives each line.

    Returns:
        Seconds per update of one run, evaluations included, by algorithm; empty if all runs are finished.
    """
    shares, (index, count) = shard_of(bench, shard), shard
    longer = sum(is_longer(spec) for share in shares for spec in share)
    to_train = [specs for share in shares if (specs := [spec for spec in share if not _is_done(spec)])]
    runs = sum(map(len, bench.variants))
    sizes = {"dataset": len(bench.grid.datasets), "variant": len(bench.variants), "run": runs}
    text = ", ".join(counted(size, noun) for noun, size in sizes.items())
    by_shard = f" by shard {index}/{count}" if count > 1 else ""
    say(f"{bench.grid.name}: {text}, {sum(map(len, to_train))} to train{by_shard}")
    if longer:
        say(f"  left as they are: {counted(longer, 'run')} with more updates than the grid's steps")
    if not to_train:
        return {}
    env_spec, step_time = _environment(bench)
    names = _names(to_train)
    name_width, steps_width = max(map(len, names)), max(len(f"{specs[0].steps:,}") for specs in to_train)
    costs, update_seconds = [], {}
    for name, specs in zip(names, to_train, strict=True):
        spec, rate = specs[0], measure(specs[0], env_spec, bench.machine.device)
        run_seconds = _run_seconds(spec, rate, step_time, env_spec)
        update_seconds[spec.algorithm] = run_seconds / spec.steps
        cost = _variant_cost(specs, rate, run_seconds, env_spec, bench.machine)
        size = f"{counted(len(specs), 'run'):>9} x {spec.steps:>{steps_width},} updates"
        say(f"  {name:<{name_width}}{size} at {rate.updates_per_second:>5,.0f}/s: {duration(cost.seconds)}")
        costs.append(cost)
    if missing := bench.missing():
        steps = sum(_size(dataset) for dataset in missing)
        say(f"  to record first: {', '.join(dataset.id for dataset in missing)} ({steps:,} transitions)")
        disk = sum(_size(dataset) * _bytes_per_step(env_spec, _episode_length(dataset)) for dataset in missing)
        costs.append(Cost(steps * step_time / bench.machine.workers, disk))
    for line in _totals(costs, bench.machine):
        say(line)
    return update_seconds


def _environment(bench: Benchmark) -> tuple[str, float]:
    """Return the EnvSpec of an environment of the grid, for the shapes, and the seconds of a step in all of them."""
    if chosen := bench.variants[0][0].env_spec:
        env_specs = [chosen]
    else:
        envs = dict.fromkeys(dataset.env for dataset in bench.grid.datasets if dataset.env)
        env_specs = [load_recipe(env).env_spec() for env in envs] or [_recorded_env_spec(bench.grid.datasets[0])]
    return env_specs[0], float(np.mean([step_seconds(env_spec) for env_spec in env_specs]))  # the shapes differ little


def _variant_cost(specs: Sequence[RunSpec], rate: Rate, run_seconds: float, env_spec: str, machine: Machine) -> Cost:
    left = sum(1 - spec.run.newest_checkpoint() / spec.steps for spec in specs)  # number of whole runs
    products = left * specs[0].steps * operations(specs[0], env_spec) if machine.device == "cpu" else 0.0
    return Cost(left * run_seconds / machine.processes, 2 * rate.bytes_per_run * len(specs), products)


def _totals(costs: Sequence[Cost], machine: Machine) -> Iterator[str]:
    cpu = machine.device == "cpu"
    processes = "one process" if machine.processes == 1 else f"{machine.processes} processes"
    where = f"{processes} of one thread" if cpu else machine.device
    seconds, disk = sum(cost.seconds for cost in costs), sum(cost.disk for cost in costs)
    yield f"  on {where} about {duration(seconds)}, {disk / 1e9:.1f} GB of disk (measured just now)"
    if cpu:
        products = sum(cost.products for cost in costs)
        yield (
            f"  on a GPU: not measured here; {products:.2g} operations in matrix products, which take "
            f"{duration(products / GPU_SPEED)} if it does {GPU_SPEED / 1e12:.0f} Tflop/s of them"
        )


def _is_done(spec: RunSpec) -> bool:
    return spec.run.finished(spec.steps) or spec.run.diverged or is_longer(spec)


def _run_seconds(spec: RunSpec, rate: Rate, step_time: float, env_spec: str) -> float:
    """Return the seconds of one run: its updates and its evaluations, full-length episodes assumed."""
    length = time_limit(parse_spec(env_spec)) or 1000
    episodes = -(-spec.steps // spec.eval_every) * spec.eval_episodes
    return spec.steps / rate.updates_per_second + episodes * length * step_time


def _recorded_env_spec(dataset: GridDataset) -> str:
    spec = evaluation_spec(minari_store.read_metadata(dataset.id))
    if spec is None:
        raise OffbenchError(f"{dataset.id} names no environment: give one to evaluate in with --env RECIPE")
    untrusted_env(spec, dataset.id).close()
    return spec


def _size(dataset: GridDataset) -> int:
    """Return about how many transitions a dataset to be recorded will have."""
    if dataset.steps or not dataset.env:
        return dataset.steps or 0
    _, parts = parse_level(dataset.level)
    return full_size(parts, load_recipe(dataset.env).dataset_steps)


def _episode_length(dataset: GridDataset) -> float:
    """Return about how long the episodes of a dataset to be recorded will be."""
    recipe = load_recipe(dataset.env)
    return expected_episode_length(recipe, dataset.level) or time_limit(parse_spec(recipe.env_spec())) or 1000


def _bytes_per_step(env_spec: str, episode_length: float) -> float:
    """Return the bytes of a transition on disk: in the dataset (float64 observations) and in the cache (float32)."""
    observations, actions = spaces_of(make_env(env_spec), "the environment")
    return 12 * observations.shape[0] + 8 * actions.shape[0] + 34 + BYTES_PER_EPISODE / episode_length


def _names(variants: Sequence[Sequence[RunSpec]]) -> list[str]:
    """Return the variants' methods as tables name them; those of one name with their datasets."""
    first = [specs[0] for specs in variants]
    names = [spec.label or method_of(spec.algorithm, spec.variant, settings_json(spec.config)).label for spec in first]
    datasets = [", ".join(dict.fromkeys(spec.dataset for spec in specs)) for specs in variants]
    return [f"{name} ({ids})" if names.count(name) > 1 else name for name, ids in zip(names, datasets, strict=True)]
