"""Run folders made up for tests of tables and pictures: plausible curves, no training behind them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from offbench.common.files import write_json
from offbench.training.run import Run
from offbench.training.run_config import RunConfig
from offbench.training.spec import run_folder

COMMAND = "offbench train {algorithm} --dataset {dataset} --seeds 0:{seeds} --steps {steps}"


def made_run(
    root: Path,
    dataset: str,
    algorithm: str,
    variant: str,
    seed: int,
    level: float,
    *,
    steps: int = 30_000,
    reached: int | None = None,
    references: Any = ([0.0, 100.0], [-10.0, 190.0]),
    settings: dict[str, Any] | None = None,
    beta: float | None = None,
    noise: float = 3.0,
    returns: dict[int, float] | None = None,
) -> Run:
    """Write one run: config, evaluations of 3 episodes, losses.

    Its score rises to about `level` in 12 evaluations; or its evaluations have the `returns` given for each step.
    """
    run = Run(run_folder(root, dataset, algorithm, variant, seed))
    run.folder.mkdir(parents=True)
    every = min(returns) if returns else steps // 12
    config: dict[str, Any] = {
        "format": "offbench-run-1",
        "algorithm": algorithm,
        "variant": variant,
        "settings": settings or {},
        "dataset": dataset,
        "dataset_sha256": f"{sum(dataset.encode()):064x}",
        "seed": seed,
        "steps": steps,
        "eval_every": every,
        "eval_episodes": 3,
        "references": {"dataset": references[0], "d4rl": references[1]},
        "env_id": "Hopper-v5",
        "device": "cpu",
        "command": COMMAND.format(algorithm=algorithm, dataset=dataset, seeds=3, steps=steps),
        "versions": {"python": "3.11.7", "offbench": "0.1.0", "mujoco": "3.4.0", "torch": "2.13.0"},
        "hardware": {"processor": "a processor", "cores": 2, "machine": "x86_64"},
    }
    run.claim(RunConfig(**config))
    rng = np.random.default_rng([seed, sum(f"{dataset}{algorithm}{variant}".encode())])
    level += float(rng.normal(0, noise))
    stop = steps if reached is None else reached
    evaluations = {step: [(value, 500)] * 3 for step, value in (returns or {}).items()}
    for step in () if returns else range(every, stop + 1, every):
        mean = level * (1 - np.exp(-4 * step / steps)) + rng.normal(0, noise)
        evaluations[step] = [(float(mean + rng.normal(0, noise)), 500) for _ in range(3)]
    run.write_evaluations(evaluations)
    rows = []
    for step in range(1000, stop + 1, 1000):
        row = {"step": float(step), "critic_loss": 3.0, "q_abs": 200 * (1 - np.exp(-step / 8000)) + rng.normal(0, 4)}
        if beta is not None:
            row["beta"] = beta if beta >= 0 else 1 / (1 + step / 10_000) + rng.normal(0, 0.02)
        rows.append(row)
    run.write_losses(rows)
    return run


METHODS: tuple[tuple[str, str, dict[str, Any], float | None], ...] = (
    ("td3_bc", "default", {}, None),
    ("cql", "default", {}, None),
    ("bdb", "beta=0.25", {"beta": 0.25}, 0.25),
    ("bdb", "beta=0.5", {"beta": 0.5}, 0.5),
    ("bdb", "beta=0.75", {"beta": 0.75}, 0.75),
    ("bdb", "default", {"beta": "adaptive"}, -1.0),
)
LEVELS = {"random": 12.0, "medium-replay": 33.0, "medium": 60.0, "medium-expert": 95.0, "expert": 99.0}


def made_grid(root: Path, envs: tuple[str, ...] = ("hopper",), seeds: int = 3, levels: int = 3) -> Path:
    """Write a whole grid in the paper's shape; cql goes a tenth as far."""
    for env in envs:
        for level, score in list(LEVELS.items())[:levels]:
            for place, (algorithm, variant, settings, beta) in enumerate(METHODS):
                for seed in range(seeds):
                    steps = 3000 if algorithm == "cql" else 30_000
                    dataset = f"{env}-{level}-v0"
                    made = {"settings": settings, "beta": beta, "steps": steps}
                    run = made_run(root, dataset, algorithm, variant, seed, score + 2 * place, **made)
                    found = {"step": steps, "samples": 2560, "tolerance": 0.05, "action_tolerance": 0.1}
                    similar = {"q_similar": 99.0 - 3 * place - seed, "action_similar": 80.0 - 5 * place}
                    write_json(run.folder / "similarity.json", found | similar)
    return root


ROWS = "step,episode,return,length\n100,0,1.0,5\n100,1,2.0,5\n200,0,3.0,5\n200,1,4.0,5\n"


def small_run(folder: Path, rows: str = ROWS, references: list[float] | None = None) -> Run:
    """Write a run of two evaluations of two episodes."""
    seed = int(folder.name.removeprefix("seed-"))
    folder.mkdir(parents=True)
    config = {
        "format": "offbench-run-1",
        "algorithm": "bc",
        "variant": "default",
        "settings": {},
        "dataset": "a-random-v0",
        "dataset_sha256": "0",
        "seed": seed,
        "steps": 200,
        "eval_episodes": 2,
        "references": {"dataset": references or [0.0, 10.0]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "evaluations.csv").write_text(rows)
    return Run(folder)
