"""Recording: the episodes of a dataset's parts, and which policy plays each part."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator

from offbench.agents.build_ladder import random_reference
from offbench.agents.ladder import MEDIUM, MEDIUM_AT_MOST, MEDIUM_LIMITS, NEAR, Ladder, Rung
from offbench.agents.medium_replay import load_replay
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, sha256
from offbench.common.processes import blocking_workers
from offbench.common.terminal import inform
from offbench.data.behaviour_policy import BehaviourPolicy, read_behaviour_policy
from offbench.data.levels import WITHOUT_AGENT, Part, full_size, shares
from offbench.envs.contact_margins import has_margins, model_of
from offbench.envs.environments import make_env, spaces_of
from offbench.envs.recipes import Recipe
from offbench.rollouts.function_policy import FunctionPolicy
from offbench.rollouts.policy import Policy, uniform_policy
from offbench.rollouts.rollouts import Episode, Rollouts


class Recording:
    """A dataset that is to be recorded. Without a ladder, all its parts must be WITHOUT_AGENT.

    Args:
        policy_source: the user's own policy, as `read_behaviour_policy` takes it.
        steps: the number of transitions; None for the full size.
        accept: whether to record the nearest policy even if none is near what a part is defined as.

    Attributes:
        parts: the parts that the level consists of.
        rungs: the rung that plays each part; None for uniform actions, the replay and a user's own policy.
        counts: the number of transitions of each part.

    Raises:
        OffbenchError: no rung is near what a part is defined as, or there are too few or too many steps.
    """

    def __init__(
        self,
        recipe: Recipe,
        parts: tuple[Part, ...],
        ladder: Ladder | None,
        seed: int,
        workers: int,
        policy_source: str | None,
        *,
        steps: int | None,
        accept: bool,
    ) -> None:
        self.recipe, self.parts, self._ladder, self.seed = recipe, parts, ladder, seed
        self.workers = blocking_workers(workers)
        self.env_spec = recipe.env_spec()
        env = make_env(self.env_spec)
        model = model_of(env)
        self.uses_mujoco, self.has_margins = model is not None, model is not None and has_margins(model)
        self.spaces = spaces_of(env, recipe.env_id)
        self.observation_space, action_space = self.spaces
        self.bounds = action_space.low, action_space.high
        self.own_policy: BehaviourPolicy | None = None
        if policy_source is not None:
            self.own_policy = read_behaviour_policy(
                policy_source, *self.bounds, self.observation_space.shape[0], recipe.env_id
            )
        self.rungs = [self._rung(part, accept) for part in parts]
        self.counts = self._counts(steps)

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
        with Rollouts(self.env_spec, self.workers) as rollouts:
            return {"random": random_reference(self.recipe, 0, rollouts)}

    @property
    def full_size(self) -> int:
        """The number of transitions of the dataset at its full size."""
        replay_steps = self._ladder.info.medium_replay.transitions if self._ladder else None
        return full_size(self.parts, self.recipe.dataset_steps, replay_steps)

    def _counts(self, steps: int | None) -> list[int]:
        total = self.full_size if steps is None else steps
        counts = shares(self.parts, total)
        if 0 in counts:
            raise OffbenchError(f"{total} steps leave a part of the mix without transitions; use more --steps")
        for part, count in zip(self.parts, counts, strict=True):
            if part.source == "replay" and count > (available := self.ladder.info.medium_replay.transitions):
                raise OffbenchError(
                    f"medium-replay of {self.recipe.name} has {available:,} transitions, not {count:,}; "
                    "use fewer --steps"
                )
        return counts

    def _rung(self, part: Part, accept: bool) -> Rung | None:
        if part.source in WITHOUT_AGENT:
            return None
        if part.source == "expert":
            return self.ladder.role("expert")
        if part.source in ("medium", "replay"):
            rung = self.ladder.role("medium")
            self._check_medium(rung, accept)
            return rung if part.source == "medium" else None  # the replay ends at this rung, which does not play it
        return self._nearest(float(part.source), accept)

    def _nearest(self, fraction: float, accept: bool) -> Rung:
        rung = self.ladder.nearest(fraction)
        if abs(self.ladder.fraction(rung) - fraction) > NEAR and not accept:
            near = " and ".join(f"{self.ladder.fraction(r):.2f}" for r in self.ladder.neighbors(fraction))
            raise OffbenchError(
                f"{self.recipe.name} has no policy within {NEAR} of {fraction:g} of the expert's return; the nearest: "
                f"{near}; use one of these fractions, or `offbench collect --accept` to record the nearest"
            )
        self.ladder.announce(rung, fraction)
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

    def _policy(self, rung: Rung | None) -> Policy | FunctionPolicy:
        if self.own_policy is not None:
            return self.own_policy.policy
        if rung is not None:
            return self.ladder.load(rung)
        return uniform_policy(*self.bounds, self.observation_space.shape[0], self.recipe.env_id)

    def episodes(self) -> Iterator[Episode]:
        """Yield the episodes of all parts, in order; the last one of each part is cut short at its count."""
        for index in range(len(self.parts)):
            yield from self._part_episodes(index)

    def _part_episodes(self, index: int) -> Iterator[Episode]:
        count = self.counts[index]
        if self.parts[index].source == "replay":
            expected = self.ladder.info.medium_replay.sha256
            yield from cut_at(load_replay(self.ladder.replay, expected, self.observation_space, *self.bounds), count)
            return
        with (
            Rollouts(self.env_spec, 0 if self.calls_function else self.workers) as rollouts,
            # the part is in the seed, so that both halves of medium-expert have their own episodes
            contextlib.closing(
                rollouts.episodes(self._policy(self.rungs[index]), self.seed, (index,), transitions_needed=count)
            ) as endless,
        ):
            yield from cut_at(endless, count)

    @property
    def origin(self) -> str:
        """How the parts are recorded, for the dataset's description."""
        return ", then ".join(map(self._part_origin, self.parts, self.rungs))

    def _part_origin(self, part: Part, rung: Rung | None) -> str:
        if part.source == "replay":
            fraction = self.ladder.fraction(self.ladder.role("medium"))
            info, which = self.ladder.info, ""
            if info.medium_replay.envs:
                which = f" ({info.medium_replay.envs} of its {info.sac['envs']} environments)"
            until = f"up to its medium policy, at {fraction:.2f} of the expert's return"
            return f"the replay of SAC's training{which} {until}"
        if self.own_policy is not None:
            return f"the policy {self.own_policy.source}"
        if rung is None:
            return "uniform-random actions"
        fraction = self.ladder.fraction(rung)
        return f"SAC's policy of training step {rung.step}, at {fraction:.2f} of the expert's return"

    @property
    def definitions(self) -> list[JsonObject]:
        """The definition of each part as measured, for the metadata."""
        return list(map(self._definition, self.parts, self.rungs, self.counts))

    def _definition(self, part: Part, rung: Rung | None, count: int) -> JsonObject:
        definition: JsonObject = {"source": part.source, "transitions": count}
        if part.source == "replay":
            medium = self.ladder.info.levels["medium"]
            return definition | {"training_steps": medium, "sha256": self.ladder.info.medium_replay.sha256}
        if self.own_policy is not None:
            origin = {"policy": self.own_policy.source, "algorithm": self.own_policy.algorithm}
            return definition | origin | {"policy_sha256": self.own_policy.sha256}
        if rung is None:
            random = self.references["random"]
            return definition | {"return": random["return"], "interval": [random["low"], random["high"]]}
        return definition | {
            "rung": rung.step,
            "return": rung.ret,
            "interval": [rung.low, rung.high],
            "episodes": rung.episodes,
            "fraction": round(self.ladder.fraction(rung), 4),
            "target": {"medium": [round(MEDIUM, 4), MEDIUM_AT_MOST], "expert": "best"}.get(part.source, part.source),
            "policy_sha256": sha256((self.ladder.folder / "policies" / rung.policy).read_bytes()),
        }


def cut_at(episodes: Iterator[Episode], count: int) -> Iterator[Episode]:
    """Yield episodes until they have exactly `count` transitions; truncate the last one if necessary."""
    left = count
    for episode in episodes:
        yield episode.cut(left)
        left -= min(left, len(episode))
        if not left:
            return
