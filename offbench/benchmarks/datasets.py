"""A grid's datasets: those that are missing are recorded, the others are checked."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Iterator

from offbench.benchmarks.grid import GridDataset
from offbench.common.errors import LockedError, OffbenchError
from offbench.common.files import JsonObject
from offbench.common.terminal import inform
from offbench.data import minari_store
from offbench.data.collect import collect
from offbench.data.levels import full_size, parse_level
from offbench.envs.environments import same_environment
from offbench.envs.margin_rule import without_margin
from offbench.envs.recipes import Recipe, load_recipe

WAIT = 5.0  # seconds between two checks of a dataset that another process records


def record_dataset(dataset: GridDataset, workers: int) -> None:
    """Record a grid's dataset, or wait for the process that records it. Raises OffbenchError if it cannot be."""
    waiting = False
    while dataset.id not in minari_store.local_ids():
        try:
            collect(
                dataset.env,
                dataset.level,
                steps=dataset.steps,
                seed=dataset.seed,
                workers=workers,
                dataset_id=dataset.id,
            )
        except LockedError as error:  # another process records it, or trains its behaviour agent
            if not waiting:
                inform(error.waiting)
            waiting = True
            time.sleep(WAIT)
        except OffbenchError:
            if dataset.id not in minari_store.local_ids():  # else another process has just finished it
                raise


def check_recorded(dataset: GridDataset) -> None:
    """Check that a grid's dataset can be recorded or, if it exists already, is the one that the grid would record.

    Raises:
        OffbenchError: its id names no level of an environment that has a recipe, or it has another environment,
            level, seed or size.
    """
    exists = minari_store.exists(dataset.id)
    if not exists and not dataset.env:
        raise OffbenchError(
            f"{dataset.id} is neither a local dataset nor a level of an environment with a recipe; record or download "
            "it, or give its env and level in the grid"
        )
    if not exists or not dataset.env:
        return
    recipe = load_recipe(dataset.env)
    if differences := list(_differences(minari_store.read_metadata(dataset.id), dataset, recipe)):
        steps = f" --steps {dataset.steps}" if dataset.steps else ""
        seed = f" --seed {dataset.seed}" if dataset.seed else ""
        raise OffbenchError(
            f"the local dataset {dataset.id} does not match the grid: it has {', '.join(differences)}; record it "
            f"again (`offbench collect {shlex.quote(dataset.env)} --level {dataset.level}{steps}{seed} --id "
            f"{dataset.id} --overwrite`), or give in the grid another id, or the level, seed and steps of this dataset"
        )


def _differences(metadata: JsonObject, dataset: GridDataset, recipe: Recipe) -> Iterator[str]:
    spec = metadata.get("eval_env_spec") or metadata.get("env_spec")
    if spec and not same_environment(spec, without_margin(recipe.env_spec())[0]):
        env_id = json.loads(spec)["id"]
        yield f"environment {env_id}" + (
            f", not {recipe.env_id}" if env_id != recipe.env_id else " with other settings"
        )
    provenance = minari_store.read_provenance(metadata)
    if provenance.level is not None and _level_name(provenance.level) != _level_name(dataset.level):
        yield f"level {provenance.level}, not {dataset.level}"
    if provenance.contact_margin not in (None, recipe.contact_margin):
        yield f"contact_margin {provenance.contact_margin}, not {recipe.contact_margin}"
    if provenance.seed not in (None, dataset.seed):
        yield f"seed {provenance.seed}, not {dataset.seed}"
    _, parts = parse_level(dataset.level)
    if dataset.steps or parts[0].source != "replay":  # a replay is as long as its training
        steps = dataset.steps or full_size(parts, recipe.dataset_steps)
        if metadata.get(minari_store.KEY) and metadata.get("total_steps", steps) != steps:
            yield f"{metadata['total_steps']:,} transitions, not {steps:,}"


def _level_name(level: str) -> str:
    """Return a level as in dataset ids, so that 0.60 equals 0.6; anything else (a mix) unchanged."""
    try:
        return parse_level(level)[0]
    except (OffbenchError, AttributeError, TypeError):
        return level
