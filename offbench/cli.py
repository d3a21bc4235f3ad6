"""The command line: parse, call, print. Everything it does is a function of the package."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from json import dumps
from pathlib import Path
from typing import Any

from offbench import aids, travel
from offbench.arguments import Parser, auto, natural, number, seed_list, share, whole
from offbench.errors import OffbenchError, unknown

COMMANDS = {
    "collect": "record a dataset: random, medium, medium-replay, medium-expert, expert, or a fraction",
    "train": "train an algorithm on a dataset, with evaluations as it goes",
    "benchmark": "a whole grid: datasets x algorithms x settings x seeds, resumable",
    "normalize": "the score table of all runs, or the scores of given returns",
    "report": "all runs as one page, with tables and figures as files",
    "compare": "two methods over the datasets and seeds that both have, with a verdict",
    "evaluate": "play a run's policy, or a policy file",
    "behaviour": "train an environment's behaviour agent (SAC) and build its ladder",
    "list": "environments, levels, algorithms and local datasets",
    "show": "what is in a dataset",
    "verify": "check a dataset: its arrays, its metadata, and a sample of episodes played again",
    "import-d4rl": "turn a D4RL file (v0, v1, v2) into a Minari dataset",
    "export": "write a dataset as a D4RL file, or as arrays (npz)",
    "export-policy": "write a run's policy as TorchScript",
    "card": "write an environment's dataset card from its five recorded levels",
    "video": "film a run's policy, a policy file, or a level such as hopper:medium",
    "doctor": "what a bug report needs: versions, physics, machine, paths; exit code 1 if something is broken",
    "completion": "print a shell's completion of these commands",
}
SWITCHES = ("--tf32", "--tensorboard")  # flags of `train` without a value: the algorithm may follow them


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command.

    Exits with 0, 1 if `verify` found something, 2 for a problem the user can mend, 130 after Ctrl-C.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        _run(words)
    except OffbenchError as error:
        print(f"offbench: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("\noffbench: stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe (`| head`) has left
        sys.stderr.close()
        sys.exit(0)


def _run(words: list[str]) -> None:
    parser = Parser(prog="offbench", description="Offline-RL datasets and benchmarks.")
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    name = next((word for word in words if not word.startswith("-")), None)
    if name is not None and name not in COMMANDS:
        raise unknown("command", name, COMMANDS)
    for command, help_ in COMMANDS.items():
        sub = commands.add_parser(command, help=help_, description=help_[0].upper() + help_[1:] + ".")
        if command == name:  # only the command that runs pays for its arguments
            ADD[command](sub, words[words.index(name) + 1 :])
    arguments = vars(parser.parse_args(words))
    if arguments.pop("command") is None:
        parser.print_help()
        return
    run: Callable[..., None] = arguments.pop("run")
    run(**arguments)


def _version() -> str:
    from importlib.metadata import version

    return f"offbench {version('offbench')}"


def _collect(parser: Parser, _: list[str]) -> None:
    parser.add_argument("env", metavar="ENV", help="a shipped recipe (see `offbench list`) or a recipe file")
    parser.add_argument("--level", default="medium", help="a level or a fraction such as 0.6 (default: medium)")
    parser.add_argument("--mix", metavar="LEVEL:SHARE,...", help="a blend, e.g. random:0.5,expert:0.5")
    parser.add_argument("--steps", type=whole, help="transitions (default: the recipe's, 1,000,000)")
    parser.add_argument("--seed", type=natural, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--workers", type=whole, help="recording processes (default: one a core)")
    parser.add_argument("--id", dest="dataset_id", help="the dataset's id (default: <env>-<level>-v0)")
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset of that id")
    parser.add_argument("--retrain", action="store_true", help="use an agent trained here, not the shipped one")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.record import collect

        dataset_id = collect(**arguments)
        print(f"{dataset_id} recorded; next: offbench train bdb --dataset {dataset_id}")

    parser.set_defaults(run=run)


def _behaviour(parser: Parser, _: list[str]) -> None:
    parser.add_argument("env", metavar="ENV", help="a shipped recipe or a recipe file")
    parser.add_argument("--seed", type=natural, default=0, help="of the training (default: 0)")
    parser.add_argument("--steps", type=whole, help="environment steps (default: the recipe's)")
    parser.add_argument("--workers", type=whole, help="processes that measure rungs (default: one a core)")
    parser.add_argument("--out", metavar="DIR", help="where the ladder goes (default: in the training's folder)")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.agents import behaviour

        ladder = behaviour(**arguments)
        print(f"ladder in {ladder.folder}: random {ladder.random_return:.1f}, expert {ladder.expert_return:.1f}")
        for rung in ladder.rungs:
            print(
                f"  step {rung.step:>9,}  return {rung.ret:>8.1f}  fraction {ladder.fraction(rung):.2f}  {rung.role}"
            )

    parser.set_defaults(run=run)


def _behaviour_dir(parser: Parser) -> None:
    parser.add_argument("--behaviour-dir", default="behaviour", metavar="DIR", help="trainings (default: behaviour)")


def _train(parser: Parser, words: list[str]) -> None:
    from offbench.registry import algorithm_names, load_algorithm
    from offbench.settings import fields

    parser.add_argument("algorithm", metavar="ALGO", help=f"one of {', '.join(algorithm_names())}")
    parser.add_argument("--dataset", required=True, nargs="+", metavar="ID", help="local Minari datasets")
    parser.add_argument("--seeds", type=seed_list, default=[0], metavar="LIST", help="3, 0,1,2 or 0:5 (default: 0)")
    parser.add_argument("--steps", type=whole, default=1_000_000, help="updates (default: 1,000,000)")
    parser.add_argument("--eval-every", type=whole, default=5_000, help="updates between evaluations (default: 5,000)")
    parser.add_argument("--eval-episodes", type=whole, default=10, help="episodes of an evaluation (default: 10)")
    _machine(parser)
    parser.add_argument("--tensorboard", action="store_true", help="write event files beside each run")
    parser.add_argument("--wandb", metavar="PROJECT", help="show the runs in a Weights & Biases project")
    pairs = zip(["", *words], words, strict=False)
    positions = [word for before, word in pairs if not before.startswith("--") or before in SWITCHES]
    algorithm = next((word for word in positions if not word.startswith("-")), None)
    if algorithm is None:
        parser.epilog = "`offbench train ALGO --help` shows the algorithm's own settings."
        return
    group = parser.add_argument_group(f"settings of {algorithm}")
    known = fields(load_algorithm(algorithm).Config)
    for name, field in known.items():
        several = bool(field.metadata.get("per_run"))
        group.add_argument(
            f"--{name.replace('_', '-')}",
            dest=f"setting_{name}",
            nargs="+" if several else None,
            metavar="X",
            default=argparse.SUPPRESS,
            help=f"{field.metadata.get('help', '')} (default: {_default(field.default)})".replace("%", "%%"),
        )

    def run(**arguments: Any) -> None:
        from offbench.launch import train

        settings = {key.removeprefix("setting_"): v for key, v in arguments.items() if key.startswith("setting_")}
        rest = {key: value for key, value in arguments.items() if not key.startswith("setting_")}
        folders = train(**rest, **settings, command=shlex.join(["offbench", "train", *words]))
        for folder in folders:
            print(folder)
        print(f"next: offbench normalize --runs {rest['runs']}")

    parser.set_defaults(run=run)


def _machine(parser: Parser) -> None:
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto)")
    parser.add_argument("--workers", type=whole, help="processes for training and evaluation (default: one a core)")
    parser.add_argument("--stack", type=auto, default="auto", help="most runs that train as one program (auto or N)")
    parser.add_argument("--tf32", action="store_true", help="on a GPU: faster, less precise matrix products")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")


def _benchmark(parser: Parser, words: list[str]) -> None:
    from offbench.grid import shipped_grids

    parser.add_argument("grid", metavar="GRID", help=f"{', '.join(shipped_grids())}, or a grid file")
    parser.add_argument("--plan", action="store_true", help="print runs, cost and disk, and do nothing")
    parser.add_argument("--budget", metavar="TIME", help="stop cleanly after 90s, 9m or 2h; the same command goes on")
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
        from offbench import benchmark, tables

        if plan:
            print("\n".join(benchmark.plan(benchmark.prepare(**arguments))))
            return
        command = shlex.join(["offbench", "benchmark", *words])
        where = None
        if executor == "ray":
            from offbench.cluster import RayExecutor

            where = RayExecutor(address)
            arguments["workers"] = arguments["workers"] or where.cpus
        finished = benchmark.benchmark(**arguments, budget=budget, shard=shard, executor=where, command=command)
        if any(Path(arguments["runs"]).rglob("evaluations.csv")):  # a small budget ends before there are any
            print(tables.render(tables.score_runs(arguments["runs"])))
        if not finished:
            print("stopped at the budget; the same command goes on", file=sys.stderr)

    parser.set_defaults(run=run)


def _default(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _evaluate(parser: Parser, _: list[str]) -> None:
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run directory or a policy file")
    parser.add_argument("--env", help="a recipe, instead of the environment the policy names")
    parser.add_argument("--episodes", type=whole, default=10, help="default: 10")
    parser.add_argument("--seed", type=natural, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the mode")
    parser.add_argument("--similarity", action="store_true", help="a run's similar score on its dataset, no episodes")
    parser.add_argument("--tolerance", type=number, default=0.05, help="of the similar score, share of |Q|")
    parser.add_argument("--action-tolerance", type=number, default=0.1, help="of its second reading")
    parser.add_argument("--workers", type=whole, help="processes (default: one a core)")

    def run(similarity: bool, tolerance: float, action_tolerance: float, **arguments: Any) -> None:
        from offbench import assess

        if not similarity:
            print("\n".join(assess.evaluate(**arguments).lines()))
            return
        found = assess.similarity(
            arguments["path"], tolerance=tolerance, action_tolerance=action_tolerance, seed=arguments["seed"]
        )
        print(f"{arguments['path']}: similar score at step {found['step']:,} over {found['samples']:,} transitions")
        print(f"by Q       {found['q_similar']:.2f}%  (within {100 * tolerance:g}% of |Q1(s, a)|)")
        print(f"by action  {found['action_similar']:.2f}%  (root mean square distance at most {action_tolerance:g})")

    parser.set_defaults(run=run)


def _normalize(parser: Parser, _: list[str]) -> None:
    from offbench.tables import FORMATS

    parser.add_argument("returns", nargs="*", type=number, metavar="RETURN", help="returns to score, with --env")
    parser.add_argument("--env", help="the environment of the returns: a recipe")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--format", choices=FORMATS, default="table", dest="style", help="default: table")
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the learning curves (.png, .svg, .pdf)")

    def run(style: str, plot: str | None, **arguments: Any) -> None:
        from offbench.tables import normalize_runs_or_returns, render

        print(render(normalize_runs_or_returns(**arguments), style))
        if plot:
            from offbench.plots import plot_curves

            print(f"curves in {plot_curves(arguments['runs'], plot)}", file=sys.stderr)

    parser.set_defaults(run=run)


def _report(parser: Parser, _: list[str]) -> None:
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--out", default="report", metavar="DIR", help="where the report goes (default: report)")

    def run(**arguments: Any) -> None:
        from offbench.reports import report

        print(f"report in {report(**arguments)}")

    parser.set_defaults(run=run)


def _compare(parser: Parser, _: list[str]) -> None:
    parser.add_argument("a", metavar="A", help="a group of runs: ALGO or ALGO/VARIANT, e.g. td3_bc")
    parser.add_argument("b", metavar="B", help="the other one, e.g. bdb/beta=0.5")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(json: bool, **arguments: Any) -> None:
        from offbench.comparison import compare

        found = compare(**arguments)
        print(dumps(found.row(), indent=1) if json else "\n".join(found.lines()))

    parser.set_defaults(run=run)


def _list(parser: Parser, _: list[str]) -> None:
    def run() -> None:
        from offbench.describe import inventory_lines

        print("\n".join(inventory_lines()))

    parser.set_defaults(run=run)


def _show(parser: Parser, _: list[str]) -> None:
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset")
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the histogram of returns (.png, .svg, .pdf)")

    def run(dataset_id: str, plot: str | None) -> None:
        from offbench.describe import show

        summary = show(dataset_id)
        print("\n".join(summary.lines()))
        if plot:
            print(f"histogram in {summary.plot(plot)}", file=sys.stderr)

    parser.set_defaults(run=run)


def _card(parser: Parser, _: list[str]) -> None:
    parser.add_argument("env", metavar="ENV", help="a recipe with a ladder in the folder `behaviour` beside it")
    parser.add_argument("--out", metavar="DIR", help="where the card goes (default: <env>-card)")

    def run(**arguments: Any) -> None:
        from offbench.card import card

        print(f"card in {card(**arguments)}")

    parser.set_defaults(run=run)


ADD: dict[str, Callable[[Parser, list[str]], None]] = {
    "collect": _collect,
    "train": _train,
    "benchmark": _benchmark,
    "normalize": _normalize,
    "report": _report,
    "compare": _compare,
    "evaluate": _evaluate,
    "behaviour": _behaviour,
    "list": _list,
    "show": _show,
    "verify": travel.verify_arguments,
    "import-d4rl": travel.import_arguments,
    "export": travel.export_arguments,
    "export-policy": travel.export_policy_arguments,
    "card": _card,
    "video": aids.video_arguments,
    "doctor": aids.doctor_arguments,
    "completion": aids.completion_arguments,
}
