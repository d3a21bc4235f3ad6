"""A grid's datasets: recorded where they are missing, checked where they are here."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Iterator
from typing import Any

from offbench.benchmarks.grid import Source
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.collect import collect
from offbench.data.levels import full_size, parse_level
from offbench.envs.contact_margin import without_margin
from offbench.envs.environments import same_environment
from offbench.envs.recipes import Recipe, load_recipe

WAIT = 5.0  # seconds between two looks at a dataset that another process records


def record_source(source: Source, workers: int) -> None:
    """Record a grid's dataset, or wait for the process that is at it.

    Raises:
        OffbenchError: it is no level of a known environment, or cannot be recorded.
    """
    if not source.env:
        raise OffbenchError(
            f"{source.id} is no local dataset and no level of a known environment; "
            "record or download it, or write its env and level into the grid"
        )
    while source.id not in minari_store.local_ids():
        try:
            collect(
                source.env, source.level, steps=source.steps, seed=source.seed, workers=workers, dataset_id=source.id
            )
        except OffbenchError:
            # another process is at it, or has just done it
            if not minari_store.being_recorded(source.id) and source.id not in minari_store.local_ids():
                raise
            time.sleep(WAIT)


def check_recorded(source: Source) -> None:
    """Check that a grid's dataset, if it is here already, is what the grid would record.

    Raises:
        OffbenchError: it is of another environment, level, seed or size.
    """
    if not source.env or not minari_store.exists(source.id):
        return
    recipe = load_recipe(source.env)
    if differences := list(_differences(minari_store.read_metadata(source.id), source, recipe)):
        steps = f" --steps {source.steps}" if source.steps else ""
        seed = f" --seed {source.seed}" if source.seed else ""
        raise OffbenchError(
            f"the {source.id} that is here is not what the grid means: it has {', '.join(differences)}; record it "
            f"again (`offbench collect {shlex.quote(source.env)} --level {source.level}{steps}{seed} --id {source.id} "
            "--overwrite`), or write another id into the grid"
        )


def _differences(metadata: dict[str, Any], source: Source, recipe: Recipe) -> Iterator[str]:
    spec = metadata.get("eval_env_spec") or metadata.get("env_spec")
    if spec and not same_environment(spec, without_margin(recipe.env_spec())[0]):
        found = json.loads(spec)["id"]
        yield f"environment {found}" + (f", not {recipe.env_id}" if found != recipe.env_id else " with other settings")
    ours = minari_store.provenance(metadata)
    if "level" in ours and _name(ours["level"]) != _name(source.level):
        yield f"level {ours['level']}, not {source.level}"
    if ours.get("seed", source.seed) != source.seed:
        yield f"seed {ours['seed']}, not {source.seed}"
    _, parts = parse_level(source.level)
    if source.steps or parts[0].source != "replay":  # a replay is as long as the training made it
        wanted = source.steps or full_size(parts, recipe.dataset_steps)
        if ours and metadata.get("total_steps", wanted) != wanted:
            yield f"{metadata['total_steps']:,} transitions, not {wanted:,}"


def _name(level: Any) -> Any:
    """Return a level as ids have it, so that 0.60 is 0.6; what is none (a blend) as it is."""
    try:
        return parse_level(level)[0]
    except (OffbenchError, AttributeError, TypeError):
        return level
