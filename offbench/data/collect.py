"""`collect`: from a level's name to a Minari dataset with its references and provenance."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

from offbench.agents.build_ladder import random_reference
from offbench.agents.ladder import BEHAVIOUR, MEDIUM, MEDIUM_AT_MOST, MEDIUM_LIMITS, NEAR, Ladder, Rung, find_ladder
from offbench.agents.medium_replay import load_replay
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import JsonObject, sha256
from offbench.common.processes import default_workers
from offbench.common.progress import Progress
from offbench.common.provenance import PHYSICS, versions
from offbench.common.seeds import check_seed
from offbench.common.terminal import inform
from offbench.data import minari_store, minari_writer
from offbench.data.behaviour_policy import BehaviourPolicy, level_name, read_behaviour_policy
from offbench.data.card import compare_with_card
from offbench.data.levels import Part, full_size, parse_level, parse_mix, shares
from offbench.data.minari_reader import open_minari
from offbench.data.other_references import warn_other_references
from offbench.envs.contact_margins import has_margins, model_of
from offbench.envs.environments import make_env, spaces_of
from offbench.envs.margin_rule import EARLIER, LAST_EARLIER, MARGIN, MUJOCO_VERSIONS, without_margin
from offbench.envs.recipes import Recipe, load_recipe
from offbench.envs.version_warning import same_physics
from offbench.rollouts.function_policy import FunctionPolicy
from offbench.rollouts.policy import Policy, uniform
from offbench.rollouts.rollouts import Episode, Rollouts

POLICY = "policy"  # the source of a part that a user's own policy plays
WITHOUT_AGENT = ("uniform", POLICY)  # sources that need no behaviour agent
# two recordings with the same values of these metadata, on the same versions of these packages, are the same
IDENTITY = ("env", "level", "seed", "recipe_sha256", "parts", "references")
REPOSITORY = "https://github.com/offbench/offbench"


def collect(
    env: str | Path,
    level: str | float = "medium",
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
        level: random, medium, medium-replay, medium-expert, expert, or a fraction such as 0.6.
        mix: a blend instead of a level, e.g. "random:0.5,expert:0.5".
        steps: transitions; default: the recipe's (1,000,000 per part; medium-replay: all of the training's).
        seed: of the recorded episodes. The same seed gives the same content for any number of workers.
        workers: recording processes (default: one per core).
        dataset_id: the Minari id; default `<env>-<level>-v<version>`.
        overwrite: replace a dataset of that id. Without it, the same dataset recorded again is left as it is, and
            another one is an error.
        retrain: use a behaviour agent trained here instead of the shipped one.
        accept: record the nearest policy even if none is near a fraction, or medium is far from a third of the expert.
        policy: record with this policy instead of a level: an agent's zip of Stable-Baselines3 (only its tensors are
            read), a run's folder, a policy file, or `module:function` of the user's own. It acts as it was
            trained to explore: a stochastic one samples.
        name: of the level that such a dataset gets; default: the policy's own name.
        behaviour_dir: where agents trained here live.

    Returns:
        The dataset's id, for `minari.load_dataset` or `offbench.load`.

    Raises:
        OffbenchError: anything that the user can fix, in one line.
    """
    recipe, level, seed = load_recipe(env), str(level), check_seed(seed)
    policy_source = None
    if policy is None:
        if name is not None:
            raise OffbenchError("--name goes with --policy; give a dataset's id by --id")
        if mix is not None and level != "medium":
            raise OffbenchError("give --level or --mix, not both")
        name, parts = parse_mix(mix) if mix is not None else parse_level(level)
    else:
        if mix is not None or level != "medium":
            raise OffbenchError("--policy records one policy: leave out --level and --mix")
        name = level = level_name(name, str(policy))
        policy_source, parts = str(policy), (Part(POLICY),)
    dataset_id = minari_store.check_id(dataset_id or f"{recipe.name}-{name}-v{recipe.version}")
    if steps is not None and steps < 1:
        raise OffbenchError(f"steps must be at least 1, not {steps}")
    workers = default_workers(workers)

    def prepare(ladder: Ladder | None) -> tuple[_Recording, list[Rung | None], list[int], JsonObject]:
        recording = _Recording(recipe, ladder, seed, workers, policy_source)
        sources = [recording.source(part, accept) for part in parts]
        counts = recording.counts(parts, steps)
        return recording, sources, counts, _metadata(recording, dataset_id, mix or level, parts, sources, counts)

    ladder = find_ladder(recipe, Path(behaviour_dir), retrain)
    trained = ladder is not None or all(part.source in WITHOUT_AGENT for part in parts)
    prepared = prepare(ladder) if trained else None
    if prepared and not overwrite and minari_store.exists(dataset_id) and _is_same(dataset_id, prepared[-1]):
        if prepared[0].calls_function:
            raise OffbenchError(
                f"{dataset_id} is recorded already, but {policy} may act differently now (a function can read files); "
                "record it again with --overwrite, or another dataset with --name"
            )
        minari_store.tidy(dataset_id)
        inform(f"{dataset_id} is recorded already, from the same policies and seed")
        return dataset_id
    with minari_store.claimed(dataset_id, overwrite) as path:
        if prepared is None:
            ladder = _train(env, Path(behaviour_dir), workers)
            prepared = prepare(ladder)
        recording, sources, counts, metadata = prepared
        total = sum(counts)
        with Progress(total, f"recording {dataset_id}") as progress:
            streams = (recording.episodes(*item) for item in zip(parts, sources, counts, itertools.count()))
            episodes = _counted(itertools.chain.from_iterable(streams), progress)
            content = minari_writer.write(path, episodes, recording.spec, metadata, total, recording.spaces)
    if seed == 0 and steps is None and not retrain and (comparison := compare_with_card(recipe, name, content)):
        inform(comparison)
    if ladder:
        warn_other_references(recipe, ladder)
    return dataset_id


def _is_same(dataset_id: str, wanted: JsonObject) -> bool:
    """Return whether a dataset was recorded with the same metadata as `wanted`, on the installed physics.

    Raises:
        DamagedError: its data cannot be opened.
    """
    recorded = minari_store.provenance(minari_store.read_metadata(dataset_id))
    ours = minari_store.provenance(json.loads(json.dumps({minari_store.KEY: wanted[minari_store.KEY]})))  # as written
    same = all(recorded.versions.get(name) == ours.versions.get(name) for name in PHYSICS)
    same = same and all(getattr(recorded, key) == getattr(ours, key) for key in IDENTITY)
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


class _Recording:
    """What all parts of one dataset share. Without a ladder, only WITHOUT_AGENT parts can be recorded."""

    def __init__(
        self, recipe: Recipe, ladder: Ladder | None, seed: int, workers: int, policy_source: str | None
    ) -> None:
        self.recipe, self._ladder, self.seed = recipe, ladder, seed
        self.workers = workers if workers > 1 else 0  # a single one would be no faster than this process
        self.spec = recipe.env_spec()
        env = make_env(self.spec)
        model = model_of(env)
        self.mujoco, self.margins = model is not None, model is not None and has_margins(model)
        self.spaces = self.observation_space, action_space = spaces_of(env, recipe.env_id)
        self.bounds = action_space.low, action_space.high
        self.own_policy: BehaviourPolicy | None = None
        if policy_source is not None:
            self.own_policy = read_behaviour_policy(
                policy_source, *self.bounds, self.observation_space.shape[0], recipe.env_id
            )

    @property
    def calls_function(self) -> bool:
        """Whether the policy is a user's own function, which may keep a state, draw numbers and read files."""
        return self.own_policy is not None and isinstance(self.own_policy.policy, FunctionPolicy)

    @property
    def ladder(self) -> Ladder:
        """The behaviour agent's ladder."""
        assert self._ladder is not None
        return self._ladder

    @functools.cached_property
    def references(self) -> JsonObject:
        """The random and the expert reference; without a ladder the random one, measured here as a ladder's is."""
        if self._ladder:
            return dict(self._ladder.info.references)
        with Rollouts(self.spec, self.workers) as rollouts:
            return {"random": random_reference(self.recipe, 0, rollouts)}

    def full_size(self, parts: tuple[Part, ...]) -> int:
        """Return the transitions of a dataset at its full size."""
        replay_steps = self._ladder.info.medium_replay.transitions if self._ladder else None
        return full_size(parts, self.recipe.dataset_steps, replay_steps)

    def counts(self, parts: tuple[Part, ...], steps: int | None) -> list[int]:
        """Return the transitions of each part; `steps` are those of all, None for the full size."""
        total = self.full_size(parts) if steps is None else steps
        counts = shares(parts, total)
        if 0 in counts:
            raise OffbenchError(f"{total} steps leave a part of the blend without a transition; use more --steps")
        for part, count in zip(parts, counts, strict=True):
            if part.source == "replay" and count > (available := self.ladder.info.medium_replay.transitions):
                raise OffbenchError(
                    f"medium-replay of {self.recipe.name} has {available:,} transitions, not {count:,}; "
                    "use fewer --steps"
                )
        return counts

    def source(self, part: Part, accept: bool) -> Rung | None:
        """Return the rung a part is played by, or None for uniform actions and the replay.

        Raises:
            OffbenchError: no rung is near what the part is defined as, and the user did not accept another.
        """
        if part.source in WITHOUT_AGENT:
            return None
        if part.source not in ("medium", "replay", "expert"):
            return self._nearest(float(part.source), accept)
        rung = self.ladder.role("expert" if part.source == "expert" else "medium")
        if part.source != "expert":
            self._check_medium(rung, accept)
        return None if part.source == "replay" else rung

    def _nearest(self, fraction: float, accept: bool) -> Rung:
        rung = self.ladder.nearest(fraction)
        where = self.ladder.fraction(rung)
        if abs(where - fraction) > NEAR and not accept:
            near = " and ".join(f"{self.ladder.fraction(r):.2f}" for r in self.ladder.neighbors(fraction))
            raise OffbenchError(
                f"{self.recipe.name} has no policy within {NEAR} of {fraction:g} of the expert's return; the nearest: "
                f"{near}; use such a fraction, or `offbench collect --accept` to record the nearest"
            )
        inform(
            f"the policy nearest {fraction:g} is the one of step {rung.step:,}: return {rung.ret:.0f}, "
            f"{where:.2f} of the expert's"
        )
        return rung

    def _check_medium(self, rung: Rung, accept: bool) -> None:
        fraction = self.ladder.fraction(rung)
        if MEDIUM <= fraction <= MEDIUM_AT_MOST:
            return
        low, high = MEDIUM_LIMITS
        message = f"medium of {self.recipe.name} is at {fraction:.2f} of the expert's return"
        if not low <= fraction <= high and not accept:
            raise OffbenchError(f"{message}, far from {MEDIUM:.2f}; `offbench collect --accept` records it anyway")
        remedy = "" if self.recipe.folder else "; a shorter [sac] segment in the recipe keeps more policies"
        inform(f"{message}: no policy of the training is at {MEDIUM:.2f} to {MEDIUM_AT_MOST}{remedy}")

    def policy(self, rung: Rung | None) -> Policy | FunctionPolicy:
        """Return the policy that plays a part."""
        if self.own_policy is not None:
            return self.own_policy.policy
        if rung is not None:
            return self.ladder.load(rung)
        return uniform(*self.bounds, self.observation_space.shape[0], self.recipe.env_id)

    def episodes(self, part: Part, rung: Rung | None, count: int, index: int) -> Iterator[Episode]:
        """Yield a part's episodes with exactly `count` transitions; the last one is cut short."""
        if part.source == "replay":
            expected = self.ladder.info.medium_replay.sha256
            yield from cut_at(load_replay(self.ladder.replay, expected, self.observation_space, *self.bounds), count)
            return
        with (
            Rollouts(self.spec, 0 if self.calls_function else self.workers) as rollouts,
            # the part is in the seed, so that both halves of medium-expert have their own episodes
            contextlib.closing(
                rollouts.episodes(self.policy(rung), self.seed, (index,), transitions_needed=count)
            ) as endless,
        ):
            yield from cut_at(endless, count)

    def origin_text(self, part: Part, rung: Rung | None) -> str:
        """Return how a part was recorded, for the dataset's description."""
        if part.source == "uniform":
            return "uniform-random actions"
        if self.own_policy is not None:
            return f"the policy {self.own_policy.source}"
        if rung is None:
            fraction = self.ladder.fraction(self.ladder.role("medium"))
            info, which = self.ladder.info, ""
            if info.medium_replay.envs:
                which = f" ({info.medium_replay.envs} of its {info.sac['envs']} environments)"
            until = f"up to its medium policy, at {fraction:.2f} of the expert's return"
            return f"the replay of SAC's training{which} {until}"
        fraction = self.ladder.fraction(rung)
        return f"SAC's policy of training step {rung.step}, at {fraction:.2f} of the expert's return"

    def describe(self, part: Part, rung: Rung | None, count: int) -> JsonObject:
        """Return a part's definition as measured, for the metadata."""
        described: JsonObject = {"source": part.source, "transitions": count}
        if part.source == "replay":
            medium = self.ladder.info.levels["medium"]
            return described | {"training_steps": medium, "sha256": self.ladder.info.medium_replay.sha256}
        if self.own_policy is not None:
            made = {"policy": self.own_policy.source, "algorithm": self.own_policy.algorithm}
            return described | made | {"policy_sha256": self.own_policy.sha256}
        if rung is None:
            random = self.references["random"]
            return described | {"return": random["return"], "interval": [random["low"], random["high"]]}
        return described | {
            "rung": rung.step,
            "return": rung.ret,
            "interval": [rung.low, rung.high],
            "episodes": rung.episodes,
            "fraction": round(self.ladder.fraction(rung), 4),
            "target": {"medium": [round(MEDIUM, 4), MEDIUM_AT_MOST], "expert": "best"}.get(part.source, part.source),
            "policy_sha256": sha256((self.ladder.folder / "policies" / rung.policy).read_bytes()),
        }


def cut_at(episodes: Iterator[Episode], count: int) -> Iterator[Episode]:
    """Yield episodes until they hold exactly `count` transitions; the last one is truncated where it must be."""
    left = count
    for episode in episodes:
        yield episode.cut(left)
        left -= min(left, len(episode))
        if not left:
            return


def _counted(episodes: Iterator[Episode], progress: Progress) -> Iterator[Episode]:
    for episode in episodes:
        yield episode
        progress.to(progress.done + len(episode))


def _metadata(
    recording: _Recording,
    dataset_id: str,
    level: str,
    parts: tuple[Part, ...],
    sources: list[Rung | None],
    counts: list[int],
) -> JsonObject:
    """Return the dataset's metadata: Minari's fields, and offbench's own under one key."""
    recipe, references, made = recording.recipe, recording.references, versions()
    described = [recording.describe(*item) for item in zip(parts, sources, counts, strict=True)]
    full, total = recording.full_size(parts), sum(counts)
    mujoco, margins = f"mujoco=={made['mujoco']}", ""
    if recording.margins:
        margins = f" Contact margins as in MuJoCo {MUJOCO_VERSIONS[recipe.contact_margin]}: see offbench.make_env."
        if recipe.contact_margin == EARLIER and same_physics(LAST_EARLIER, made["mujoco"], recording.spec):
            mujoco = f"mujoco<={LAST_EARLIER}"
    short = f" A short recording: {total:,} of {full:,} transitions." if total < full else ""
    origin_texts = [recording.origin_text(part, rung) for part, rung in zip(parts, sources, strict=True)]
    if recording.own_policy:
        algorithm = recording.own_policy.algorithm
    else:
        algorithm = "random" if all(part.source == "uniform" for part in parts) else "SAC (Stable-Baselines3)"
    return {
        "dataset_id": dataset_id,
        "minari_version": made["minari"],
        "eval_env_spec": without_margin(recording.spec)[0],
        "algorithm_name": algorithm,
        "author": {"offbench"},
        "author_email": {"offbench@example.org"},
        "code_permalink": f"{REPOSITORY}/tree/v{made['offbench']}",
        "description": f"{recipe.env_id}, level {level}: {', then '.join(origin_texts)}. Recorded by offbench."
        f"{margins}{short}",
        "requirements": [mujoco, f"gymnasium=={made['gymnasium']}"],
        "ref_min_score": references["random"]["return"],
        **({"ref_max_score": references["expert"]["return"]} if "expert" in references else {}),
        "num_episodes_average_score": int(references["random"]["episodes"]),
        minari_store.KEY: {
            "format": "offbench-dataset-1",
            "env": recipe.name,
            "level": level,
            "seed": recording.seed,
            "recipe_sha256": recipe.sha256(),
            "parts": described,
            "full_size": full,
            "references": references,
            "d4rl": recipe.d4rl_reference(),
            MARGIN: recipe.contact_margin if recording.mujoco else None,
            "versions": made,
        },
    }
