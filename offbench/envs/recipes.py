"""Recipes: everything specific to one environment, in one TOML file.

A shipped recipe is named by its folder (`hopper`), any other by the path of its file (`./my-env.toml`).
Algorithms and levels do not depend on the names of environments.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import json
import re
import tomllib
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TypeVar

from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import read_errors, read_text
from offbench.common.scores import are_references
from offbench.common.settings import build, setting, short_repr
from offbench.envs.environments import PASSIVE_WRAPPERS, RENDERING_ARGUMENTS, env_spec
from offbench.envs.margin_rule import MARGIN_KEY, MAX_RULE, SUM_RULE, with_margin
from offbench.envs.physics import margins_matter

T = TypeVar("T")


@dataclass(frozen=True)
class SACSettings:
    """Settings of the behaviour agent: Stable-Baselines3's SAC, and the ladder of its policies."""

    steps: int = setting(1_000_000, "environment steps of the whole training", low=1)
    segment: int = setting(10_000, "environment steps between two rungs (and checkpoints)", low=1)
    envs: int = setting(4, "environments stepped together", low=1)
    gradient_steps: float = setting(0.25, "gradient steps for each environment step", above=0, high=16)
    learning_starts: int = setting(10_000, "environment steps of uniform actions before learning", low=0)
    learning_rate: float = setting(1e-3, "Adam's learning rate at the start", above=0)
    final_learning_rate: float = setting(3e-4, "learning rate at the end (linear in between)", above=0)
    batch_size: int = setting(256, "transitions for each gradient step", low=1)
    hidden: tuple[int, ...] = setting((256, 256), "hidden layers of actor and critics", low=1)
    discount: float = setting(0.99, "discount", low=0, high=1)
    tau: float = setting(0.005, "Polyak rate of the target critics", above=0, high=1)
    rung_episodes: int = setting(5, "episodes that screen each rung, stochastic and deterministic each", low=2)

    def cycle(self) -> tuple[int, int]:
        """Return (vectorized steps, gradient steps) of one iteration of the training loop, both whole numbers."""
        ratio = Fraction(self.gradient_steps * self.envs).limit_denominator(64)
        return ratio.denominator, ratio.numerator


@dataclass(frozen=True)
class Measurement:
    """Numbers of episodes and policies that are measured."""

    rung_episodes: int = setting(100, "episodes behind the return of a chosen rung", low=2)
    reference_episodes: int = setting(200, "episodes behind each reference score", low=2)
    rungs: int = setting(12, "policies kept for `--level FRACTION`", low=2)


@dataclass(frozen=True)
class Recipe:
    """One environment: how to make it, how to train its behaviour agent, what its datasets are called."""

    name: str
    env_id: str
    version: int = setting(0, "version in the ids of its datasets: hopper-medium-v0", low=0)
    dataset_steps: int = setting(1_000_000, "transitions of a recorded level", low=1)
    d4rl_min: float | None = setting(None, "D4RL's reference score of a random policy")
    d4rl_max: float | None = setting(None, "D4RL's reference score of an expert")
    contact_margin: str = setting(
        MAX_RULE, "contact margins of MuJoCo before 3.5 (max) or since (sum)", choices=(MAX_RULE, SUM_RULE)
    )
    replay_envs: int | None = setting(
        None, "environments of SAC's training that medium-replay keeps (default: all)", low=1
    )
    env_kwargs: tuple[tuple[str, object], ...] = ()
    sac: SACSettings = dataclasses.field(default_factory=SACSettings)
    measure: Measurement = dataclasses.field(default_factory=Measurement)
    folder: Path | None = dataclasses.field(default=None, compare=False, metadata={"internal": True})

    def env_spec(self) -> str:
        """Return the environment as Gymnasium's EnvSpec JSON. Raises OffbenchError if it cannot be made."""
        return with_margin(env_spec(self.env_id, **dict(self.env_kwargs)), self.contact_margin)

    def d4rl_reference(self) -> tuple[float, float] | None:
        """Return D4RL's reference returns (random, expert).

        None if the recipe has none, or changes the task that shipped ones belong to.
        """
        if self.d4rl_min is None or self.d4rl_max is None:
            return None
        if self.folder is None and _shipped_recipe(self.env_id):
            return d4rl_reference_of_env(self.env_spec())
        return self.d4rl_min, self.d4rl_max

    def sha256(self) -> str:
        """Return the SHA-256 of the recipe's values, which its layout and comments do not affect."""
        values = {k: v for k, v in dataclasses.asdict(self).items() if k != "folder"}
        for name, default in (("contact_margin", MAX_RULE), ("replay_envs", None)):
            if values[name] == default:
                del values[name]  # settings of later versions: earlier hashes stay valid
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def recipes_folder() -> Path:
    """Return the folder with the shipped recipes."""
    return Path(str(importlib.resources.files("offbench"))) / "datasets"


def shipped_recipes() -> list[str]:
    """Return the names of the shipped recipes."""
    return sorted(path.parent.name for path in recipes_folder().glob("*/recipe.toml"))


def load_recipe(name: str | Path) -> Recipe:
    """Return a shipped recipe by name (`hopper`), or a recipe file by path (`./my-env.toml`).

    Raises:
        OffbenchError: no such recipe, not TOML, an unknown key, a wrong type or value.
    """
    name = str(name)
    if name.endswith(".toml") or "/" in name:
        return read_recipe(Path(name), folder=None)
    path = recipes_folder() / name / "recipe.toml"
    if name not in shipped_recipes():
        raise unknown("environment", name, shipped_recipes())
    return read_recipe(path, folder=path.parent)


def read_recipe(path: Path, folder: Path | None) -> Recipe:
    """Read one recipe file. `folder` is where its behaviour weights are shipped, if they are."""
    where = str(path) if folder is None else f"recipe of {folder.name}"
    try:
        with read_errors(where, "is not a readable TOML file", "correct it, or name another"):
            values = tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise OffbenchError(
            f"no recipe file {path}; write one, or name a shipped one: {', '.join(shipped_recipes())}"
        ) from None
    values.setdefault("name", path.stem if folder is None else folder.name)

    def table(cls: type[T], key: str) -> T:
        return build(cls, _table(values.pop(key, {}), key, where), f"{where}: [{key}]")

    kwargs = _kwargs(values.pop("env_kwargs", {}), where)
    sac, measure = table(SACSettings, "sac"), table(Measurement, "measure")
    recipe = build(Recipe, values, where)
    recipe = dataclasses.replace(recipe, env_kwargs=kwargs, folder=folder, sac=sac, measure=measure)
    _check(recipe, where)
    shipped_one = load_recipe(recipe.name) if folder is None and recipe.name in shipped_recipes() else recipe
    if recipe.env_id != shipped_one.env_id:
        raise OffbenchError(
            f"{where}: {recipe.name} is a shipped environment, {shipped_one.env_id}, and its datasets would have the "
            "same ids; give the recipe another name (its file's, or `name = ...`)"
        )
    return recipe


def _table(value: object, key: str, where: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise OffbenchError(f"{where}: {key} must be a table, not {short_repr(value)}")
    return value


def _kwargs(value: object, where: str) -> tuple[tuple[str, object], ...]:
    table = _table(value, "env_kwargs", where)
    try:
        json.dumps(table)
    except (TypeError, ValueError, RecursionError):  # a date, a number of 5000 digits
        allowed = "numbers, text, true, false, lists and tables"
        raise OffbenchError(f"{where}: env_kwargs can only contain {allowed}") from None
    return tuple(sorted(table.items()))


def _check_references(recipe: Recipe, where: str) -> None:
    low, high = recipe.d4rl_min, recipe.d4rl_max
    if low is None or high is None:
        if low != high:
            raise OffbenchError(f"{where}: give both d4rl_min and d4rl_max, or neither")
        return
    if not are_references(low, high):
        raise OffbenchError(f"{where}: d4rl_min and d4rl_max must be returns in this order, not {low}, {high}")
    shipped = _shipped_recipe(recipe.env_id) if recipe.folder is None else None
    if shipped and shipped.d4rl_min is not None and shipped.d4rl_max is not None:
        rounding = 1e-3 * (shipped.d4rl_max - shipped.d4rl_min)
        if max(abs(low - shipped.d4rl_min), abs(high - shipped.d4rl_max)) > rounding:
            raise OffbenchError(
                f"{where}: d4rl_min and d4rl_max of {recipe.env_id} are {shipped.d4rl_min} and {shipped.d4rl_max} in "
                "D4RL; correct them, or leave them out"
            )


def _check(recipe: Recipe, where: str) -> None:
    if not recipe.name.replace("-", "").replace("_", "").isalnum() or not recipe.name[0].isalnum():
        raise OffbenchError(
            f"{where}: name must begin with a letter or digit and have letters, digits, - and _ only, not "
            f"{recipe.name!r}"
        )
    _check_references(recipe, where)
    sac = recipe.sac
    if not sac.cycle()[1]:
        raise OffbenchError(f"{where}: [sac] gradient_steps x envs must be at least 1/64")
    if sac.learning_starts >= sac.steps:
        raise OffbenchError(
            f"{where}: [sac] learning_starts {sac.learning_starts:,} leaves none of {sac.steps:,} steps to learn in"
        )
    turn = sac.cycle()[0] * sac.envs
    if sac.segment % turn:
        raise OffbenchError(f"{where}: [sac] segment must be a multiple of {turn} (envs x the steps of a turn)")


D4RL_TASK = re.compile(r"(\w+)-v[2-5]", re.ASCII)
D4RL_CODE = ("gymnasium.envs.mujoco", "gym.envs.mujoco")
D4RL_LIMIT = 1000  # steps of an episode of D4RL's MuJoCo tasks


def _shipped_recipe(env_id: str) -> Recipe | None:
    """Return the shipped recipe of an environment's task, of any of D4RL's and Gymnasium's versions v2 to v5."""
    task = D4RL_TASK.fullmatch(env_id)
    return next((r for r in map(load_recipe, shipped_recipes()) if task and r.env_id.startswith(f"{task[1]}-v")), None)


def d4rl_reference_of_env(env_spec: str | None) -> tuple[float, float] | None:
    """Return D4RL's reference returns (random, expert) of an environment (EnvSpec JSON).

    They hold for the standard task alone (its versions v2 to v5): None for any other environment, and where arguments,
    time limit, wrappers or contact margins are not the standard ones.
    """
    fields = json.loads(env_spec or "{}")
    recipe = _shipped_recipe(str(fields.get("id")))
    if recipe is None or recipe.d4rl_min is None or recipe.d4rl_max is None:
        return None
    wrappers = {str(wrapper.get("name")) for wrapper in fields.get("additional_wrappers") or ()}
    standard = (
        str(fields.get("entry_point")).startswith(D4RL_CODE)
        and fields.get("max_episode_steps") == D4RL_LIMIT
        and not (fields.get("kwargs") or {}).keys() - RENDERING_ARGUMENTS
        and wrappers <= PASSIVE_WRAPPERS
    )
    if standard and fields.get(MARGIN_KEY) == SUM_RULE:
        standard = not margins_matter(str(env_spec))
    return (recipe.d4rl_min, recipe.d4rl_max) if standard else None
