"""Levels: the policies that each dataset is recorded from. A new level is one more entry in LEVELS."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from offbench.common.errors import OffbenchError, unknown
from offbench.envs.recipes import shipped_recipes


@dataclass(frozen=True)
class Part:
    """A share of a dataset and where it comes from.

    Attributes:
        source: `uniform` actions, the `medium` or `expert` rung, the `replay` of training, a fraction such as "0.6"
            for the rung nearest to it, or a `policy` of the user's own.
        weight: number of transitions, as a multiple of the recipe's `dataset_steps`.
    """

    source: str
    weight: float = 1.0


POLICY = "policy"
WITHOUT_AGENT = ("uniform", POLICY)  # sources that need no behaviour agent
FRACTION = r"\d+(?:p\d+)?percent"  # the name of a fraction in a dataset id: 60percent, 12p5percent

LEVELS: dict[str, tuple[Part, ...]] = {  # sorted by mean return
    "random": (Part("uniform"),),
    "medium-replay": (Part("replay"),),
    "medium": (Part("medium"),),
    "medium-expert": (Part("medium"), Part("expert")),
    "expert": (Part("expert"),),
}


def parse_level(text: str) -> tuple[str, tuple[Part, ...]]:
    """Return (name in a dataset id, parts) of a level's name or of a fraction such as `0.6`.

    Raises:
        OffbenchError: an unknown level, or a fraction outside (0, 1].
    """
    if text in LEVELS:
        return text, LEVELS[text]
    fraction = _number(text)
    if fraction is None:
        raise unknown("level", text, LEVELS)
    if not 0 < fraction <= 1:
        raise OffbenchError(f"a fraction for --level must be more than 0 and at most 1, not {text}")
    return f"{_percent(fraction)}percent", (Part(str(fraction)),)


def env_and_level(dataset_id: str) -> tuple[str, str]:
    """Return the (environment, level) that an id such as `ns/hopper-60percent-v0` names, else (the id, "")."""
    stem = re.sub(r"-v\d+$", "", dataset_id)
    match = re.fullmatch(rf"(.+?)[-/]({'|'.join(sorted(LEVELS, key=len, reverse=True))}|{FRACTION})", stem)
    return (match[1].split("/")[-1], match[2]) if match else (stem, "")


def recipe_and_level(dataset_id: str) -> tuple[str, str]:
    """Return the shipped recipe that an id such as `hopper-60percent-v0` begins with, and the `--level` after it.

    What is after it need not be a level. The result is ("", "") if the id begins with no recipe.
    """
    body = dataset_id.rpartition("-v")[0]
    for env in sorted(shipped_recipes(), key=len, reverse=True):
        level = body.removeprefix(f"{env}-")
        if level != body:
            return env, level_argument(level)
    return "", ""


def level_argument(name: str) -> str:
    """Return what `--level` takes for a level's name in an id: 60percent is 0.6."""
    if name.endswith("percent"):
        try:
            return f"{float(name.removesuffix('percent').replace('p', '.')) / 100:g}"
        except ValueError:
            return name
    return name


def parse_mix(text: str) -> tuple[str, tuple[Part, ...]]:
    """Return (name, parts) of a mix such as `random:0.5,expert:0.5`; shares are of the recipe's steps.

    Raises:
        OffbenchError: not of that form, an unknown level, or shares that do not add up to 1.
    """
    names, parts = [], []
    for item in text.split(","):
        level, _, share = item.strip().partition(":")
        weight = _number(share)
        if weight is None or not 0 < weight <= 1:
            raise OffbenchError(f"--mix takes LEVEL:SHARE,LEVEL:SHARE with shares in (0, 1], not {item.strip()!r}")
        name, (part, *rest) = parse_level(level)
        if rest:
            raise OffbenchError(f"--mix takes single levels; write {level} as its parts")
        names.append(f"{name}{_percent(weight)}")
        parts.append(Part(part.source, weight))
    total = sum(part.weight for part in parts)
    if not math.isclose(total, 1, abs_tol=1e-6):
        raise OffbenchError(f"the shares of --mix must add up to 1, not {total:g}")
    return "-".join(names), tuple(parts)


def full_size(parts: tuple[Part, ...], dataset_steps: int, replay_steps: int | None = None) -> int:
    """Return the transitions of a level.

    Args:
        dataset_steps: the recipe's number of transitions of a part.
        replay_steps: the number of transitions of the ladder's medium-replay, which is recorded whole; None without a
            ladder.
    """
    if replay_steps is not None and [part.source for part in parts] == ["replay"]:
        return replay_steps
    return round(dataset_steps * sum(part.weight for part in parts))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.6g}".replace(".", "p")


def shares(parts: tuple[Part, ...], total: int) -> list[int]:
    """Divide `total` transitions into the parts' shares; rounding goes to the last part."""
    weights = [part.weight for part in parts]
    cuts = [round(total * sum(weights[: i + 1]) / sum(weights)) for i in range(len(parts))]
    return [end - start for start, end in zip([0, *cuts], cuts, strict=False)]
