"""The datasets of runs, loaded and checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from offbench.common.code_hash import describe_changes
from offbench.common.terminal import inform, warn
from offbench.data import transitions
from offbench.data.minari_store import read_provenance
from offbench.data.recorded_env import report_margin_rule
from offbench.data.transitions import Transitions
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import check_spec
from offbench.envs.physics import warn_other_physics
from offbench.training.spec import RunSpec

Datasets = Mapping[str, Transitions]


def load_datasets(specs: Sequence[RunSpec]) -> dict[str, Transitions]:
    """Return the runs' datasets by name, with the environment to evaluate in if the runs name another.

    Raises OffbenchError if one is missing or damaged.
    """
    named = {spec.dataset: spec.env_spec for spec in specs}
    return {name: dataclasses.replace(transitions.load(name), evaluated_in=env) for name, env in named.items()}


def check_datasets(datasets: Datasets) -> None:
    """Check that the datasets' environments can be evaluated in, and warn of what may change the scores.

    Raises:
        OffbenchError: an environment cannot be made, or does not fit its dataset.
    """
    for name, data in datasets.items():
        if data.env_spec:
            from_recipe = data.evaluated_in is not None
            shape = data.observations.shape[1]
            check_spec(data.env_spec, name, shape, data.low, data.high, from_recipe=from_recipe)
            recorded = read_provenance(data.metadata)
            if not from_recipe:
                report_margin_rule(name, data.metadata, data.env_spec)
                if changed := describe_changes(recorded.env_code, environment_code(data.env_spec)):
                    warn(
                        f"{name} was recorded in other code of its environment: {changed}; scores may not be "
                        "comparable"
                    )
            warn_other_physics(name, recorded.versions, data.env_spec)
        else:
            inform(
                f"{name} names no environment, so nothing is evaluated during training; "
                "`offbench train --env RECIPE` names one"
            )
