"""What datasets are taken for: by a grid, and beside the other datasets of their environment."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
from collections.abc import Iterator
from typing import Any

from offbench import dataset
from offbench.environments import same_environment, without_margin
from offbench.errors import OffbenchError
from offbench.grid import Source
from offbench.ladder import Ladder
from offbench.levels import full_size, parse_level
from offbench.recipes import Recipe, load_recipe


def check_recorded(source: Source) -> None:
    """Check that a grid's dataset, if it is here already, is what the grid would record.

    Raises:
        OffbenchError: it is of another environment, level, seed or size.
    """
    if not source.env or not dataset.exists(source.id):
        return
    recipe = load_recipe(source.env)
    if differences := list(_differences(dataset.read_metadata(source.id), source, recipe)):
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
    ours = dataset.provenance(metadata)
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


def warn_other_references(recipe: Recipe, ladder: Ladder) -> None:
    """Say which datasets of an environment were recorded with other references than its ladder has now."""
    wanted = _scale(ladder.info["references"])
    others = []
    for dataset_id in dataset.local_ids():
        with contextlib.suppress(OffbenchError):
            ours = dataset.provenance(dataset.read_metadata(dataset_id))
            if ours.get("env") == recipe.name and _scale(ours.get("references")) not in (None, wanted):
                others.append(dataset_id)
    if others:
        print(
            f"offbench: warning: scores of {recipe.name} are now from {ladder.random_return:.1f} to "
            f"{ladder.expert_return:.1f}; recorded with other references, so not to be compared with: "
            f"{', '.join(others)}; record them again with --overwrite",
            file=sys.stderr,
        )


def _scale(references: Any) -> list[float] | None:
    try:
        return [references[name]["return"] for name in ("random", "expert")]
    except (KeyError, TypeError):
        return None
