"""The environment that a dataset belongs to: its EnvSpec, and the rule for contact margins it was recorded under."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.provenance import versions
from offbench.common.terminal import inform
from offbench.data import minari_store
from offbench.envs import environments
from offbench.envs.environments import Env, untrusted_env
from offbench.envs.margin_rule import MAX_RULE, MUJOCO_VERSIONS, SUM_RULE, with_margin
from offbench.envs.physics import margins_matter
from offbench.envs.recipes import load_recipe, shipped_recipes

# a clause of a requirement: `>=3.1.0,<3.2.0` has two
CLAUSE = re.compile(r"(==|~=|<=|>=|<|>)\s*(\d{1,6})(?:\.(\d{1,6})|(?!\.))")  # but not ==3.*


def make_env(name: str | Path, render_mode: str | None = None) -> Env:
    """Make a dataset's environment, or a recipe's, with the same physics on every MuJoCo version.

    Args:
        name: the id of a local dataset, a shipped recipe's name (`hopper`) or a recipe file (`./my-env.toml`).
        render_mode: as in `gymnasium.make`.

    Raises:
        OffbenchError: there is no such dataset or recipe, it names no environment, or that cannot be made.
    """
    name = str(name)
    if name in shipped_recipes() or Path(name).suffix == ".toml":
        return environments.make_env(load_recipe(name).env_spec(), render_mode)
    metadata = minari_store.read_metadata(name)
    spec = evaluation_spec(metadata)
    if spec is None:
        raise OffbenchError(f"{name} names no environment; give the name or the file of a recipe instead")
    untrusted_env(spec, name).close()
    report_margin_rule(name, metadata, spec)
    return environments.make_env(spec, render_mode)


def evaluation_spec(metadata: JsonObject) -> str | None:
    """Return the environment to evaluate a dataset's policies in, as EnvSpec JSON; None if it names none."""
    spec = metadata.get("eval_env_spec") or metadata.get("env_spec")
    return with_margin(spec, recorded_margin(metadata) or MAX_RULE) if spec else None


def recorded_margin(metadata: JsonObject) -> str | None:
    """Return the rule for contact margins that a dataset was recorded under; None if its metadata does not say."""
    provenance = minari_store.read_provenance(metadata)
    recorded = "versions" in (metadata.get(minari_store.KEY) or {})  # by offbench, first with the earlier rule alone
    if provenance.contact_margin or recorded:
        return provenance.contact_margin or MAX_RULE
    demands = (CLAUSE.findall(item) for item in _requirements(metadata) if re.match(r"\s*mujoco\b(?!-)", item))
    for operator, major, minor in itertools.chain.from_iterable(demands):
        version = (int(major), int(minor or 0))
        if operator in ("==", "~=", ">=", ">") and version >= (3, 5):
            return SUM_RULE
        if (operator in ("==", "<=") and version < (3, 5)) or (operator == "<" and version <= (3, 5)):
            return MAX_RULE
    return None


def _requirements(metadata: JsonObject) -> list[str]:
    listed = metadata.get("requirements")
    return list(map(str, listed)) if isinstance(listed, list) else []


def recorded_mujoco(metadata: JsonObject) -> str | None:
    """Return the MuJoCo version that a dataset records, or that a requirement pins; None if unknown."""
    if version := minari_store.read_provenance(metadata).versions.get("mujoco"):
        return version
    pinned = (re.fullmatch(r"mujoco\s*==\s*([\w.]+)", item) for item in _requirements(metadata))
    return next((match[1] for match in pinned if match), None)


def report_margin_rule(dataset_id: str, metadata: JsonObject, env_spec: str) -> None:
    """Print the contact-margin rule of a dataset's environment (EnvSpec JSON), unless it is the default or unused."""
    rule = recorded_margin(metadata)
    if rule == MAX_RULE or not margins_matter(env_spec):
        return
    since, installed = MUJOCO_VERSIONS[rule or MAX_RULE], versions()["mujoco"]
    message = f"{dataset_id}: contact margins as in MuJoCo {since} ({installed} is installed)"
    if rule is None:
        message += f"; its metadata does not say; `offbench verify {dataset_id}` can find out"
    else:
        message += ", which recorded it"
    inform(message)
