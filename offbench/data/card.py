"""`card`: an environment's dataset card, from its ladder and its five recorded levels.

    card.json   each level's statistics, the versions they hold for, and a content hash for each MuJoCo version
    README.md   the same for people, with references, rungs and provenance
    card.png    the learning curve and the histogram of returns of each level

`collect` compares the content hash of a level that it records at full size with the shipped card.json, and prints
whether the data are the same.
"""

from __future__ import annotations

import csv
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from offbench.agents.ladder import BEHAVIOUR, Ladder, find_ladder
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, read_json, write_bytes, write_json
from offbench.common.plotting import default_style, figure, save
from offbench.common.provenance import PHYSICS, versions
from offbench.common.scores import normalize
from offbench.common.tables import markdown
from offbench.common.terminal import inform, warn
from offbench.data import minari_store
from offbench.data.levels import LEVELS, full_size
from offbench.data.show import Summary, bin_range, show
from offbench.envs.recipes import Recipe, load_recipe

BINS = 50
BLUE, RED = "#3b6ea5", "#c4443c"


def card(env: str | Path, out: str | Path | None = None, behaviour_dir: str | Path = BEHAVIOUR) -> Path:
    """Write the card of an environment from its five recorded levels (seed 0, the recipe's size).

    Args:
        env: a shipped recipe's name, or a recipe file.
        out: the folder of the card; default `<env>-card`.
        behaviour_dir: where agents trained here live, for an environment whose agent is not shipped.

    Returns:
        The folder.

    Raises:
        OffbenchError: a level is missing or was recorded with other settings, or there is no ladder.
    """
    env = str(env)
    recipe = load_recipe(env)
    ladder = find_ladder(recipe, Path(behaviour_dir))
    if ladder is None:
        raise OffbenchError(
            f"{recipe.name} has no ladder: none is shipped, and there is none in {behaviour_dir}; "
            f"train one with `offbench behaviour {shlex.quote(env)}`, or pass its folder as --behaviour-dir"
        )
    own = [] if Path(behaviour_dir) == Path(BEHAVIOUR) else ["--behaviour-dir", str(behaviour_dir)]
    collect = shlex.join(["offbench", "collect", env, *own])
    levels = {level: _recorded(recipe, ladder, level, collect) for level in LEVELS}
    facts = {level: _facts(recipe, summary) for level, summary in levels.items()}
    means = [facts[level]["return"] for level in LEVELS]
    if sorted(means) != means:
        warn(f"the levels of {recipe.name} are out of order: {means}")
    folder = Path(out or f"{recipe.name}-card")
    used = {name: versions()[name] for name in PHYSICS}
    _add_shipped_hashes(recipe, facts, used["mujoco"])
    write_json(folder / "card.json", {"format": "offbench-card-2", "versions": used, "levels": facts})
    with default_style():
        _draw(recipe, ladder, levels, folder / "card.png")
    write_bytes(folder / "README.md", _text(env, recipe, ladder, facts, used).encode())
    return folder


def compare_with_card(recipe: Recipe, level: str, content_sha256: str) -> None:
    """Print whether a level recorded at full size has the content on the shipped card, if the card has that level."""
    card = _shipped_card(recipe)
    if card is None or level not in card["levels"]:
        return
    contents = card["levels"][level]["content_sha256"]
    if content_sha256 in contents.values():
        inform("content equal to the dataset card's, bit for bit")
        return
    here = versions()["mujoco"]
    used = card["versions"] | {"mujoco": here if here in contents else next(iter(contents))}
    others = [f"{name} {version}" for name, version in used.items() if versions()[name] != version]
    reason = (
        f"which was made with {', '.join(others)}"
        if others
        else "although the versions are the same (a different processor or C library?)"
    )
    warn(f"content differs from the dataset card's, {reason}")


def expected_episode_length(recipe: Recipe, level: str) -> float | None:
    """Return the mean length of a level's episodes by the shipped card, None if there is no card with the level."""
    card = _shipped_card(recipe)
    facts = card["levels"].get(level) if card else None
    return facts["transitions"] / facts["episodes"] if facts else None


def _shipped_card(recipe: Recipe) -> JsonObject | None:
    path = recipe.folder / "card.json" if recipe.folder else None
    return read_json(path) if path is not None and path.exists() else None


def _add_shipped_hashes(recipe: Recipe, facts: dict[str, JsonObject], mujoco: str) -> None:
    """Add the shipped card's content hashes of other MuJoCo versions to each level, if it describes the same ladder.

    The content of medium-replay shows it: it comes from training, so it is the same on every MuJoCo version.
    """
    card = _shipped_card(recipe)
    shipped = card["levels"] if card else {}
    same = shipped and facts["medium-replay"]["content_sha256"] in shipped["medium-replay"]["content_sha256"].values()
    for level, values in facts.items():
        others = shipped[level]["content_sha256"] if same else {}
        values["content_sha256"] = {mujoco: values["content_sha256"]} | {
            v: c for v, c in others.items() if v != mujoco
        }


def _recorded(recipe: Recipe, ladder: Ladder, level: str, collect: str) -> Summary:
    """Return a recorded level after checking its seed, size and references. `collect` is the command to record it."""
    dataset_id = f"{recipe.name}-{level}-v{recipe.version}"
    if dataset_id not in minari_store.local_ids():
        raise OffbenchError(f"{dataset_id} is not recorded yet; first `{collect} --level {level}`")
    summary = show(dataset_id)
    provenance = minari_store.read_provenance(summary.metadata)
    parts = LEVELS[level]
    size = full_size(parts, recipe.dataset_steps, ladder.info.medium_replay.transitions)
    same = provenance.references == ladder.info.references and provenance.seed == 0
    if not same or int(summary.lengths.sum()) != size:
        raise OffbenchError(
            f"{dataset_id} does not match the card (seed 0, {size:,.0f} transitions, the references of this ladder); "
            f"record it with `{collect} --level {level} --overwrite`"
        )
    return summary


def _facts(recipe: Recipe, summary: Summary) -> JsonObject:
    meta, returns = summary.metadata, np.asarray(summary.returns)
    mean = float(returns.mean())
    d4rl = recipe.d4rl_reference()
    return {
        "transitions": int(summary.lengths.sum()),
        "episodes": len(returns),
        "return": round(mean, 2),
        "std": round(float(returns.std()), 2),
        "min": round(float(returns.min()), 2),
        "max": round(float(returns.max()), 2),
        "score": round(normalize(mean, float(meta["ref_min_score"]), float(meta["ref_max_score"])), 2) + 0.0,  # no -0
        "d4rl_score": round(normalize(mean, *d4rl), 2) if d4rl else None,
        "terminated": round(summary.terminated, 4),
        "content_sha256": minari_store.read_provenance(meta).content_sha256,
    }


def _text(env: str, recipe: Recipe, ladder: Ladder, facts: JsonObject, used: Mapping[str, str]) -> str:
    info = ladder.info
    header = ["level", "transitions", "episodes", "mean return", "std", "min", "max"]
    header += ["score (own ref.)", "score (D4RL ref.)", "episodes terminated"]
    levels = _table(header, [_cells(level, values) for level, values in facts.items()])
    references = _table(
        ["policy", "score", "mean return", "95% interval", "episodes"],
        [
            [name, score, f"{ref['return']:.1f}", f"{ref['low']:.1f} to {ref['high']:.1f}", str(ref["episodes"])]
            for name, score in (("random", "0"), ("expert", "100"))
            for ref in [info.references[name]]
        ],
    )
    rungs = _table(
        ["step", "mean return", "95% interval", "fraction of expert", "level"],
        [
            [f"{r.step:,}", f"{r.ret:.1f}", f"{r.low:.1f} to {r.high:.1f}", f"{ladder.fraction(r):.2f}", r.role]
            for r in ladder.rungs
        ],
    )
    hashes = [(level, *item) for level, values in facts.items() for item in values["content_sha256"].items()]
    contents = _table(["level", "mujoco", "content"], [[level, version, f"`{c}`"] for level, version, c in hashes])
    links = f"all saved policies: `{ladder.folder}`"
    if recipe.folder:
        saved = "[behaviour/ladder.csv](behaviour/ladder.csv)"
        links = f"settings and their reasons: [recipe.toml](recipe.toml); all saved policies: {saved}"
    others = ", ".join(f"{name} {version}" for name, version in used.items() if name != "mujoco")
    return f"""\
# {recipe.name}: {recipe.env_id}

Generated by `offbench card {shlex.quote(env)}`. [card.json](card.json) has the same numbers in machine-readable form.

![Learning curve of the behaviour agent; returns of each level](card.png)

## Levels

{levels}

Returns are per episode; std is the standard deviation over episodes. An episode cut off at the level's size is \
truncated.

## References

{references}

## Behaviour agent

Stable-Baselines3's SAC, seed {info.seed}: {info.steps:,} environment steps, {info.sac["gradient_steps"]:g} gradient \
steps per environment step, {info.hours:.1f} hours on one core ({info.hardware["processor"]}). Command: \
`{info.command}`; {links}.

Policies of the ladder, with the measured return of the stochastic policy. `--level FRACTION` selects the nearest one:

{rungs}

## Content

SHA-256 over the arrays in episode order, with {others} and each MuJoCo version:

{contents}

`offbench collect` prints whether the dataset that it recorded has the same content.
"""


def _table(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    return "\n".join(markdown(header, cells))


def _cells(level: str, values: JsonObject) -> list[str]:
    spread = [_short(values[key]) for key in ("return", "std", "min", "max", "score", "d4rl_score")]
    return [
        level,
        f"{values['transitions']:,}",
        f"{values['episodes']:,}",
        *spread,
        f"{100 * values['terminated']:.1f}%",
    ]


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:z,.1f}"


def _draw(recipe: Recipe, ladder: Ladder, levels: Mapping[str, Summary], path: Path) -> None:
    with open(ladder.folder / "ladder.csv", newline="", encoding="utf-8") as file:
        rows = [{key: row[key] for key in ("step", "return", "deterministic_return")} for row in csv.DictReader(file)]
    steps = [int(row["step"]) for row in rows]
    fig, (left, right) = figure(2)
    for key, name, color in (("return", "sampled", BLUE), ("deterministic_return", "deterministic", "#9ab8d6")):
        left.plot(steps, [float(row[key]) for row in rows], color=color, linewidth=1, label=name)
    kept = ladder.rungs
    left.plot([r.step for r in kept], [r.ret for r in kept], "o", markersize=4, color=RED, label="kept")
    left.set(xlabel="environment steps", ylabel="return", title=f"SAC on {recipe.env_id}")
    left.legend(frameon=False)
    low, high = bin_range(np.concatenate([summary.returns for summary in levels.values()]))
    edges = np.linspace(low, high, BINS + 1)
    for bottom, summary in enumerate(levels.values()):
        counts, _ = np.histogram(summary.returns, edges)
        # a square root, so that rare returns stay visible beside the frequent ones
        right.stairs(bottom + 0.85 * np.sqrt(counts / counts.max()), edges, baseline=bottom, fill=True, color=BLUE)
        right.plot([summary.returns.mean()] * 2, [bottom, bottom + 0.85], color=RED, linewidth=1.2)
    right.set_yticks(np.arange(len(levels)) + 0.3, list(levels))
    right.set(xlabel="return", title="episodes by return (root scale; line: mean)")
    save(fig, path)
