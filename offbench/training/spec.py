"""What is to be trained: one run (RunSpec), and a group of runs that train together (Job).

grid or command -> specs_of -> RunSpec -> group -> Job -> train_job (offbench.training.jobs)
"""

from __future__ import annotations

import dataclasses
import itertools
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard
from urllib.parse import quote

from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import JsonObject, sha256
from offbench.common.settings import check, fields, setting, without_numpy
from offbench.training.loggers import NO_LOGGERS, LoggerOptions
from offbench.training.registry import load_algorithm, register
from offbench.training.run import Run
from offbench.training.source_code import code_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MAX_FILE_NAME_BYTES = 255  # on the usual file systems


@dataclass(frozen=True)
class TrainingSchedule:
    """The seeds of an algorithm's runs, their number of updates, and how often they are evaluated."""

    seeds: tuple[int, ...] = (0,)
    steps: int = setting(1_000_000, "updates", low=1)
    eval_every: int = setting(5_000, "updates between evaluations", low=1)
    eval_episodes: int = setting(10, "episodes per evaluation", low=1)


@dataclass(frozen=True)
class RunSpec:
    """One run that is to be trained.

    Attributes:
        algorithm: the algorithm's name, as `load_algorithm` takes it.
        config: the algorithm's settings, an instance of its `Config`.
        dataset: the id of a local Minari dataset.
        steps: updates of the whole run.
        eval_every, eval_episodes: updates between evaluations, and episodes per evaluation.
        folder: the run's folder.
        precision: precision of matrix multiplications.
        env_spec: the environment to evaluate in (EnvSpec JSON) instead of the dataset's.
        label: the method's name in tables, empty for the usual one.
    """

    algorithm: str
    config: DataclassInstance
    dataset: str
    seed: int
    steps: int
    eval_every: int
    eval_episodes: int
    folder: Path
    precision: str = "float32"
    env_spec: str | None = None
    label: str = ""

    @property
    def run(self) -> Run:
        """The run's folder with its files."""
        return Run(self.folder)

    @property
    def variant(self) -> str:
        """The settings that differ from their defaults."""
        return variant_name(self.config, self.precision)

    @property
    def schedule(self) -> tuple[int, int, int]:
        """What runs of one job must share in addition to their algorithm: steps, eval_every, eval_episodes."""
        return self.steps, self.eval_every, self.eval_episodes


@dataclass(frozen=True)
class Job:
    """A group of runs that train as one program, in one process.

    Attributes:
        specs: the runs; algorithm, schedule, precision and environment are the same for all.
        device: PyTorch's name of the device.
        workers: evaluation processes; 0 evaluates in the training process.
        deadline: `time.time()` after which the job stops at the next chunk, with a checkpoint; None for never.
        loggers: the optional loggers.
        cost: relative cost of an update of one run; orders the jobs and weights the time left.
    """

    specs: tuple[RunSpec, ...]
    device: str
    workers: int = 0
    deadline: float | None = None
    loggers: LoggerOptions = NO_LOGGERS
    cost: float = 1.0

    @property
    def first(self) -> RunSpec:
        """The first run, for what all runs share."""
        return self.specs[0]

    @property
    def updates(self) -> int:
        """Updates of all its runs together."""
        return len(self.specs) * self.first.steps

    @property
    def work(self) -> float:
        """The cost of all updates, relative to the other jobs."""
        return self.updates * self.cost

    @property
    def deadline_passed(self) -> bool:
        """Whether the deadline has passed."""
        return self.deadline is not None and time.time() > self.deadline

    @property
    def title(self) -> str:
        """The job in messages."""
        runs = f" ({len(self.specs)} runs)" if len(self.specs) > 1 else ""
        return f"{self.first.algorithm} on {self.first.dataset}{runs}"


def specs_of(
    algorithm: str | Path | type,
    settings: Mapping[str, object],
    datasets: Sequence[str],
    schedule: TrainingSchedule,
    runs: Path,
    precision: str = "float32",
    env_spec: str | None = None,
    label: str = "",
) -> list[tuple[RunSpec, ...]]:
    """Return the runs of one algorithm on datasets: a tuple per combination of settings (variant).

    Args:
        algorithm: a registered name, a file `./my_algo.py:ReBRAC`, or a class.
        settings: values by name; a list of values is varied.
        runs: the folder of all run folders.
        env_spec: the environment to evaluate in (EnvSpec JSON) instead of the datasets'.
        label: the name in tables, if the settings are one variant.

    Raises:
        OffbenchError: an unknown algorithm or setting, a bad value, or a label for several variants.
    """
    algorithm, variants = register(algorithm), []
    code_of(algorithm)  # hashed as imported now: its files may change before the runs are claimed
    configs = configurations(load_algorithm(algorithm).Config, settings, algorithm)
    if label and len(configs) > 1:
        raise OffbenchError(
            f"{algorithm}: the label {label!r} names one variant, and the settings are {len(configs)}; "
            "give each an entry of its own"
        )
    for config in configs:
        name = variant_name(config, precision)
        variants.append(
            tuple(
                RunSpec(
                    algorithm,
                    config,
                    dataset,
                    seed,
                    schedule.steps,
                    schedule.eval_every,
                    schedule.eval_episodes,
                    run_folder(runs, dataset, algorithm, name, seed),
                    precision,
                    env_spec,
                    label,
                )
                for dataset, seed in itertools.product(datasets, schedule.seeds)
            )
        )
    return variants


def configurations(
    cls: type[DataclassInstance], settings: Mapping[str, object], algorithm: str
) -> list[DataclassInstance]:
    """Return the different configs of the product of all lists in `settings`. Raises OffbenchError for a bad one."""
    valid, columns = fields(cls), []
    for name, value in settings.items():
        if name not in valid:
            raise unknown(f"setting of {algorithm}", name, valid)
        value = without_numpy(value)
        values = list(value) if _is_varied(value, valid[name].default) else [value]
        if not values:
            raise OffbenchError(f"{algorithm}: {name} is an empty list")
        if len(values) > 1 and isinstance(valid[name].default, tuple):
            _check_lists(values, f"{algorithm}: {name}")
        columns.append([(name, check(cls, name, item, algorithm)) for item in values])
    return list(dict.fromkeys(cls(**dict(row)) for row in itertools.product(*columns)))


def _is_varied(value: object, default: object) -> TypeGuard[Sequence[object]]:
    """Return whether a list holds values of a setting, rather than being one value, as (64, 64) is of `hidden`."""
    if not isinstance(value, list | tuple):
        return False
    return not isinstance(default, tuple) or any(isinstance(item, list | tuple | str) for item in value)


def _check_lists(values: Sequence[object], what: str) -> None:
    """Refuse `64 64`, which may mean one network of two layers or two of one."""
    if any(isinstance(item, str) and not re.search("[,x]", item) for item in values):
        typed = [str(item) for item in values]
        raise OffbenchError(
            f"{what} takes lists such as 32,32 64,64, not {' '.join(typed)}; one list is {','.join(typed)}"
        )


def run_folder(root: Path, dataset_id: str, algorithm: str, variant: str, seed: int) -> Path:
    """Return runs/<dataset>/<algorithm>/<variant>/seed-<n>; a long variant is cut and ends in its hash."""
    return root / dataset_id / algorithm / folder_name(variant) / f"seed-{seed}"


def folder_name(variant: str) -> str:
    """Return the name of a variant's folder: the variant itself, if a file system takes a name that long."""
    if len(variant.encode()) <= MAX_FILE_NAME_BYTES:
        return variant
    ending = f"...{sha256(variant.encode())[:16]}"
    return variant.encode()[: MAX_FILE_NAME_BYTES - len(ending)].decode(errors="ignore") + ending


def variant_name(config: DataclassInstance, precision: str = "float32") -> str:
    """Return a config's name, from the settings that differ from their defaults: `default` or `alpha=1,beta=0.5`.

    A precision other than float32 is the last of them: `beta=0.5,precision=bfloat16`.
    """
    parts = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            parts.append(f"{field.name}={_setting_text(value)}")
    if precision != "float32":
        parts.append(f"precision={precision}")
    return ",".join(parts) or "default"


def _setting_text(value: object) -> str:
    if isinstance(value, tuple):
        texts = (_setting_text(item).replace("x", "%78") if isinstance(item, str) else str(item) for item in value)
        return "x".join(texts)
    if isinstance(value, float):
        return short if float(short := f"{value:g}") == value else repr(value)
    return quote(value, safe="") if isinstance(value, str) else str(value).lower()


def settings_json(config: DataclassInstance) -> JsonObject:
    """Return a config as config.json stores it (tuples become lists)."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(config).items()}
