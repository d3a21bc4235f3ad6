"""`import-d4rl`: a D4RL file as a Minari dataset, with its first environment on record.

D4RL files are flat: row i is a transition, episodes lie end to end.

    v0   observations actions rewards terminals                     cut every 1000 steps (no timeouts)
    v1   ... timeouts infos/                                        a step at a timeout has no next observation
    v2   ... timeouts next_observations infos/ metadata/            all there

Where a file has no next_observations, the step at a timeout is dropped (its observation becomes the episode's last
one): bootstrapping over it would need an observation that the file lacks. D4RL's own loader does the same. After a
termination nothing is bootstrapped, so there the last observation stands in for the missing one. Both are said in
the metadata, under `offbench`. infos/ are left out.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import sha256_of
from offbench.common.progress import Progress
from offbench.common.provenance import versions
from offbench.data import minari_store
from offbench.data.d4rl_file import NUMBERS, Source, read_source
from offbench.envs.contact_margin import ADDED, MARGIN, without_margin
from offbench.envs.environments import box, make_env
from offbench.envs.recipes import Recipe, d4rl_constants, load_recipe, names
from offbench.rollouts.rollouts import Episode

LIMIT = 1000  # steps of an episode of D4RL's MuJoCo tasks
BLOCK = 65_536  # rows read at once
ORIGINAL = {"Hopper": "Hopper-v2", "HalfCheetah": "HalfCheetah-v2", "Walker2d": "Walker2d-v2", "Ant": "Ant-v2"}
LEVEL_WORDS = ("random", "medium", "expert", "mixed", "full")


def import_d4rl(file: str | Path, dataset_id: str, *, env: str | None = None, overwrite: bool = False) -> str:
    """Turn a D4RL file (v0, v1, v2, or one that `offbench export` wrote) into a local Minari dataset.

    Args:
        file: the HDF5 file.
        dataset_id: the Minari id.
        env: the recipe to evaluate in; guessed from names such as `hopper_medium-v2.hdf5`.
        overwrite: replace a dataset of that id.

    Returns:
        The id.

    Raises:
        OffbenchError: not such a file, damaged, NaN, an environment that does not fit or cannot be guessed.
    """
    path = Path(file)
    minari_store.check_id(dataset_id)
    if not path.is_file():
        raise OffbenchError(f"no file {path}")
    try:
        with h5py.File(path, "r") as opened:
            source = read_source(path, opened)
            recipe = _recipe(path, env, source)
            ends = _ends(source, LIMIT)
            metadata, spec, spaces = _metadata(source, recipe, env is not None, dataset_id)
            with (
                minari_store.claimed(dataset_id, overwrite) as place,
                Progress(len(source), f"importing {path}") as bar,
            ):
                known = metadata[minari_store.KEY].get("content_sha256")
                minari_store.write(place, _episodes(source, ends, bar), spec, metadata, len(source), spaces, known)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:  # h5py raises all of these for damage
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise OffbenchError(f"{path} is not a readable D4RL file: {reason}") from None
    return dataset_id


def _recipe(path: Path, env: str | None, source: Source) -> Recipe | None:
    """Return the recipe of a file's environment: what the user says, else by its name; None if the file knows."""
    if env is not None:
        return load_recipe(env)
    if "env_spec" in source.about:
        return None
    word, _, rest = path.stem.lower().replace("-", "_").partition("_")
    found = [name for name in names() if word and name.replace("-", "_").startswith(word)]
    if len(found) != 1 or not rest.startswith(LEVEL_WORDS):
        raise OffbenchError(f"cannot tell the environment of {path.name}; give it, e.g. --env hopper")
    return load_recipe(found[0])


def _ends(source: Source, limit: int) -> dict[int, tuple[bool, bool]]:
    """Return {last row of an episode: (terminated, truncated)} in order.

    Without timeouts an episode is cut every `limit` rows; the step at the limit counts as a timeout even where it
    terminates, as in D4RL. Where next_observations do not go on in the next row, an episode ends there whatever the
    flags say: it is truncated.
    """
    count = len(source)
    terminals = source.read("terminals", 0, count).astype(bool)
    stops = terminals | _broken(source)
    stops[-1] = True
    if "timeouts" in source.columns:
        timeouts = source.read("timeouts", 0, count).astype(bool)
    else:
        timeouts, begin = np.zeros(count, bool), 0
        for last in np.flatnonzero(stops).tolist():
            timeouts[begin + limit - 1 : last + 1 : limit] = True
            begin = last + 1
    found = np.flatnonzero(stops | timeouts)
    return {int(i): (bool(terminals[i]), bool(timeouts[i] or not terminals[i])) for i in found}


def _broken(source: Source) -> Array:
    """Return which rows' next observation is not the observation of the row behind."""
    broken = np.zeros(len(source), bool)
    if "next_observations" in source.columns:
        for first in range(0, len(source) - 1, BLOCK):
            following = source.read("observations", first + 1, min(len(source), first + 1 + BLOCK))
            reached = source.read("next_observations", first, first + len(following))
            broken[first : first + len(following)] = (following != reached).any(1)
    return broken


def _episodes(source: Source, ends: dict[int, tuple[bool, bool]], progress: Progress) -> Iterator[Episode]:
    """Yield the episodes, many rows read at once."""
    complete, lasts, begin, i = "next_observations" in source.columns, list(ends), 0, 0
    while i < len(lasts):
        group = [lasts[i]]
        while i + len(group) < len(lasts) and lasts[i + len(group)] - begin < BLOCK:
            group.append(lasts[i + len(group)])
        wanted = ("observations", "actions", "rewards", "next_observations", "infos/seed")
        names_ = [name for name in wanted if name in source.columns]
        rows = {name: source.read(name, begin, group[-1] + 1) for name in names_}
        offset = begin
        for last in group:
            part = {name: values[begin - offset : last + 1 - offset] for name, values in rows.items()}
            where = f"rows {begin} to {last}"
            if not all(np.isfinite(values).all() for values in part.values()):
                raise OffbenchError(f"{source.path}: {where} hold NaN or infinite numbers; filter them out")
            episode = _episode(part, *ends[last], complete)
            if len(episode):
                yield episode
            begin = last + 1
        progress.to(begin)
        i += len(group)


def _episode(part: dict[str, Array], terminated: bool, truncated: bool, complete: bool) -> Episode:
    observations, actions, rewards = part["observations"], part["actions"], part["rewards"]
    if complete:
        observations = np.concatenate([observations, part["next_observations"][-1:]])
    elif terminated:
        observations = np.concatenate([observations, observations[-1:]])
    else:
        actions, rewards = actions[:-1], rewards[:-1]
    seed = int(part["infos/seed"][0]) if "infos/seed" in part else -1
    return Episode(seed, observations, actions, rewards, terminated, truncated)


def _metadata(
    source: Source, recipe: Recipe | None, demanded: bool, dataset_id: str
) -> tuple[dict[str, Any], str, tuple[gym.Space[Any], gym.Space[Any]]]:
    """Return Minari's metadata, the EnvSpec the data were recorded in, and the spaces."""
    about, complete = source.about, "next_observations" in source.columns
    spec = about.get("env_spec") or _original(recipe)
    known = {key: about[key] for key in (*NUMBERS, "requirements") if key in about}
    known |= {key: set(about[key]) for key in ("author", "author_email") if key in about}
    evaluated = _evaluated(source, recipe, demanded) if recipe else about.get("eval_env_spec")
    env_id = str(json.loads(spec)["id"])
    ours: dict[str, Any] = {
        "format": "offbench-import-1",
        "timeouts": "kept" if complete else "dropped",
        "final_observations": "kept" if complete else "repeated",
        "d4rl": d4rl_constants(env_id),
    }
    ours |= about.get(minari_store.KEY, {})
    ours["imported"] = {
        "file": source.path.name,
        "sha256": sha256_of(source.path),
        "offbench": versions()["offbench"],
    }
    metadata: dict[str, Any] = known | {
        "dataset_id": dataset_id,
        "minari_version": versions()["minari"],
        "algorithm_name": about.get("algorithm_name", "unknown"),
        "description": about.get("description", f"D4RL file {source.path.name}, recorded in {env_id}."),
        minari_store.KEY: ours,
    }
    if evaluated:
        metadata["eval_env_spec"], rule = without_margin(evaluated)
        if recipe and rule == ADDED:
            ours[MARGIN] = rule
    return metadata, spec, _spaces(source, recipe)


def _original(recipe: Recipe | None) -> str:
    """Return the EnvSpec of the environment a D4RL file was recorded in; today's Gymnasium cannot make it."""
    assert recipe is not None  # without metadata of ours there is one
    family = re.fullmatch(r"(.*)-v\d+", recipe.env_id)
    name = ORIGINAL.get(family[1] if family else "")
    if name is None:
        return recipe.env_spec()
    spec = EnvSpec(name, f"gym.envs.mujoco:{name.partition('-')[0]}Env", max_episode_steps=LIMIT)
    return spec.to_json()


def _evaluated(source: Source, recipe: Recipe, demanded: bool) -> str | None:
    """Return the recipe's EnvSpec if it fits the file; a guessed one that does not is left out (Ant-v2 and -v5)."""
    spec = recipe.env_spec()
    env = make_env(spec)
    shapes = (env.observation_space.shape, env.action_space.shape)
    env.close()
    theirs = tuple(source.columns[name].shape[1:] for name in ("observations", "actions"))
    if shapes == theirs:
        return spec
    if demanded:
        raise OffbenchError(
            f"{source.path} has observations {theirs[0]} and actions {theirs[1]}, {recipe.env_id} has {shapes[0]} "
            f"and {shapes[1]}: give the right --env"
        )
    return None


def _spaces(source: Source, recipe: Recipe | None) -> tuple[gym.Space[Any], gym.Space[Any]]:
    """Return the spaces: those an export kept, else the data's types with the recipe's action bounds."""
    about, observations, actions = source.about, source.columns["observations"], source.columns["actions"]
    kept = about.get("spaces", ())
    if len(kept) == 2:
        boxes = tuple(box(space, f"{source.path}: its offbench metadata") for space in kept)
        if [space.shape for space in boxes] != [observations.shape[1:], actions.shape[1:]]:
            raise OffbenchError(f"{source.path}: its offbench metadata are of other shapes; export the dataset again")
        return boxes[0], boxes[1]
    low = high = np.ones(actions.shape[1:], np.float32)
    low = -low
    if recipe is not None:
        env = make_env(recipe.env_spec())
        space: Any = env.action_space
        env.close()
        if space.shape == actions.shape[1:]:
            low, high = space.low, space.high
    kind: Any = actions.dtype.type
    return (
        gym.spaces.Box(-np.inf, np.inf, observations.shape[1:], observations.dtype.type),
        gym.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind),
    )
