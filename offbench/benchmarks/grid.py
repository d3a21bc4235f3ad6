"""Grids: which algorithms, settings and seeds on which datasets, for how long, in one TOML file.

datasets = ["hopper-medium-v0", {id = "mine-v0", env = "./my-env.toml", level = "medium", steps = 20_000}]
seeds = 5                          # a count, or a list
steps = 1_000_000                  # with eval_every and eval_episodes as in `offbench train`
[[algorithms]]
name = "bdb"                       # or "./my_algo.py:ReBRAC"
                                   # then its settings; a list makes a variant per value (hidden: a list of lists)
beta = [0.25, "adaptive"]
label = "BDB"                      # its name in tables, if the settings are one variant
datasets = ["hopper-*"]            # optional: only those of the grid's datasets that match
steps = 500_000                    # optional: its own seeds, steps, eval_every and eval_episodes
"""

from __future__ import annotations

import dataclasses
import fnmatch
import importlib.resources
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import JsonObject, read_errors, read_text
from offbench.common.settings import build, setting, short_repr
from offbench.common.text import MAX_INT, MAX_SEEDS
from offbench.data import minari_store
from offbench.data.levels import env_and_level, level_argument, parse_level, recipe_and_level
from offbench.envs.recipes import load_recipe
from offbench.training.spec import TrainingSchedule

MAX_LABEL_LENGTH = 60


@dataclass(frozen=True)
class GridDataset:
    """A dataset of a grid, and how it is recorded if it is missing.

    Attributes:
        env: a recipe's name or file (relative to the grid's folder if it exists there, else to the current one);
            empty for a dataset that offbench cannot record.
    """

    id: str
    env: str = ""
    level: str = ""
    steps: int | None = setting(None, "transitions", low=1)
    seed: int = setting(0, "seed of the recording", low=0, high=MAX_INT)


@dataclass(frozen=True)
class GridAlgorithm:
    """An algorithm of a grid with its settings (each value of a list is a variant) and its schedule.

    Attributes:
        label: the name in tables, if the settings are one variant; empty for the usual name.
        datasets: the ids of those that it trains on.
    """

    algorithm: str
    settings: Mapping[str, object]
    schedule: TrainingSchedule
    datasets: tuple[str, ...]
    label: str = ""


@dataclass(frozen=True)
class Grid:
    """A whole benchmark."""

    name: str
    datasets: tuple[GridDataset, ...]
    algorithms: tuple[GridAlgorithm, ...]


def grids() -> Path:
    """Return the folder of the shipped grids."""
    return Path(str(importlib.resources.files("offbench"))) / "grids"


def shipped_grids() -> list[str]:
    """Return the names of the shipped grids."""
    return sorted(path.stem for path in grids().glob("*.toml"))


def load_grid(name: str) -> Grid:
    """Return a shipped grid by name (`paper-small`) or a grid file by path (`./mine.toml`).

    Raises:
        OffbenchError: no such grid, not TOML, an unknown key, a wrong type or value.
    """
    own = name.endswith(".toml") or "/" in name
    path = Path(name) if own else grids() / f"{name}.toml"
    if not own and name not in shipped_grids():
        raise unknown("grid", name, shipped_grids())
    where = path.name
    try:
        with read_errors(where, "is not a readable TOML file", "correct it, or give another"):
            values = tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise OffbenchError(f"no grid file {path}; shipped grids: {', '.join(shipped_grids())}") from None
    named = _list(values.pop("datasets", []), "datasets", where)
    entries = _list(values.pop("algorithms", []), "algorithms", where)
    schedule = _schedule(values, TrainingSchedule(), where)
    datasets = tuple(_dataset(value, path.parent, where) for value in named)
    ids = [dataset.id for dataset in datasets]
    return Grid(path.stem, datasets, tuple(_algorithm(value, schedule, ids, path.parent, where) for value in entries))


def _list(value: object, key: str, where: str) -> list[object]:
    if not isinstance(value, list) or not value:
        raise OffbenchError(f"{where}: {key} must be a list with at least one item")
    return value


def _schedule(values: JsonObject, default: TrainingSchedule, where: str) -> TrainingSchedule:
    """Return `default` with the changes in `values`."""
    merged = dataclasses.asdict(default) | values
    seeds = merged.pop("seeds")
    if isinstance(seeds, int) and not isinstance(seeds, bool) and 0 < seeds <= MAX_SEEDS:
        seeds = range(seeds)
    bad = not isinstance(seeds, Sequence) or any(type(s) is not int or not 0 <= s <= MAX_INT for s in seeds)
    if bad or len(set(seeds)) != len(seeds) or not len(seeds):
        raise OffbenchError(
            f"{where}: seeds must be a count up to {MAX_SEEDS:,} or a list of different whole numbers, not "
            f"{short_repr(seeds)}"
        )
    return build(TrainingSchedule, merged | {"seeds": tuple(seeds)}, where)


def _dataset(value: object, folder: Path, where: str) -> GridDataset:
    """Return a dataset from its id or a table, which may leave out what the id names; `folder` is the grid's."""
    if not isinstance(value, dict | str):
        raise OffbenchError(f"{where}: datasets must be ids or tables, not {short_repr(value)}")
    dataset = build(GridDataset, {"id": value} if isinstance(value, str) else value, f"{where}: datasets")
    minari_store.check_id(dataset.id)
    named = level_argument(env_and_level(dataset.id)[1])
    if dataset.env:
        beside = folder / dataset.env
        env = str(beside) if dataset.env.endswith(".toml") and beside.is_file() else dataset.env
        level = dataset.level or named or "medium"
    else:
        env, level = _recipe_of(dataset.id)
        level = dataset.level or level
    if not env and dataset != GridDataset(dataset.id):
        raise OffbenchError(f"{where}: {dataset.id} needs env, the recipe that its level, steps and seed belong to")
    if level:
        name, _ = parse_level(level)
        if named and name != parse_level(named)[0]:
            raise OffbenchError(
                f"{where}: the id {dataset.id} names the level {named}, not {level}; give it another id"
            )
    return dataclasses.replace(dataset, env=env, level=level)


def _recipe_of(dataset_id: str) -> tuple[str, str]:
    """Return the shipped recipe and the level that an id names, ("", "") if there is none.

    Datasets of another version (such as D4RL's), mixes and policies of one's own can be used but not recorded.
    """
    env, level = recipe_and_level(dataset_id)
    if env and dataset_id.rpartition("-v")[2] != str(load_recipe(env).version):
        return "", ""
    if minari_store.exists(dataset_id) and not env_and_level(dataset_id)[1]:
        return "", ""
    return env, level


def _algorithm(
    value: object, schedule: TrainingSchedule, ids: Sequence[str], folder: Path, where: str
) -> GridAlgorithm:
    if not isinstance(value, dict) or not isinstance(value.get("name"), str):
        raise OffbenchError(f"{where}: each of [[algorithms]] needs a name")
    own = {field.name for field in dataclasses.fields(TrainingSchedule)}
    entry = f"{where}: {value['name']}"
    changed = _schedule({key: item for key, item in value.items() if key in own}, schedule, entry)
    label = value.get("label", "")
    valid = (
        isinstance(label, str) and len(label) <= MAX_LABEL_LENGTH and label.isprintable() and label == label.strip()
    )
    if not valid:
        raise OffbenchError(
            f"{entry}: label must be a line of at most {MAX_LABEL_LENGTH} characters without spaces at its ends, "
            f"not {short_repr(label)}"
        )
    patterns = value.get("datasets", ["*"])
    for pattern in _list(patterns, "datasets", entry):
        if not isinstance(pattern, str) or not any(fnmatch.fnmatchcase(name, pattern) for name in ids):
            raise OffbenchError(
                f"{entry}: no dataset of this grid matches {short_repr(pattern)}; there are {', '.join(ids)}"
            )
    datasets = tuple(name for name in ids if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns))
    settings = {key: item for key, item in value.items() if key not in own | {"name", "label", "datasets"}}
    name = value["name"]
    beside = folder / name  # an algorithm's file may be named from the grid's folder
    file = ".py" in name and beside.with_suffix(".py").is_file()
    return GridAlgorithm(str(beside) if file else name, settings, changed, datasets, label)
