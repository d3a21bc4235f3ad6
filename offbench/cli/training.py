"""The command line of training: `train` and `benchmark`. Parse, call, print."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from typing import Any

from offbench.cli.arguments import Parser, auto, seed_list, share, trust, whole

SWITCHES = ("--tensorboard", "--trust")  # flags of `train` without a value: the algorithm may follow them


def train_arguments(parser: Parser, words: list[str]) -> None:
    """Add the arguments of `train`."""
    from offbench.common.settings import fields
    from offbench.training.registry import algorithm_names, load_algorithm

    parser.add_argument("algorithm", metavar="ALGO", help=f"one of {', '.join(algorithm_names())}")
    parser.add_argument("--dataset", required=True, nargs="+", metavar="ID", help="local Minari datasets")
    parser.add_argument(
        "--seeds",
        type=seed_list,
        default=[0],
        metavar="LIST",
        help="which: 0,1,2 or 0:5 (0 to 4); 3 is the seed 3, where a grid's `seeds = 3` is three (default: 0)",
    )
    parser.add_argument("--steps", type=whole, default=1_000_000, help="updates (default: 1,000,000)")
    parser.add_argument("--eval-every", type=whole, default=5_000, help="updates between evaluations (default: 5,000)")
    parser.add_argument("--eval-episodes", type=whole, default=10, help="episodes of an evaluation (default: 10)")
    _machine(parser)
    parser.add_argument("--tensorboard", action="store_true", help="write event files beside each run")
    parser.add_argument("--wandb", metavar="PROJECT", help="show the runs in a Weights & Biases project")
    algorithm = _algorithm(words)
    if algorithm is None:
        parser.epilog = "`offbench train ALGO --help` shows the algorithm's own settings."
        parser.set_defaults(run=lambda **_: parser.error("name the algorithm first: offbench train ALGO --dataset ID"))
        return
    known = fields(load_algorithm(algorithm).Config)
    parser.asked = f"offbench train {algorithm}"
    group = parser.add_argument_group(f"settings of {algorithm}")
    for name, field in known.items():
        group.add_argument(
            f"--{name.replace('_', '-')}",
            dest=f"setting_{name}",
            nargs="+",
            metavar="N,N" if isinstance(field.default, tuple) else "X",
            default=argparse.SUPPRESS,
            help=_help(field).replace("%", "%%"),
        )

    def run(**arguments: Any) -> None:
        from offbench.training.run import Run
        from offbench.training.train import train

        settings = {key.removeprefix("setting_"): v for key, v in arguments.items() if key.startswith("setting_")}
        rest = {key: value for key, value in arguments.items() if not key.startswith("setting_")}
        folders = train(**rest, **settings, command=shlex.join(["offbench", "train", *words]))
        for folder in folders:
            print(folder)
        if any(Run(folder).evaluations() for folder in folders):
            print(f"next: {shlex.join(['offbench', 'normalize', '--runs', rest['runs']])}")
        else:
            evaluate = shlex.join(["offbench", "evaluate", str(folders[0])])
            print(f"next: {evaluate} --env RECIPE, with a recipe of the environment that the dataset is of")

    parser.set_defaults(run=run)


def _algorithm(words: list[str]) -> str | None:
    """Return the first word that is neither a flag nor a flag's value."""
    for before, word in zip(["", *words], words, strict=False):
        taken = before.startswith("--") and "=" not in before and not any(s.startswith(before) for s in SWITCHES)
        if not taken and not word.startswith("-"):
            return word
    return None


def _machine(parser: Parser) -> None:
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto)")
    parser.add_argument("--workers", type=whole, help="processes for training and evaluation (default: one a core)")
    parser.add_argument("--stack", type=auto, default="auto", help="most runs that train as one program (auto or N)")
    parser.add_argument(
        "--precision",
        default="float32",
        help="of matrix products: float32, tf32 (GPUs), bfloat16 (GPUs and some processors) (default: float32)",
    )
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    trust(parser)


def benchmark_arguments(parser: Parser, words: list[str]) -> None:
    """Add the arguments of `benchmark`."""
    from offbench.benchmarks.grid import shipped_grids

    parser.add_argument("grid", metavar="GRID", help=f"{', '.join(shipped_grids())}, or a grid file")
    parser.add_argument("--plan", action="store_true", help="print runs, cost and disk, and do nothing")
    parser.add_argument("--budget", metavar="TIME", help="stop training cleanly after 90s, 9m or 2h")
    parser.add_argument("--shard", type=share, default=(0, 1), metavar="I/N", help="the I-th of N shares, I from 0")
    parser.add_argument("--executor", choices=("local", "ray"), default="local", help="default: local processes")
    parser.add_argument(
        "--address", help="of the Ray cluster, e.g. auto or ray://head:10001 (default: start one here)"
    )
    _machine(parser)

    def run(
        plan: bool,
        budget: str | None,
        shard: tuple[int, int],
        executor: str,
        address: str | None,
        **arguments: Any,
    ) -> None:
        from offbench.analysis import normalize
        from offbench.benchmarks.benchmark import benchmark
        from offbench.benchmarks.plan import Plan, prepare

        if plan:
            print("\n".join(Plan(prepare(**arguments))))
            return
        command = shlex.join(["offbench", "benchmark", *words])
        where = None
        if executor == "ray":
            from offbench.benchmarks.ray_executor import RayExecutor

            where = RayExecutor(address)
            arguments["workers"] = arguments["workers"] or where.cpus
        bench = prepare(**arguments)
        finished = benchmark(bench, budget=budget, shard=shard, executor=where, command=command)
        if rows := normalize.score_some(bench.started()):  # a small budget ends before there are any
            print(normalize.render(rows))
        if not finished:
            print("stopped at the budget; the same command goes on", file=sys.stderr)

    parser.set_defaults(run=run)


def _help(field: dataclasses.Field[Any]) -> str:
    """Return a setting's help, with the words that it may be and its default."""
    words = " | ".join(field.metadata.get("choices") or ())
    default = ",".join(map(str, field.default)) if isinstance(field.default, tuple) else str(field.default)
    return f"{field.metadata.get('help', '')} ({words}{'; ' if words else ''}default: {default})"
