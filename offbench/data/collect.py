"""`collect`: from a level's name to a Minari dataset with its references and provenance."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from offbench.agents.ladder import BEHAVIOUR, Ladder, find_ladder
from offbench.common.code_hash import describe_changes
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import JsonObject
from offbench.common.processes import default_workers
from offbench.common.progress import Progress
from offbench.common.provenance import PHYSICS, versions
from offbench.common.seeds import check_seed
from offbench.common.settings import check_count
from offbench.common.terminal import inform
from offbench.data import minari_store, minari_writer
from offbench.data.behaviour_policy import level_name
from offbench.data.card import compare_with_card
from offbench.data.levels import POLICY, WITHOUT_AGENT, Part, parse_level, parse_mix
from offbench.data.minari_reader import open_minari
from offbench.data.other_references import warn_other_references
from offbench.data.recording import Recording
from offbench.envs.environment_code import environment_code
from offbench.envs.margin_rule import LAST_WITH_MAX_RULE, MARGIN_KEY, MAX_RULE, MUJOCO_VERSIONS, without_margin
from offbench.envs.physics import same_physics
from offbench.envs.recipes import load_recipe
from offbench.rollouts.rollouts import Episode

# two recordings with the same values of these metadata, on the same versions of these packages, are the same
IDENTITY = ("env", "seed", "recipe_sha256", "parts", "references")
REPOSITORY = "https://github.com/offbench/offbench"


def collect(
    env: str | Path,
    level: str | float | None = None,
    *,
    mix: str | None = None,
    steps: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    dataset_id: str | None = None,
    overwrite: bool = False,
    retrain: bool = False,
    accept: bool = False,
    policy: str | Path | None = None,
    name: str | None = None,
    behaviour_dir: str | Path = BEHAVIOUR,
) -> str:
    """Record one level of one environment as a local Minari dataset.

    Args:
        env: a shipped recipe's name (`hopper`) or a recipe file (`./my-env.toml`).
        level: random, medium (the default), medium-replay, medium-expert, expert, or a fraction such as 0.6.
        mix: a mix of levels instead of one level, e.g. "random:0.5,expert:0.5".
        steps: transitions; default: the recipe's (1,000,000 per part; medium-replay: all of the training's).
        seed: seed of the episodes. The same seed gives the same content for any number of workers.
        workers: recording processes (default: one per core).
        dataset_id: the Minari id; default `<env>-<level>-v<version>`.
        overwrite: replace a dataset of that id. Without it, the same dataset recorded again is left as it is, and
            another one is an error.
        retrain: use a behaviour agent trained here instead of the shipped one.
        accept: record the nearest policy even if none is near a fraction, or medium is far from a third of the expert.
        policy: record with this policy instead of a level: an agent's zip of Stable-Baselines3 (only its tensors are
            read), a run's folder, a policy file, or `module:function` of the user's own. It acts as it was
            trained to explore: a stochastic one samples.
        name: level name in the id of such a dataset; default: the policy's own name.
        behaviour_dir: the folder of agents trained here.

    Returns:
        The dataset's id, for `minari.load_dataset` or `offbench.load`.

    Raises:
        OffbenchError: anything that the user can fix, in one line.
    """
    recipe, seed = load_recipe(env), check_seed(seed)
    policy_source = None
    if policy is None:
        if name is not None:
            raise OffbenchError("--name goes with --policy; give a dataset's id by --id")
        if mix is not None and level is not None:
            raise OffbenchError("give --level or --mix, not both")
        level = mix or ("medium" if level is None else str(level))
        name, parts = parse_mix(mix) if mix is not None else parse_level(level)
    else:
        if mix is not None or level is not None:
            raise OffbenchError("--policy records one policy: leave out --level and --mix")
        if accept:
            raise OffbenchError("--accept is about the policy that --level or --mix chooses; --policy records its own")
        name = level = level_name(name, str(policy))
        policy_source, parts = str(policy), (Part(POLICY),)
    dataset_id = minari_store.check_id(dataset_id or f"{recipe.name}-{name}-v{recipe.version}")
    steps = None if steps is None else check_count("steps", steps)
    workers = default_workers(workers)

    def recording_with(ladder: Ladder | None) -> Recording:
        return Recording(recipe, parts, ladder, seed, workers, policy_source, steps=steps, accept=accept)

    ladder = find_ladder(recipe, Path(behaviour_dir), retrain)
    # with --retrain, a level without an agent still has the references of one
    has_agent = ladder is not None or (not retrain and all(part.source in WITHOUT_AGENT for part in parts))
    recording = recording_with(ladder) if has_agent else None
    if recording and not overwrite and _is_recorded(recording, dataset_id, level):
        if recording.calls_function:
            raise OffbenchError(
                f"{dataset_id} is recorded already, but {policy} may act differently now (a function can read files); "
                "record it again with --overwrite, or another dataset with --name"
            )
        minari_store.tidy(dataset_id)
        inform(f"{dataset_id} is recorded already, from the same policies and seed")
        return dataset_id
    with minari_store.claimed(dataset_id, overwrite) as path:
        if recording is None:
            ladder = _train(env, Path(behaviour_dir), workers)
            recording = recording_with(ladder)
        metadata = _metadata(recording, dataset_id, level)
        total = sum(recording.counts)
        with Progress(total, f"recording {dataset_id}") as progress:
            episodes = _counted(recording.episodes(), progress)
            content = minari_writer.write(path, episodes, recording.env_spec, metadata, total, recording.spaces)
    if seed == 0 and steps is None and not retrain:
        compare_with_card(recipe, name, content)
    if ladder:
        warn_other_references(recipe, ladder)
    return dataset_id


def _is_recorded(recording: Recording, dataset_id: str, level: str) -> bool:
    """Return whether there is a dataset of this id that was recorded in the same way, on the installed physics.

    Raises:
        DamagedError: its data cannot be opened.
        OffbenchError: it is the same but for the code of its environment.
    """
    if not minari_store.exists(dataset_id):
        return False
    metadata = minari_store.read_metadata(dataset_id)
    recorded = minari_store.read_provenance(metadata)
    wanted = _metadata(recording, dataset_id, level)
    as_written = json.loads(json.dumps({minari_store.KEY: wanted[minari_store.KEY]}))
    new = minari_store.read_provenance(as_written)
    same = all(recorded.versions.get(name) == new.versions.get(name) for name in PHYSICS)
    same = same and metadata.get("total_steps") == sum(recording.counts)  # Minari can add episodes
    same = same and all(getattr(recorded, key) == getattr(new, key) for key in IDENTITY)
    if same and (changed := describe_changes(recorded.env_code, new.env_code)):
        raise OffbenchError(
            f"{dataset_id} was recorded in other code of its environment: {changed}; use --overwrite to replace it, "
            "or --id for another id"
        )
    if same:
        try:
            open_minari(dataset_id)
        except DamagedError as error:
            raise DamagedError(f"{error}: --overwrite replaces it") from error
    return same


def _train(env: str | Path, behaviour_dir: Path, workers: int) -> Ladder:
    """Train the recipe's behaviour agent now."""
    from offbench.agents.behaviour import behaviour

    recipe = load_recipe(env)
    recipe.env_spec()  # refuses a bad environment before the training is announced
    others = sorted(path.parents[1].name for path in (behaviour_dir / recipe.name).glob("seed-*/ladder/ladder.json"))
    found = f" of seed 0 (there is {', '.join(others)}, whose policies --policy records)" if others else ""
    inform(f"{recipe.name} has no behaviour agent{found} in {behaviour_dir} yet; training one first")
    return behaviour(env, behaviour_dir=behaviour_dir, workers=workers)


def _counted(episodes: Iterator[Episode], progress: Progress) -> Iterator[Episode]:
    for episode in episodes:
        yield episode
        progress.to(progress.done + len(episode))


def _metadata(recording: Recording, dataset_id: str, level: str) -> JsonObject:
    """Return the dataset's metadata: Minari's fields, and offbench's own under one key."""
    recipe, references, installed = recording.recipe, recording.references, versions()
    full, total = recording.full_size, sum(recording.counts)
    mujoco, margins = f"mujoco=={installed['mujoco']}", ""
    if recording.has_margins:
        margins = f" Contact margins as in MuJoCo {MUJOCO_VERSIONS[recipe.contact_margin]}: see offbench.make_env."
        if recipe.contact_margin == MAX_RULE and same_physics(
            LAST_WITH_MAX_RULE, installed["mujoco"], recording.env_spec
        ):
            mujoco = f"mujoco<={LAST_WITH_MAX_RULE}"
    short = f" A short recording: {total:,} of {full:,} transitions." if total < full else ""
    if recording.own_policy:
        algorithm = recording.own_policy.algorithm
    else:
        uniform = all(part.source == "uniform" for part in recording.parts)
        algorithm = "random" if uniform else "SAC (Stable-Baselines3)"
    return {
        "dataset_id": dataset_id,
        "minari_version": installed["minari"],
        "eval_env_spec": without_margin(recording.env_spec)[0],
        "algorithm_name": algorithm,
        "author": {"offbench"},
        "author_email": {"offbench@example.org"},
        "code_permalink": f"{REPOSITORY}/tree/v{installed['offbench']}",
        "description": f"{recipe.env_id}, level {level}: {recording.origin}. Recorded by offbench.{margins}{short}",
        "requirements": [mujoco, f"gymnasium=={installed['gymnasium']}"],
        "ref_min_score": references["random"]["return"],
        **({"ref_max_score": references["expert"]["return"]} if "expert" in references else {}),
        "num_episodes_average_score": int(references["random"]["episodes"]),
        minari_store.KEY: {
            "format": "offbench-dataset-1",
            "env": recipe.name,
            "level": level,
            "seed": recording.seed,
            "recipe_sha256": recipe.sha256(),
            "parts": recording.definitions,
            "full_size": full,
            "references": references,
            "d4rl": recipe.d4rl_reference(),
            MARGIN_KEY: recipe.contact_margin if recording.uses_mujoco else None,
            **({"env_code": code} if (code := environment_code(recording.env_spec)) else {}),
            "versions": installed,
        },
    }
