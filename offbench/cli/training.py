"""The commands that train: `train` and `benchmark`. Parse, call, print."""

from __future__ import annotations

import argparse
import shlex
from typing import Any

import offbench
from offbench.cli.algorithm_flags import add_settings, moved_flag, notices
from offbench.cli.arguments import (
    Parser,
    add_trust_flag,
    auto,
    complete_with,
    local_datasets,
    positive_int,
    recipes,
    seed_list,
    shard,
)
from offbench.cli.results import print_scores
from offbench.common.errors import OffbenchError, unknown
from offbench.common.settings import fields
from offbench.common.terminal import hint, note, print_lines
from offbench.common.text import without_steps

SWITCHES = ("--tensorboard", "--trust", "--fresh", "--download", "--")  # flags of `train` that take no value


def train_arguments(parser: Parser, words: list[str]) -> None:
    """Add the arguments of `train`."""
    from offbench.training.registry import algorithm_names

    algorithm, named_settings = _find_algorithm(words)
    names = ", ".join(algorithm_names())
    argument = parser.add_argument("algorithm", metavar="ALGO", help=f"one of {names}, or ./FILE.py:CLASS")
    complete_with(argument, algorithm_names)
    dataset = parser.add_argument(
        "--dataset", required=True, nargs="+", metavar="ID", help="ids of local Minari datasets"
    )
    complete_with(dataset, local_datasets)
    _environment(parser)
    parser.add_argument("--download", action="store_true", help="download missing datasets from Minari's server first")
    parser.add_argument(
        "--seeds",
        type=seed_list,
        default=[0],
        metavar="LIST",
        help="seeds: a list (0,1,2) or a range (0:5 is 0 to 4; default: 0)",
    )
    parser.add_argument("--steps", type=positive_int, default=1_000_000, help="updates (default: 1,000,000)")
    parser.add_argument(
        "--eval-every", type=positive_int, default=5_000, help="updates between evaluations (default: 5,000)"
    )
    parser.add_argument("--eval-episodes", type=positive_int, default=10, help="episodes per evaluation (default: 10)")
    _machine(parser)
    parser.add_argument("--fresh", action="store_true", help="delete the runs of this command and train them again")
    parser.add_argument(
        "--tensorboard", action="store_true", help="write TensorBoard event files into each run's folder"
    )
    parser.add_argument("--wandb", metavar="PROJECT", help="log to a Weights & Biases project")
    if algorithm is None:
        parser.epilog = f"`offbench train ALGO --help` shows an algorithm's own settings.\n\n{parser.epilog}"
        parser.set_defaults(run=lambda **_: parser.error("name the algorithm first: offbench train ALGO --dataset ID"))
        return
    moved = moved_flag(algorithm, named_settings, words)
    algorithm = "bdb_plus" if moved else algorithm
    parser.help_command = f"offbench train {algorithm}"
    config = add_settings(parser, algorithm)

    def run(**arguments: Any) -> None:
        from offbench.training.registry import RESERVED_SETTINGS
        from offbench.training.run import Run

        settings = {key.removeprefix("setting_"): v for key, v in arguments.items() if key.startswith("setting_")}
        rest = {key: value for key, value in arguments.items() if not key.startswith("setting_")}
        for name in named_settings:
            if name in settings or (name == "precision" and name in rest):
                raise OffbenchError(f"{name} is part of the method's name and of the flags; leave one out")
        rest["algorithm"], settings = algorithm, named_settings | settings
        if "precision" in named_settings:  # part of a method's name, but not a setting
            (rest["precision"],) = settings.pop("precision")
        if reserved := RESERVED_SETTINGS & settings.keys():
            raise unknown(f"setting of {algorithm}", min(reserved), fields(config))
        if moved:
            note(f"{moved} is an option of bdb_plus, no longer of bdb: training bdb_plus")
        kept = [word for word in words if word != "--fresh"]  # whoever repeats the command resumes
        folders = offbench.train(**rest, **settings, command=shlex.join(["offbench", "train", *kept]))
        for folder in folders:
            print(folder)
        for text in notices(config, settings):
            note(text)
        if any(Run(folder).evaluations() for folder in folders):
            hint("offbench", "normalize", *([] if rest["runs"] == "runs" else ["--runs", rest["runs"]]))
        else:
            command = shlex.join(["offbench", "evaluate", str(folders[0]), "--env", "ENV"])
            note(f"the dataset names no environment to evaluate in; give one: `{command}`")

    parser.set_defaults(run=run)


def _find_algorithm(words: list[str]) -> tuple[str | None, dict[str, Any]]:
    """Return the algorithm, the first word that is neither a flag nor a flag's value, and the settings in its name.

    A method's name from a table is understood: `bdb (beta=0.5)` is bdb with beta 0.5.
    """
    for before, word in zip(["", *words], words, strict=False):
        taken = before.startswith("--") and "=" not in before and before not in SWITCHES
        if not taken and not word.startswith("-"):
            name, bracket, rest = without_steps(word).partition(" (")
            parts = [part.strip() for part in rest.removesuffix(")").split(",")] if bracket else []
            pairs = [part.partition("=") if "=" in part else ("beta", "=", part) for part in parts]
            return name, {key: [value] for key, _, value in pairs}
    return None, {}


def _print(line: str) -> None:
    print_lines([line])


def _environment(parser: Parser) -> None:
    env = parser.add_argument(
        "--env", metavar="RECIPE", help="the environment to evaluate in (default: the one that the dataset names)"
    )
    complete_with(env, recipes)


def _machine(parser: Parser) -> None:
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto)")
    parser.add_argument(
        "--workers", type=positive_int, help="processes for training and evaluation (default: one per core)"
    )
    parser.add_argument(
        "--stack",
        type=auto,
        default="auto",
        metavar="N",
        help="maximum number of runs trained as one program, or auto (default: auto)",
    )
    parser.add_argument(
        "--precision",
        default=argparse.SUPPRESS,
        metavar="TYPE",
        help="precision of matrix multiplications: float32, tf32 (GPUs) or bfloat16 (default: float32)",
    )
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the runs (default: runs)")
    add_trust_flag(parser)


def benchmark_arguments(parser: Parser, words: list[str]) -> None:
    """Add the arguments of `benchmark`."""
    from offbench.benchmarks.grid import shipped_grids

    grid = parser.add_argument("grid", metavar="GRID", help=f"{', '.join(shipped_grids())}, or a grid file")
    complete_with(grid, shipped_grids)
    _environment(parser)
    parser.add_argument("--plan", action="store_true", help="print the runs, their time and disk space, and exit")
    parser.add_argument("--budget", metavar="TIME", help="write checkpoints and stop after this time: 90s, 9m or 2h")
    parser.add_argument(
        "--shard", type=shard, default=(0, 1), metavar="I/N", help="train only part I of N; I is from 0 to N-1"
    )
    parser.add_argument(
        "--executor",
        choices=("local", "ray"),
        metavar="NAME",
        help="where to train: local or ray (default: local)",
    )
    parser.add_argument(
        "--address", help="address of the Ray cluster, e.g. auto or ray://head:10001 (default: start one here)"
    )
    _machine(parser)

    def run(
        plan: bool,
        budget: str | None,
        shard: tuple[int, int],
        executor: str | None,
        address: str | None,
        **arguments: Any,
    ) -> None:
        from offbench.analysis import normalize
        from offbench.benchmarks.plan import prepare, write_plan

        for name, value in (("budget", budget), ("executor", executor), ("address", address)):
            if plan and value:
                raise OffbenchError(f"--{name} has no effect with --plan; leave it out")
        if address and executor != "ray":
            raise OffbenchError("--address needs --executor ray")
        if plan:
            write_plan(prepare(**arguments), shard, _print)
            return
        command = shlex.join(["offbench", "benchmark", *words])
        ray_executor = None
        if executor == "ray":
            from offbench.benchmarks.ray_executor import RayExecutor

            ray_executor = RayExecutor(address)
            arguments["workers"] = arguments["workers"] or ray_executor.cpus
        bench = prepare(**arguments)
        finished = offbench.benchmark(
            bench, budget=budget, shard=shard, executor=ray_executor, say=_print, command=command
        )
        if rows := normalize.score_rows_of(bench.started()):  # a small budget ends before there are any
            print_scores(rows)
        runs = [] if arguments["runs"] == "runs" else ["--runs", arguments["runs"]]
        if finished:
            hint("offbench", "report", *runs)
        else:
            note("stopped at the budget; rerun the same command to resume")

    parser.set_defaults(run=run)
