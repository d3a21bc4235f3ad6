"""`import-d4rl`: a D4RL file as a Minari dataset.

D4RL files are flat: row i is a transition, episodes lie end to end.

    v0   observations actions rewards terminals                     no timeouts: cut at the environment's time limit
    v1   ... timeouts infos/                                        a step at a timeout has no next observation
    v2   ... timeouts next_observations infos/ metadata/            complete

Where a file has no next_observations, the step at a timeout is dropped (its observation becomes the episode's last
one): bootstrapping over it would need an observation that the file lacks. D4RL's own loader does the same. After a
termination nothing is bootstrapped, so there the last observation stands in for the missing one. Both are noted in
the metadata, under `offbench`. infos/ are left out.
"""

from __future__ import annotations

import bisect
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, read_errors, sha256_of
from offbench.common.progress import Progress
from offbench.common.provenance import versions
from offbench.common.terminal import inform, warn
from offbench.data import minari_store, minari_writer
from offbench.data.d4rl_file import NUMBERS, SEEDS, Source, read_source
from offbench.data.minari_reader import flags
from offbench.data.recorded_env import evaluation_spec
from offbench.envs.environments import (
    Space,
    box,
    make_env,
    parse_spec,
    same_environment,
    spaces_of,
    time_limit,
    untrusted_env,
)
from offbench.envs.margin_rule import MARGIN_KEY, SUM_RULE, without_margin
from offbench.envs.recipes import D4RL_LIMIT, Recipe, d4rl_reference_of_env, load_recipe, shipped_recipes
from offbench.rollouts.rollouts import Episode, reset

BLOCK = 65_536  # rows read at once
RESETS = 64  # number of resets of the environment, to learn where episodes begin
WITHIN, BEYOND = 2.0, 6.0  # multiples of the spread of first observations: what is one, and what is none
# observations and actions of the environments that D4RL's own files were recorded in
ORIGINAL = {"Hopper-v2": (11, 3), "HalfCheetah-v2": (17, 6), "Walker2d-v2": (17, 6), "Ant-v2": (111, 8)}
LEVEL_WORDS = ("random", "medium", "expert", "mixed", "full")


def import_d4rl(file: str | Path, dataset_id: str, *, env: str | Path | None = None, overwrite: bool = False) -> str:
    """Turn a D4RL file (v0, v1, v2, or one that `offbench export` wrote) into a local Minari dataset.

    Args:
        file: the HDF5 file.
        dataset_id: the Minari id.
        env: the recipe of the environment that the file was recorded in, and that policies are evaluated in. By
            default it follows from a name such as `hopper_medium-v2.hdf5`, as D4RL's own files have it: recorded in
            Hopper-v2, evaluated in the shipped recipe. A file that `offbench export` wrote names it itself.
        overwrite: replace a dataset of that id.

    Returns:
        The id.

    Raises:
        OffbenchError: not such a file, damaged, NaN, without a whole transition, or without timeouts where the
            time limit is unknown; an environment that does not fit or cannot be guessed.
    """
    path = Path(file)
    minari_store.check_id(dataset_id)
    if not path.is_file():
        raise OffbenchError(f"no file {path}")
    try:
        with (
            read_errors(str(path), "is not a readable D4RL file", "download or export it again"),
            h5py.File(path) as opened,
        ):
            source = read_source(path, opened)
            origin = _origin(source, env)
            ends = _ends(source, origin)
            metadata, spaces = _metadata(source, origin, dataset_id)
            with (
                minari_store.claimed(dataset_id, overwrite) as folder,
                Progress(len(source), f"importing {path}") as bar,
            ):
                content = metadata[minari_store.KEY].get("content_sha256")
                episodes = _episodes(source, ends, bar)
                minari_writer.write(folder, episodes, origin.recorded, metadata, len(source), spaces, content)
    except FileNotFoundError as error:
        raise OffbenchError(f"{error.filename or path} is gone; run the command again") from None
    return dataset_id


@dataclass(frozen=True)
class _Origin:
    """The environment of a file.

    Attributes:
        recorded: the EnvSpec (JSON) of the environment it was recorded in, None if unknown.
        evaluated: EnvSpec of the environment to evaluate policies in.
        recipe: whose action bounds hold where the file has none.
        by_d4rl: whether D4RL itself recorded it, by its name: with a MuJoCo before 3.5.
    """

    recorded: str | None
    evaluated: str | None
    recipe: Recipe | None = None
    by_d4rl: bool = False

    @property
    def limit(self) -> int | None:
        """The time limit of the environment it was recorded in."""
        return time_limit(parse_spec(self.recorded)) if self.recorded else None


def _origin(source: Source, env: str | Path | None) -> _Origin:
    """Return a file's environment: what an export's metadata say, then what the user says, then by the file's name.

    Raises:
        OffbenchError: it cannot be told, or has other shapes than the file.
    """
    about, path = source.about, source.path
    exported = len(about.get("spaces", ())) == 2
    if env is not None:
        recipe = load_recipe(env)
        spec = recipe.env_spec()
        if (shapes := _shapes(spec)) != source.shapes:
            raise OffbenchError(
                f"{path} has {_words(source.shapes)}, {recipe.env_id} has {_words(shapes)}: give the right --env"
            )
        return _Origin(about.get("env_spec") or spec, spec, recipe)
    if exported or "env_spec" in about:
        return _Origin(about.get("env_spec"), about.get("eval_env_spec"))
    stem = path.stem.lower().replace("-", "_")
    for name in shipped_recipes():
        if stem.startswith(tuple(f"{name.replace('-', '_')}_{word}" for word in LEVEL_WORDS)):
            return _by_name(source, load_recipe(name))
    raise OffbenchError(f"cannot tell the environment of {path.name}; give it, e.g. --env hopper")


def _by_name(source: Source, recipe: Recipe) -> _Origin:
    """Return the environment of a file that is named like D4RL's own ones."""
    spec, family = recipe.env_spec(), recipe.env_id.rpartition("-v")[0]
    today = _shapes(spec)
    name = next((name for name in ORIGINAL if name.startswith(f"{family}-v")), None)
    if name is None:
        recorded, shapes = spec, today
    else:
        code = f"gym.envs.mujoco:{family}Env"
        recorded, shapes = EnvSpec(name, code, max_episode_steps=D4RL_LIMIT).to_json(), ORIGINAL[name]
    if shapes != source.shapes:
        raise OffbenchError(
            f"{source.path.name} is named like a file of {name or recipe.env_id}, which has {_words(shapes)}, but has "
            f"{_words(source.shapes)}; give its environment, e.g. --env my-env.toml"
        )
    if today == source.shapes:
        return _Origin(recorded, spec, recipe, by_d4rl=name is not None)
    warn(
        f"{source.path.name} is of {name}, which has {_words(shapes)}, and {recipe.env_id} has "
        f"{_words(today)}: policies are not evaluated"
    )
    return _Origin(recorded, None, recipe)


def _shapes(env_spec: str) -> tuple[int, int]:
    """Return the dimensions of observations and actions of an environment with flat spaces."""
    observations, actions = spaces_of(make_env(env_spec), "the environment")
    return observations.shape[0], actions.shape[0]


def _words(shapes: tuple[int, int]) -> str:
    return f"{shapes[0]} observations and {shapes[1]} actions"


def _ends(source: Source, origin: _Origin) -> dict[int, tuple[bool, bool]]:
    """Return {last row of an episode: (terminated, truncated)} in order.

    Without timeouts an episode is cut at the environment's time limit; the step at the limit counts as a timeout even
    where it terminates, as in D4RL. Where the next row is not the next observation, an episode ends whatever the
    flags say: it is truncated.
    """
    count, complete = len(source), "next_observations" in source.columns
    terminals = flags(source.read("terminals", 0, count), f"{source.path}: terminals")
    timeouts = np.zeros(count, bool)
    if "timeouts" in source.columns:
        timeouts |= flags(source.read("timeouts", 0, count), f"{source.path}: timeouts")
    stops = terminals | (_broken(source) if complete else timeouts)
    stops[-1] = True
    if "timeouts" not in source.columns:
        _cut_at_limit(source, origin, stops, timeouts)
    unflagged = int((stops & ~terminals & ~timeouts)[:-1].sum())
    if complete and 2 * unflagged > count:
        warn(
            f"{source.path}: the next_observations of {unflagged:,} of {count:,} rows are not the "
            "observations of the next row, so each is the end of an episode (rounded numbers, or shuffled rows?)"
        )
    last_rows = np.flatnonzero(stops | timeouts)
    return {int(i): (bool(terminals[i]), bool(timeouts[i] or not terminals[i])) for i in last_rows}


def _cut_at_limit(source: Source, origin: _Origin, stops: Array, timeouts: Array) -> None:
    """Cut the episodes of a file without timeouts, in place: at the environment's time limit, and at unflagged resets.

    Args:
        stops: whether each row [rows] is the last one of an episode; set at the resets.
        timeouts: whether the time limit ends an episode with each row [rows]; set at the limits.
    """
    limit, complete = origin.limit, "next_observations" in source.columns
    starts = np.zeros(len(source) + 1, bool) if complete else _starts(source, origin)
    if limit is None:
        if complete:
            return
        raise OffbenchError(
            f"{source.path} has no timeouts, and its environment no time limit to cut the episodes at; add the "
            "column timeouts, or give an --env with a limit ([env_kwargs] max_episode_steps)"
        )
    begin, resets = 0, 0
    for last in np.flatnonzero(stops | starts[1:]).tolist():
        # an unflagged reset is the clock's: late in an episode, or at the end of one that the file cuts off
        late = (last + 1 - begin) % limit >= limit // 2 or (begin == 0 and not starts[0])
        if stops[last] or late:
            resets += not stops[last]
            stops[last] = True
            timeouts[begin + limit - 1 : last + 1 : limit] = True
            begin = last + 1
    if resets:
        inform(f"{source.path} has {resets:,} resets within what its flags call one episode; cut there")


def _broken(source: Source) -> Array:
    """Return which rows' next observation is not the observation of the next row, in the lower of their precisions."""
    broken = np.zeros(len(source), bool)
    types = [source.columns[name].dtype for name in ("observations", "next_observations")]
    floats = all(np.issubdtype(kind, np.floating) for kind in types)
    common = min(types, key=lambda kind: kind.itemsize) if floats else np.result_type(*types)
    for first in range(0, len(source) - 1, BLOCK):
        following = source.read("observations", first + 1, min(len(source), first + 1 + BLOCK))
        reached = source.read("next_observations", first, first + len(following))
        with np.errstate(over="ignore"):
            broken[first : first + len(following)] = (following.astype(common) != reached.astype(common)).any(1)
    return broken


def _starts(source: Source, origin: _Origin) -> Array:
    """Return which rows [rows + 1] look like the first of an episode, the row before them being far from that.

    D4RL's v0 files have no timeouts, begin in the middle of an episode, and where only the clock ends episodes they
    have 999 rows of each: cut at the limit alone, each would hold a transition from one episode into the next. First
    observations lie where the environment's resets lie.
    """
    starts = np.zeros(len(source) + 1, bool)
    if origin.evaluated is None:
        warn(
            f"{source.path} has no timeouts, and without its environment an episode that begins "
            "before the time limit of the last one cannot be detected: each leaves one false transition"
        )
        return starts
    env = make_env(origin.evaluated) if origin.recipe else untrusted_env(origin.evaluated, str(source.path))
    first_ones = np.array([reset(env, seed) for seed in range(RESETS)], np.float64)
    env.close()
    middle, spread = (first_ones.max(0) + first_ones.min(0)) / 2, (first_ones.max(0) - first_ones.min(0)) / 2
    slack, was_away = 1e-6 * (1 + np.abs(middle)), np.array([True])
    for first in range(0, len(source), BLOCK):
        off = np.abs(source.read("observations", first, min(len(source), first + BLOCK)) - middle)
        away = np.concatenate([was_away, (off > BEYOND * spread + slack).any(1)])
        starts[first : first + len(off)] = away[:-1] & (off <= WITHIN * spread + slack).all(1)
        was_away = away[-1:]
    return starts


def _episodes(source: Source, ends: dict[int, tuple[bool, bool]], progress: Progress) -> Iterator[Episode]:
    """Yield the episodes, many rows read at once."""
    complete = "next_observations" in source.columns
    wanted = ("observations", "actions", "rewards", "next_observations", *SEEDS)
    lasts, begin, i, empty = list(ends), 0, 0, True
    while i < len(lasts):
        group = lasts[i : max(i + 1, bisect.bisect_left(lasts, begin + BLOCK))]  # the episodes within a block
        rows = {name: source.read(name, begin, group[-1] + 1) for name in wanted if name in source.columns}
        offset = begin
        for last in group:
            part = {name: values[begin - offset : last + 1 - offset] for name, values in rows.items()}
            where = f"rows {begin} to {last}"
            if not all(np.isfinite(values).all() for values in part.values()):
                raise OffbenchError(f"{source.path}: {where} contain NaN or infinite numbers; filter them out")
            episode = _episode(part, *ends[last], complete)
            if len(episode):
                empty = False
                yield episode
            begin = last + 1
        progress.to(begin)
        i += len(group)
    if empty:
        raise OffbenchError(
            f"{source.path}: none of its {len(source):,} rows has a next observation; there is nothing to import"
        )


def _episode(part: dict[str, Array], terminated: bool, truncated: bool, complete: bool) -> Episode:
    observations, actions, rewards = part["observations"], part["actions"], part["rewards"]
    if complete:
        observations = np.concatenate([observations, part["next_observations"][-1:]])
    elif terminated:
        observations = np.concatenate([observations, observations[-1:]])
    else:
        actions, rewards = actions[:-1], rewards[:-1]
    seeded = "infos/seed" in part and part.get("infos/seeded", [True])[0]
    seed = int(part["infos/seed"][0]) if seeded else -1
    return Episode(seed, observations, actions, rewards, terminated, truncated)


def _metadata(source: Source, origin: _Origin, dataset_id: str) -> tuple[JsonObject, tuple[Space, Space]]:
    """Return Minari's metadata and the spaces."""
    about, complete = source.about, "next_observations" in source.columns
    fields = {key: about[key] for key in (*NUMBERS, "requirements") if key in about}
    fields |= {key: set(about[key]) for key in ("author", "author_email") if key in about}
    provenance: JsonObject = {
        "format": "offbench-import-1",
        "timeouts": "kept" if complete else "dropped",
        "final_observations": "kept" if complete else "repeated",
        "d4rl": d4rl_reference_of_env(origin.recorded),
    }
    provenance |= about.get(minari_store.KEY, {})
    provenance["imported"] = {
        "file": source.path.name,
        "sha256": sha256_of(source.path),
        "offbench": versions()["offbench"],
    }
    where = f", recorded in {json.loads(origin.recorded)['id']}" if origin.recorded else ""
    metadata: JsonObject = fields | {
        "dataset_id": dataset_id,
        "minari_version": versions()["minari"],
        "algorithm_name": about.get("algorithm_name", "unknown"),
        "description": about.get("description", f"D4RL file {source.path.name}{where}."),
        minari_store.KEY: provenance,
    }
    if origin.evaluated:
        metadata["eval_env_spec"], rule = without_margin(origin.evaluated)
    minari_store.check_metadata(metadata, f"{source.path}: its offbench attribute", "export the dataset again")
    if origin.evaluated and origin.recipe:
        before = evaluation_spec(about)
        if before and not same_environment(before, origin.evaluated):
            warn(f"--env names another environment than {source.path} does, so its reference scores are left out")
            for key in ("ref_min_score", "ref_max_score"):
                metadata.pop(key, None)
            for key in ("references", MARGIN_KEY):
                provenance.pop(key, None)
            provenance["d4rl"] = d4rl_reference_of_env(metadata["eval_env_spec"])
        if rule == SUM_RULE or origin.by_d4rl:
            provenance[MARGIN_KEY] = rule
    return metadata, _spaces(source, origin.recipe)


def _spaces(source: Source, recipe: Recipe | None) -> tuple[Space, Space]:
    """Return the spaces: those an export kept, else the data's types with the recipe's action bounds."""
    about, observations, actions = source.about, source.columns["observations"], source.columns["actions"]
    kept = about.get("spaces", ())
    if len(kept) == 2:
        boxes = tuple(box(space, f"{source.path}: its offbench metadata") for space in kept)
        if [space.shape for space in boxes] != [observations.shape[1:], actions.shape[1:]]:
            raise OffbenchError(f"{source.path}: its offbench metadata has other shapes; export the dataset again")
        return boxes[0], boxes[1]
    high = np.ones(actions.shape[1:], np.float32)
    low = -high
    if recipe is not None:
        _, space = spaces_of(make_env(recipe.env_spec()), recipe.env_id)
        if space.shape == actions.shape[1:]:
            low, high = space.low, space.high
    kind = actions.dtype.type
    return (
        gym.spaces.Box(-np.inf, np.inf, observations.shape[1:], observations.dtype.type),
        gym.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind),
    )
