"""Building the ladder: which rungs recording needs, chosen by measured return.

    a training's folder (a rung for each segment, screened over a few episodes; more policies within segments)
        -> expert   the best of the late rungs, by measured return
        -> medium   the first policy at one third (to 0.45) of the expert's normalized return
        -> others   the policies nearest each tenth of it, for `--level FRACTION`
        -> ladder/  ladder.json  ladder.csv  policies/*.safetensors  medium-replay.hdf5

Returns are of the sampling policy, normalized between the uniform-random and the expert reference. Policies within
segments are considered if no rung at the end of a segment fits. A rung is chosen on one set of episodes; the
expert's reference score is measured on another, so that the choice does not bias it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from offbench.agents.ladder import MEDIUM, MEDIUM_AT_MOST, Ladder, read_ladder, replaced_folder, restore_replaced
from offbench.agents.medium_replay import replay_episodes, save_replay
from offbench.agents.training_folder import TrainingFolder, read_rungs
from offbench.common.errors import OffbenchError
from offbench.common.files import (
    JsonObject,
    csv_bytes,
    delete,
    read_errors,
    read_json,
    write_bytes,
    write_errors,
    write_json,
)
from offbench.common.provenance import PHYSICS, versions
from offbench.common.seeds import Purpose
from offbench.common.terminal import inform
from offbench.envs.environments import make_env, spaces_of
from offbench.envs.recipes import Recipe
from offbench.rollouts.policy import Policy, read_policy_file, uniform_policy
from offbench.rollouts.rollouts import MEASURES, EpisodeStats, Rollouts, summary

EXPERT_CANDIDATES = 8  # late rungs measured to choose the expert
MAX_MEASURED = 6  # policies measured to find the one nearest a return
CROSSINGS = 3  # pairs of neighboring rungs between which policies within a segment are screened
MEASURED = "measured.json"  # the file in a training's folder from which an interrupted build resumes
COLUMNS = ("step", "hours", "role", "policy", *MEASURES, *(f"deterministic_{m}" for m in MEASURES), "episodes")


class RungEvaluator:
    """Measures policies of a training, each at most once, and chooses among them.

    Args:
        folder: the training's folder.
        rows: the rows of rungs.csv, for the rungs at the ends of segments.
        policy_steps: the steps of all saved policies, including those within segments.
        rollouts: where episodes are played.
    """

    def __init__(
        self,
        folder: TrainingFolder,
        rows: Sequence[dict[str, float]],
        policy_steps: Sequence[int],
        rollouts: Rollouts,
    ) -> None:
        self.folder, self.rollouts = folder, rollouts
        self.screened = {int(row["step"]): row for row in rows}
        self.within = [step for step in policy_steps if step not in self.screened]
        self.screened_within: dict[int, float] = {}  # mean returns
        self.measured: dict[int, dict[str, float]] = {}

        self._earlier: dict[str, JsonObject] = {"screened": {}, "measured": {}}  # by the step as text

    def resume(self) -> None:
        """Reuse what an earlier call measured in this folder with the same packages and number of episodes.

        The choice is the same as without it: a policy counts as measured once this call asks for it.
        """
        path = self.folder.path / MEASURED
        if not path.exists():
            return
        with read_errors(str(path), "is damaged", "delete it"):
            table = read_json(path, "delete it")
            if table["made"] == self._conditions():
                self._earlier = {name: dict(table[name]) for name in self._earlier}

    def _save(self, table: str, step: int, value: float | dict[str, float]) -> None:
        self._earlier[table][str(step)] = value
        write_json(self.folder.path / MEASURED, {"made": self._conditions(), **self._earlier})

    def _conditions(self) -> dict[str, str | int]:
        episodes = self.folder.recipe.measure.rung_episodes
        return {name: versions()[name] for name in PHYSICS} | {"episodes": episodes}

    def measure(self, step: int) -> float:
        """Return the mean return of a policy over the recipe's `rung_episodes`."""
        if step not in self.measured:
            row = self._earlier["measured"].get(str(step)) or self._play(step)
            self.measured[step] = row
            self._save("measured", step, row)
            inform(f"policy of step {step:,}: return {row['return']:.1f} over {row['episodes']} episodes")
        return self.measured[step]["return"]

    def _play(self, step: int) -> dict[str, float]:
        policy, count = read_policy_file(self.folder.policy(step)), self.folder.recipe.measure.rung_episodes
        row: dict[str, float] = {"episodes": count}
        for prefix, deterministic in (("", False), ("deterministic_", True)):
            stream = (int(Purpose.MEASURE), step, int(deterministic))
            row |= summary(self.run(policy, stream, count, deterministic), prefix)
        return row

    def screen(self, step: int) -> float:
        """Return the mean return of a policy within a segment over the recipe's few screening episodes."""
        policy, stream = read_policy_file(self.folder.policy(step)), (int(Purpose.RUNG), step, 0)
        return summary(self.run(policy, stream, self.folder.recipe.sac.rung_episodes))["return"]

    def run(
        self, policy: Policy, stream: tuple[int, ...], count: int, deterministic: bool = False
    ) -> list[EpisodeStats]:
        """Play evaluation episodes."""
        return self.rollouts.evaluate(policy, self.folder.seed, stream, count, deterministic)

    def estimate(self, step: int) -> float:
        """Return the return of a policy, as measured, or as screened if it was not measured."""
        if step == 0:
            return -math.inf  # before training
        if step in self.measured:
            return self.measured[step]["return"]
        return self.screened[step]["stochastic_return"] if step in self.screened else self.screened_within[step]

    def expert(self) -> int:
        """Return the best rung of the second half by measured return."""
        last = max(self.screened)
        late = [step for step in self.screened if step > last / 2]
        late.sort(key=lambda step: self.screened[step]["stochastic_return"], reverse=True)
        return max(late[:EXPERT_CANDIDATES], key=self.measure)

    def medium(self, target: float, most: float, expert: int) -> int:
        """Return the first policy measured between `target` and `most`, else the one nearest to `target`."""
        early = [step for step in sorted(self.screened) if step <= expert]
        for before, step in pairwise([0, *early]):
            # measure only rungs whose screening interval reaches the target
            if self.screened[step]["stochastic_high"] >= target and target <= self.measure(step) <= most:
                return step
            if self._crosses(before, step, target, most):
                half = (most - target) / 2
                if (rung := self._first_close(self._screen_between(before, step), target + half, half)) is not None:
                    return rung
        return self.nearest(target, most - target, early)

    def nearest(self, target: float, close: float, among: Iterable[int] | None = None) -> int:
        """Return the policy whose return lies nearest `target`, as measured.

        If no rung lies within `close` of it, the policies between neighboring rungs on either side of `target` are
        candidates too.

        Args:
            target: the wanted return.
            close: a distance that ends the search.
            among: the rungs to choose from, with the policies between them (default: all).
        """
        steps = sorted(self.screened if among is None else among)
        if (close_enough := self._first_close(steps, target, close)) is not None:
            return close_enough
        candidates = list(steps)
        crossings = (pair for pair in pairwise([0, *steps]) if self._crosses(*pair, target - close, target + close))
        for pair in list(itertools.islice(crossings, CROSSINGS)):
            candidates += self._screen_between(*pair)
            if (close_enough := self._first_close(candidates, target, close)) is not None:
                return close_enough
        return min((s for s in candidates if s in self.measured), key=lambda step: abs(self.measure(step) - target))

    def _first_close(self, steps: Sequence[int], target: float, close: float) -> int | None:
        """Measure the most promising policies in turn; return the first within `close` of `target`, if one is.

        The policy with the nearest estimated return comes first. The search ends after MAX_MEASURED policies, or when
        a measured policy is nearer than the estimates of all others.
        """
        for _ in range(MAX_MEASURED if steps else 0):
            step = min(steps, key=lambda step: abs(self.estimate(step) - target))
            measured = step in self.measured
            if abs(self.measure(step) - target) <= close:
                return step
            if measured:
                break
        return None

    def _crosses(self, first: int, last: int, low: float, high: float) -> bool:
        """Return whether `low` to `high` lies between the returns of two rungs that have policies between them."""
        less, more = sorted((self.estimate(first), self.estimate(last)))
        return less < low and high < more and any(first < step < last for step in self.within)

    def _screen_between(self, first: int, last: int) -> list[int]:
        """Screen the policies kept between two rungs; return their steps."""
        steps = [step for step in self.within if first < step < last]
        new = [step for step in steps if step not in self.screened_within]
        if new:
            inform(f"screening {len(new)} policies between steps {first:,} and {last:,}")
        for step in new:
            earlier = self._earlier["screened"].get(str(step))
            self.screened_within[step] = self.screen(step) if earlier is None else float(earlier)
            self._save("screened", step, self.screened_within[step])
        return steps


def check_output_folder(out: Path, training: Path) -> Path:
    """Return the folder where a ladder may be written, absolute.

    Args:
        training: the folder of the training.

    Raises:
        OffbenchError: it holds something else, which a new ladder would replace, or will hold the training.
    """
    out, training = out.resolve(), training.resolve()
    if out in (training, *training.parents, training / "policies", training / "transitions"):
        raise OffbenchError(f"{out} is a folder of the training itself ({training}); give another one for the ladder")
    if out.exists() and not out.is_dir():
        raise OffbenchError(f"{out} is a file; a ladder needs a folder of its own")
    if out.exists() and any(out.iterdir()) and not (out / "ladder.json").exists():
        raise OffbenchError(f"{out} contains other files, which a ladder would replace; give an empty or new folder")
    return out


def build_ladder(folder: TrainingFolder, steps: int, out: Path, workers: int, command: str) -> Ladder:
    """Choose and measure the rungs of a training up to `steps`, and write the ladder's folder `out`.

    Raises:
        OffbenchError: no rung beats the random policy, or the disk refuses.
    """
    rows = [row for row in read_rungs(folder.rungs) if row["step"] <= steps]
    if not rows:
        raise OffbenchError(f"{folder.path} has no rung yet; train at least one segment")
    spec = folder.recipe.env_spec()
    with Rollouts(spec, workers) as rollouts:
        evaluator = RungEvaluator(folder, rows, [s for s in folder.policy_steps() if s <= steps], rollouts)
        episodes = folder.recipe.measure.reference_episodes
        evaluator.resume()
        references = {"random": random_reference(folder.recipe, folder.seed, rollouts)}
        expert = evaluator.expert()
        policy = read_policy_file(folder.policy(expert))
        episode_stats = evaluator.run(policy, (int(Purpose.REFERENCE), 1), episodes)
        references["expert"] = summary(episode_stats) | {"episodes": episodes}
        worst, best = references["random"]["return"], references["expert"]["return"]
        if best <= worst:
            raise OffbenchError(
                f"after {steps:,} steps no rung beats the random policy: the best returns {best:.1f} over "
                f"{episodes} fresh episodes, random {worst:.1f}; train for longer with "
                "`offbench behaviour ENV --steps N`"
            )
        medium = evaluator.medium(worst + MEDIUM * (best - worst), worst + MEDIUM_AT_MOST * (best - worst), expert)
        parts = max(folder.recipe.measure.rungs - 2, 1)  # beside medium and expert
        part = (best - worst) / parts
        targets = [worst + i * part for i in range(1, parts)]
        for target in targets:
            evaluator.nearest(target, part / 4)
        # a policy that was measured for one target may be the nearest to another
        others = {min(evaluator.measured, key=lambda step: abs(evaluator.measure(step) - t)) for t in targets}
    roles: dict[int, str] = dict.fromkeys(sorted(others | {medium, expert}), "")
    for step, role in ((medium, "medium"), (expert, "expert")):
        roles[step] = f"{roles[step]}+{role}".lstrip("+")
    trained = folder.read_description()
    info = trained | {
        "versions": trained["versions"] | {"offbench": versions()["offbench"]},
        "format": "offbench-ladder-1",
        "command": command,
        "steps": steps,
        "hours": rows[-1]["hours"],
        "references": references,
        "levels": {"medium": medium, "expert": expert},
    }
    _write(out, evaluator, roles, info)
    ladder = read_ladder(out)
    assert ladder is not None
    return ladder


def random_reference(recipe: Recipe, seed: int, rollouts: Rollouts) -> dict[str, float]:
    """Measure the return of uniform actions over the recipe's `reference_episodes`: the reference's 0."""
    observations, actions = spaces_of(make_env(recipe.env_spec()), recipe.env_id)
    policy = uniform_policy(actions.low, actions.high, observations.shape[0], recipe.env_id)
    episodes = recipe.measure.reference_episodes
    episode_stats = rollouts.evaluate(policy, seed, (int(Purpose.REFERENCE), 0), episodes, False)
    return summary(episode_stats) | {"episodes": episodes}


def _write(out: Path, evaluator: RungEvaluator, roles: dict[int, str], info: JsonObject) -> None:
    """Write the ladder to a temporary folder, then rename it; ladder.json, written last, says it is complete."""
    folder = evaluator.folder
    temporary = out.with_name(f".{out.name}.partial")
    with write_errors(str(out)):
        restore_replaced(out)
        delete(temporary)
        (temporary / "policies").mkdir(parents=True)
        for step in roles:
            # rewritten, because policy files of earlier versions have no hash
            read_policy_file(folder.policy(step)).save(temporary / "policies" / folder.policy(step).name)
        write_bytes(temporary / "ladder.csv", csv_bytes(COLUMNS, _table(evaluator, roles)))
        info["medium_replay"] = save_replay(
            temporary / "medium-replay.hdf5", replay_episodes(folder, info["levels"]["medium"])
        )
        if folder.recipe.replay_envs:
            info["medium_replay"] |= {"envs": folder.recipe.replay_envs}
        write_json(temporary / "ladder.json", info)
        check_output_folder(out, folder.path)  # again: the training took hours
        old = replaced_folder(out)
        delete(old)
        if out.exists():
            out.replace(old)
        temporary.replace(out)
        delete(old)


def _table(evaluator: RungEvaluator, roles: dict[int, str]) -> Iterator[list[str | float]]:
    """Yield a row for every rung, and for the policies within segments that were measured.

    Returns are as measured where they were measured, as screened elsewhere; `episodes` says which.
    """
    screened = {
        step: {key.removeprefix("stochastic_"): value for key, value in row.items()}
        for step, row in evaluator.screened.items()
    }
    times = [row["hours"] for row in screened.values()]
    measured = {step for step in evaluator.measured if step <= max(screened)}
    for step in sorted(screened.keys() | measured):
        hours = round(float(np.interp(step, list(screened), times)), 4)
        values: dict[str, str | float] = {"step": step, "hours": hours, **screened.get(step, {})}
        values |= evaluator.measured.get(step, {})
        values |= {"role": roles.get(step, ""), "policy": evaluator.folder.policy(step).name if step in roles else ""}
        yield [values[key] for key in COLUMNS]
