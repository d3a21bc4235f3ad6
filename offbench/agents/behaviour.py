"""`behaviour`: train an environment's behaviour agent, then choose and measure its ladder."""

from __future__ import annotations

from pathlib import Path

from offbench.agents.build_ladder import build_ladder, check_place
from offbench.agents.ladder import BEHAVIOUR, Ladder, folder_of
from offbench.agents.sac import Training, train
from offbench.common.errors import OffbenchError
from offbench.common.processes import default_workers
from offbench.envs.recipes import Recipe, load_recipe


def behaviour(
    env: str | Recipe,
    *,
    seed: int = 0,
    steps: int | None = None,
    workers: int | None = None,
    behaviour_dir: str | Path = BEHAVIOUR,
    out: str | Path | None = None,
) -> Ladder:
    """Train SAC on an environment, going on where an earlier call stopped, and build its ladder.

    Args:
        env: a shipped recipe's name, a recipe file, or a Recipe.
        seed: of the training. The same recipe and seed end with the same weights.
        steps: environment steps; default: the recipe's. More than the recipe's trains on at its last
            learning rate; fewer than already trained builds the ladder of the first `steps`.
        workers: processes that measure the rungs (training itself is one process of one thread).
        behaviour_dir: the folder of all trainings.
        out: where the ladder goes; default: `ladder` in the training's folder.

    Returns:
        The ladder.
    """
    recipe = load_recipe(env) if isinstance(env, str) else env
    steps = recipe.sac.steps if steps is None else steps
    segment = recipe.sac.segment
    if steps < segment or steps % segment:
        raise OffbenchError(f"steps must be a multiple of {segment} (the recipe's segment), not {steps}")
    training = Training(recipe, seed, folder_of(recipe, seed, Path(behaviour_dir)))
    place = check_place(Path(out) if out else training.folder / "ladder")
    train(training, steps)
    command = f"offbench behaviour {recipe.name} --seed {seed} --steps {steps}"
    return build_ladder(training, steps, place, default_workers(workers), command)
