"""The ladder: the rungs of a behaviour agent that recording needs, in one folder.

    ladder.json  ladder.csv  policies/*.safetensors  medium-replay.hdf5        (built by offbench.agents.build_ladder)

Returns are of the sampling policy, normalized between the uniform-random and the expert reference.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, exclusive_lock, open_regular, read_errors, read_json, write_errors
from offbench.common.scores import MAX_VALUE, are_references, normalize
from offbench.common.settings import read_back
from offbench.common.terminal import inform, warn
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import same_environment
from offbench.envs.margin_rule import MAX_RULE
from offbench.envs.physics import warn_other_physics
from offbench.envs.recipes import Recipe, load_recipe, shipped_recipes
from offbench.rollouts.policy import Policy, read_policy_file

BEHAVIOUR = Path("behaviour")  # default folder of all trainings
MEDIUM = 1 / 3  # fraction of the expert's normalized return
MEDIUM_AT_MOST = 0.45  # a rung beyond this is chosen as medium only if there is no other
MEDIUM_LIMITS = (0.2, 0.6)  # a medium outside these needs --accept
NEAR = 0.05  # maximum distance of a rung from a requested fraction; others need --accept
POLICY_NAME = re.compile(r"\w[\w.-]*\.safetensors")  # a file of the ladder's own folder, nothing else
REFERENCE = ("return", "low", "high", "episodes")  # what each reference must have


@dataclass(frozen=True)
class Rung:
    """One measured rung. `low` and `high` are the 95% interval of the mean return."""

    step: int
    role: str
    policy: str
    ret: float
    low: float
    high: float
    episodes: int


@dataclass(frozen=True)
class Replay:
    """The entry of medium-replay.hdf5 in ladder.json. `envs`: the recipe's `replay_envs`."""

    transitions: int
    sha256: str
    envs: int | None = None


@dataclass(frozen=True, kw_only=True)
class LadderInfo:
    """A ladder's ladder.json.

    Attributes:
        references: `return`, its interval `low` to `high`, and `episodes` of the policies `random` and `expert`.
        levels: the steps of the rungs `medium` and `expert`.
        env_code: hashes of the environment's code and files when the training began.
        seed, steps, hours, sac, hardware, versions, command: how the agent was trained.
    """

    env_id: str
    env_kwargs: JsonObject
    references: dict[str, dict[str, int | float]]
    levels: dict[str, int]
    medium_replay: Replay
    contact_margin: str = MAX_RULE
    env_code: dict[str, str] = field(default_factory=dict)
    seed: int = 0
    steps: int = 0
    hours: float = 0.0
    sac: JsonObject = field(default_factory=dict)
    hardware: JsonObject = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    command: str = ""


@dataclass(frozen=True)
class Ladder:
    """A ladder as read from its folder."""

    folder: Path
    info: LadderInfo
    rungs: tuple[Rung, ...]

    @property
    def random_return(self) -> float:
        """Mean return of the uniform-random policy: the reference's 0."""
        return float(self.info.references["random"]["return"])

    @property
    def expert_return(self) -> float:
        """Mean return of the expert: the reference's 100."""
        return float(self.info.references["expert"]["return"])

    def fraction(self, rung: Rung) -> float:
        """Return a rung's normalized return, 1 for the expert's."""
        return normalize(rung.ret, self.random_return, self.expert_return) / 100

    def nearest(self, fraction: float) -> Rung:
        """Return the kept rung whose measured normalized return lies nearest `fraction`."""
        return min(self.rungs, key=lambda rung: abs(self.fraction(rung) - fraction))

    def announce(self, rung: Rung, fraction: float) -> None:
        """Print which policy is played for a requested fraction of the expert's return."""
        inform(
            f"the policy nearest {fraction:g} is the one of step {rung.step:,}: return {rung.ret:.0f}, "
            f"{self.fraction(rung):.2f} of the expert's"
        )

    def neighbors(self, fraction: float) -> list[Rung]:
        """Return the rungs next to `fraction`: the nearest below it and the nearest above, if there are."""
        below = [rung for rung in self.rungs if self.fraction(rung) <= fraction]
        above = [rung for rung in self.rungs if self.fraction(rung) > fraction]
        return [*sorted(below, key=self.fraction)[-1:], *sorted(above, key=self.fraction)[:1]]

    def role(self, role: str) -> Rung:
        """Return the rung that is `medium` or `expert`."""
        return next(rung for rung in self.rungs if role in rung.role.split("+"))

    def load(self, rung: Rung) -> Policy:
        """Read a rung's policy."""
        return read_policy_file(self.folder / "policies" / rung.policy)

    def check(self, recipe: Recipe) -> None:
        """Raise OffbenchError if the ladder is of another environment than the recipe."""
        kwargs = json.loads(json.dumps(dict(recipe.env_kwargs)))
        built = (self.info.env_id, self.info.env_kwargs, self.info.contact_margin)
        wanted = (recipe.env_id, kwargs, recipe.contact_margin)
        if built != wanted:
            old, new = (f"{name} {arguments} with contact_margin {rule}" for name, arguments, rule in (built, wanted))
            raise OffbenchError(
                f"the ladder in {self.folder} is of {old}, the recipe is of {new}; delete that folder, or rename "
                "the recipe"
            )
        if changed := describe_changes(self.info.env_code, environment_code(recipe.env_spec())):
            raise OffbenchError(
                f"the behaviour agent in {self.folder.parent} was trained in other code of its environment: {changed}"
                "; delete that folder to train it again"
            )

    @property
    def replay(self) -> Path:
        """The transitions of medium-replay."""
        return self.folder / "medium-replay.hdf5"


def read_ladder(folder: Path) -> Ladder | None:
    """Read a ladder's folder, or return None if there is none. Raises OffbenchError if it is damaged."""
    if not (folder / "ladder.json").exists():
        return None
    remedy = f"delete {folder} and build it again with `offbench behaviour`"
    path = folder / "ladder.json"
    info = read_back(LadderInfo, read_json(path, remedy), path, remedy)
    with read_errors(f"the ladder in {folder}", "is damaged", remedy):
        with open(folder / "ladder.csv", newline="", encoding="utf-8", opener=open_regular) as file:
            rungs = tuple(_rung(row) for row in csv.DictReader(file) if row["policy"])
        ladder = Ladder(folder, info, rungs)
        numbers = [info.references[name][key] for name in ("random", "expert") for key in REFERENCE]
        if not all(abs(number) < MAX_VALUE for number in numbers):
            raise ValueError(f"its references must be finite and below {MAX_VALUE:g}")
        if not are_references(ladder.random_return, ladder.expert_return):
            raise ValueError("its references are equal, or out of order")
        if not (info.levels["medium"] and ladder.role("medium") and ladder.role("expert")):
            raise ValueError("it has no medium policy, or no expert")
        if gone := [rung.policy for rung in rungs if not (folder / "policies" / rung.policy).is_file()]:
            raise ValueError(f"it lacks policies/{gone[0]}")
    return ladder


def folder_of(recipe: Recipe, seed: int, behaviour_dir: Path) -> Path:
    """Return the folder of the training of a recipe and seed."""
    return behaviour_dir / recipe.name / f"seed-{seed}"


def shipped_ladder(recipe: Recipe) -> Ladder | None:
    """Return the ladder that is shipped with a recipe, if there is one."""
    return read_ladder(recipe.folder / "behaviour") if recipe.folder else None


def find_ladder(recipe: Recipe, behaviour_dir: Path = BEHAVIOUR, retrain: bool = False) -> Ladder | None:
    """Return the shipped ladder (unless `retrain`), else the one trained here, else None.

    Raises:
        OffbenchError: it is damaged, or of another environment.
    """
    shipped = None if retrain else shipped_ladder(recipe)
    trained = folder_of(recipe, 0, behaviour_dir) / "ladder"
    if not shipped and replaced_folder(trained).exists():
        with contextlib.suppress(OffbenchError), exclusive_lock(trained.parent / ".lock", str(trained)):
            restore_replaced(trained)
    ladder = shipped or read_ladder(trained)
    if ladder is None:
        return None
    ladder.check(recipe)
    if not shipped:
        inform(f"using the behaviour agent trained here: {ladder.folder}")
        _warn_other_recipe(ladder, recipe)
    elif behaviour_dir != BEHAVIOUR:
        inform(f"using the behaviour agent shipped with offbench, not one in {behaviour_dir}; `--retrain` uses that")
    warn_other_physics(f"the behaviour agent of {recipe.name}", ladder.info.versions, recipe.env_spec())
    return ladder


def replaced_folder(folder: Path) -> Path:
    """Return the path that a ladder has while another one replaces it."""
    return folder.with_name(f".{folder.name}.old")


def restore_replaced(folder: Path) -> None:
    """Restore a ladder whose writer was killed between its two renames; the training's lock must be held."""
    old = replaced_folder(folder)
    if not folder.exists() and (old / "ladder.json").is_file():
        with write_errors(str(folder)):
            old.replace(folder)


def _warn_other_recipe(ladder: Ladder, recipe: Recipe) -> None:
    """Warn about settings of the recipe that have changed since the agent was trained or measured."""
    used, wanted = ladder.info.sac, json.loads(json.dumps(dataclasses.asdict(recipe.sac)))
    changed = [key for key, value in wanted.items() if used.get(key, value) != value]
    if changed:
        warn(
            f"that agent was trained with other [sac] settings than the recipe's "
            f"({', '.join(changed)}); delete {ladder.folder.parent} to train it again"
        )
    measured = {
        "reference_episodes": (ladder.info.references["expert"]["episodes"], recipe.measure.reference_episodes),
        "replay_envs": (ladder.info.medium_replay.envs, recipe.replay_envs),
    }
    if changed := [key for key, (before, now) in measured.items() if before != now]:
        warn(
            f"the policies and references of that agent were measured with other settings than the recipe's "
            f"({', '.join(changed)}); `offbench behaviour` measures them again"
        )


def shipped_references(env_spec: str) -> tuple[float, float] | None:
    """Return the (random, expert) returns shipped for an environment (EnvSpec JSON); None if none are shipped."""
    for name in shipped_recipes():
        recipe = load_recipe(name)
        # the id first: making the spec of every recipe takes a while
        if recipe.env_id != json.loads(env_spec).get("id") or not same_environment(recipe.env_spec(), env_spec):
            continue
        if ladder := shipped_ladder(recipe):
            return ladder.random_return, ladder.expert_return
    return None


def _rung(row: dict[str, str]) -> Rung:
    mean, low, high = (float(row[key]) for key in ("return", "low", "high"))
    if not np.isfinite([mean, low, high]).all() or not POLICY_NAME.fullmatch(row["policy"]):
        raise ValueError(f"rung {row['step']} has a number that is not finite, or a bad policy name")
    return Rung(int(row["step"]), row["role"], row["policy"], mean, low, high, int(row["episodes"]))
