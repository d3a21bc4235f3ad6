"""`behaviour`: train an environment's behaviour agent, then choose and measure its ladder."""

from __future__ import annotations

import shlex
from pathlib import Path

from offbench.agents.build_ladder import build_ladder, check_output_folder
from offbench.agents.ladder import BEHAVIOUR, Ladder, folder_of
from offbench.agents.sac import train
from offbench.agents.training_folder import TrainingFolder
from offbench.common.errors import OffbenchError
from offbench.common.processes import default_workers
from offbench.common.seeds import check_seed
from offbench.common.settings import check_count
from offbench.envs.recipes import Recipe, load_recipe


def behaviour(
    env: str | Path | Recipe,
    *,
    seed: int = 0,
    steps: int | None = None,
    workers: int | None = None,
    behaviour_dir: str | Path = BEHAVIOUR,
    out: str | Path | None = None,
) -> Ladder:
    """Train SAC on an environment, resuming from the last checkpoint, and build its ladder.

    Args:
        env: a shipped recipe's name, a recipe file, or a Recipe.
        seed: seed of the training. The same recipe and seed give the same weights.
        steps: environment steps; default: the recipe's. Steps beyond the recipe's use its final learning
            rate. If more are trained already, the ladder is built from the first `steps`.
        workers: processes that measure the rungs (training itself is one process of one thread).
        behaviour_dir: the folder of all trainings.
        out: the folder of the ladder; default: `ladder` in the training's folder.

    Returns:
        The ladder.

    Raises:
        OffbenchError: a bad argument, a folder of another training, or no policy better than random actions.
    """
    recipe, seed = env if isinstance(env, Recipe) else load_recipe(env), check_seed(seed)
    steps = recipe.sac.steps if steps is None else check_count("steps", steps)
    segment = recipe.sac.segment
    if steps < segment or steps % segment:
        raise OffbenchError(f"steps must be a multiple of {segment} (the recipe's segment), not {steps}")
    folder = TrainingFolder(recipe, seed, folder_of(recipe, seed, Path(behaviour_dir)))
    ladder = check_output_folder(Path(out) if out else folder.path / "ladder", folder.path)
    train(folder, steps)
    name = recipe.name if isinstance(env, Recipe) else shlex.quote(str(env))
    command = f"offbench behaviour {name} --seed {seed} --steps {steps}"
    with folder.locked():
        return build_ladder(folder, steps, ladder, default_workers(workers), command)
