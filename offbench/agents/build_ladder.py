"""Building the ladder: which rungs recording needs, chosen by measured return.

    a training's folder (every rung, a few episodes each)
        -> expert   the best of the late rungs, by measured return
        -> medium   the first rung at one third (to 0.45) of the expert's normalised return
        -> others   the rungs nearest 1/12, 2/12, ... of it, for `--level FRACTION`
        -> ladder/  ladder.json  ladder.csv  policies/*.safetensors  medium-replay.hdf5

Returns are of the sampling policy, normalised between the uniform-random and the expert reference. A rung is
chosen on one set of episodes; the expert's reference score is measured on another, so being chosen for its
luck does not flatter it.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbench.agents.ladder import MEDIUM, MEDIUM_AT_MOST, Ladder, read_ladder
from offbench.common.errors import OffbenchError
from offbench.common.files import csv_bytes, disk_errors, read_json, write_bytes, write_json
from offbench.common.provenance import versions
from offbench.common.seeds import Purpose
from offbench.envs.environments import make_env
from offbench.rollouts.policy import Policy, load_policy, uniform
from offbench.rollouts.rollouts import MEASURES, Outcome, Rollouts, result, summary

if TYPE_CHECKING:
    from offbench.agents.sac import Training

CANDIDATES = 8  # late rungs that are measured to find the expert
LOOKS = 6  # rungs that are measured to find the one nearest a return
COLUMNS = ("step", "hours", "role", "policy", *MEASURES, *(f"deterministic_{m}" for m in MEASURES), "episodes")


class Surveyor:
    """Measures rungs of a training, each at most once."""

    def __init__(self, training: Training, rows: list[dict[str, float]], rollouts: Rollouts) -> None:
        self.training, self.rollouts = training, rollouts
        self.screened = {int(row["step"]): row for row in rows}
        self.measured: dict[int, dict[str, float]] = {}

    def measure(self, step: int) -> float:
        """Return the mean return of a rung over the recipe's `rung_episodes`."""
        if step not in self.measured:
            policy = load_policy(self.training.policy(step))
            count = self.training.recipe.measure.rung_episodes
            row: dict[str, float] = {"episodes": count}
            for prefix, deterministic in (("", False), ("deterministic_", True)):
                stream = (int(Purpose.MEASURE), step, int(deterministic))
                row |= summary(self.run(policy, stream, count, deterministic), prefix)
            self.measured[step] = row
            _say(f"rung {step}: return {row['return']:.1f} over {count} episodes")
        return self.measured[step]["return"]

    def run(self, policy: Policy, stream: tuple[int, ...], count: int, deterministic: bool = False) -> list[Outcome]:
        """Play evaluation episodes."""
        outcomes: list[Outcome] = result(
            self.rollouts.outcomes(policy, self.training.seed, stream, count, deterministic)
        )
        return outcomes

    def expert(self) -> int:
        """Return the best rung of the second half by measured return."""
        last = max(self.screened)
        late = [step for step in self.screened if step > last / 2]
        late.sort(key=lambda step: self.screened[step]["stochastic_return"], reverse=True)
        return max(late[:CANDIDATES], key=self.measure)

    def medium(self, target: float, most: float, expert: int) -> int:
        """Return the first rung measured between `target` and `most`, else the one nearest to `target`."""
        early = [step for step in sorted(self.screened) if step <= expert]
        for step in early:
            # measure only what its screening interval says might lie there
            if self.screened[step]["stochastic_high"] >= target and target <= self.measure(step) <= most:
                return step
        return self.nearest(target, most - target, early)

    def nearest(self, target: float, close: float, among: Iterable[int] | None = None) -> int:
        """Return the rung (of those `among`) whose return lies nearest `target`, as measured.

        The few episodes that screened the rungs say where to look: the most promising are measured in turn,
        until one proves to lie within `close` or nothing that was not measured looks nearer.
        """
        steps = list(self.screened if among is None else among)

        def distance(step: int) -> float:
            known = self.measured.get(step, {}).get("return", self.screened[step]["stochastic_return"])
            return abs(known - target)

        for _ in range(LOOKS):
            step = min(steps, key=distance)
            if step in self.measured:
                return step
            self.measure(step)
            if distance(step) <= close:
                return step
        return min((step for step in steps if step in self.measured), key=distance)


def check_place(out: Path) -> Path:
    """Return the folder where a ladder may be written, absolute.

    Raises:
        OffbenchError: it holds something else, which a new ladder would replace.
    """
    out = out.resolve()
    if out.exists() and not out.is_dir():
        raise OffbenchError(f"{out} is a file; a ladder needs a folder of its own")
    if out.exists() and any(out.iterdir()) and not (out / "ladder.json").exists():
        raise OffbenchError(
            f"{out} holds other files, which a ladder would replace; delete it, or give an empty or new folder"
        )
    return out


def build_ladder(training: Training, steps: int, out: Path, workers: int, command: str) -> Ladder:
    """Choose and measure the rungs of a training up to `steps`, and write the ladder's folder `out`.

    Raises:
        OffbenchError: no rung beats the random policy, or the disk refuses.
    """
    from offbench.agents.sac import read_rungs  # here, because behaviour needs PyTorch and collect does not

    rows = [row for row in read_rungs(training.rungs) if row["step"] <= steps]
    if not rows:
        raise OffbenchError(f"{training.folder} has no rung yet; train at least one segment")
    spec = training.recipe.env_spec()
    with Rollouts(spec, workers) as rollouts:
        surveyor = Surveyor(training, rows, rollouts)
        episodes = training.recipe.measure.reference_episodes
        random = _random_policy(spec, training.recipe.env_id)
        references = {"random": summary(surveyor.run(random, (int(Purpose.REFERENCE), 0), episodes))}
        expert = surveyor.expert()
        policy = load_policy(training.policy(expert))
        references["expert"] = summary(surveyor.run(policy, (int(Purpose.REFERENCE), 1), episodes))
        worst, best = references["random"]["return"], references["expert"]["return"]
        if best <= worst:
            raise OffbenchError(
                f"after {steps:,} steps no rung beats the random policy: the best returns {best:.1f} over "
                f"{episodes} fresh episodes, random {worst:.1f}; train on with `offbench behaviour ENV --steps N`"
            )
        medium = surveyor.medium(worst + MEDIUM * (best - worst), worst + MEDIUM_AT_MOST * (best - worst), expert)
        parts = training.recipe.measure.rungs
        part = (best - worst) / parts
        others = {surveyor.nearest(worst + i * part, part / 4) for i in range(1, parts)}
    roles: dict[int, str] = dict.fromkeys(sorted(others | {medium, expert}), "")
    for step, role in ((medium, "medium"), (expert, "expert")):
        roles[step] = f"{roles[step]}+{role}".lstrip("+")
    trained = read_json(training.folder / "training.json")
    info = trained | {
        "versions": trained["versions"] | {"offbench": versions()["offbench"]},
        "format": "offbench-ladder-1",
        "command": command,
        "steps": steps,
        "hours": rows[-1]["hours"],
        "references": {name: values | {"episodes": episodes} for name, values in references.items()},
        "levels": {"medium": medium, "expert": expert},
    }
    _write(training, out, rows, surveyor, roles, info)
    ladder = read_ladder(out)
    assert ladder is not None
    return ladder


def _random_policy(spec: str, env_id: str) -> Policy:
    env = make_env(spec)
    space, dim = env.action_space, env.observation_space.shape
    env.close()
    assert dim is not None
    return uniform(space.low, space.high, dim[0], env_id)  # type: ignore[attr-defined]


def _write(
    training: Training,
    out: Path,
    rows: list[dict[str, float]],
    surveyor: Surveyor,
    roles: dict[int, str],
    info: dict[str, Any],
) -> None:
    """Write the ladder aside, then put it in its place; ladder.json says it is whole."""
    from offbench.agents.medium_replay import replay_episodes, save_replay

    aside = out.with_name(f".{out.name}.partial")
    with disk_errors(str(out)):
        shutil.rmtree(aside, ignore_errors=True)
        (aside / "policies").mkdir(parents=True)
        for step in roles:
            # written anew: a policy of an older offbench has no hash of its own yet
            load_policy(training.policy(step)).save(aside / "policies" / training.policy(step).name)
        write_bytes(aside / "ladder.csv", csv_bytes(COLUMNS, _table(training, rows, surveyor, roles)))
        info["medium_replay"] = save_replay(
            aside / "medium-replay.hdf5", replay_episodes(training, info["levels"]["medium"])
        )
        write_json(aside / "ladder.json", info)
        old = out.with_name(f".{out.name}.old")
        shutil.rmtree(old, ignore_errors=True)
        if out.exists():
            out.replace(old)
        aside.replace(out)
        shutil.rmtree(old, ignore_errors=True)


def _table(
    training: Training, rows: list[dict[str, float]], surveyor: Surveyor, roles: dict[int, str]
) -> Iterator[list[Any]]:
    """Yield a row for every rung: measured where it was measured, screened elsewhere; `episodes` says which."""
    for row in rows:
        step = int(row["step"])
        values = {key.removeprefix("stochastic_"): value for key, value in row.items()}
        values |= surveyor.measured.get(step, {})
        kept = {"role": roles.get(step, ""), "policy": training.policy(step).name if step in roles else ""}
        yield [(values | kept)[key] for key in COLUMNS]


def _say(line: str) -> None:
    print(f"offbench: {line}", file=sys.stderr, flush=True)
