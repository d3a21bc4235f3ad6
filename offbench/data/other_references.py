"""Warn about datasets whose reference scores are not those of their environment's ladder."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

from offbench.agents.ladder import Ladder
from offbench.common.errors import OffbenchError
from offbench.common.terminal import warn
from offbench.data import minari_store
from offbench.envs.recipes import Recipe


def warn_other_references(recipe: Recipe, ladder: Ladder) -> None:
    """Warn about datasets of an environment that have other references than its ladder now."""
    wanted = _scale(ladder.info.references)
    others = []
    for dataset_id in minari_store.local_ids():
        with contextlib.suppress(OffbenchError):
            provenance = minari_store.read_provenance(minari_store.read_metadata(dataset_id))
            if provenance.env == recipe.name and _scale(provenance.references) not in (None, wanted):
                others.append(dataset_id)
    if others:
        warn(
            f"scores of {recipe.name} are now from {ladder.random_return:.1f} to "
            f"{ladder.expert_return:.1f}; recorded with other references, so not to be compared with: "
            f"{', '.join(others)}; record them again with --overwrite"
        )


def _scale(references: Mapping[str, Mapping[str, float]]) -> list[float] | None:
    try:
        return [references[name]["return"] for name in ("random", "expert")]
    except (KeyError, TypeError):
        return None
