"""The command line of what comes out of runs: scores, report, comparison, evaluation. Parse, call, print."""

from __future__ import annotations

import sys
from json import dumps
from typing import Any

from offbench.cli.arguments import Parser, natural, number, trust, whole


def normalize_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `normalize`."""
    from offbench.analysis.normalize import FORMATS

    parser.add_argument("returns", nargs="*", type=number, metavar="RETURN", help="returns to score, with --env")
    parser.add_argument("--env", help="the environment of the returns: a recipe")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--format", choices=FORMATS, default="table", dest="style", help="default: table")
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the learning curves (.png, .svg, .pdf)")

    def run(style: str, plot: str | None, **arguments: Any) -> None:
        from offbench.analysis.normalize import count_waiting, normalize_runs_or_returns, render
        from offbench.common.text import counted

        rows = normalize_runs_or_returns(**arguments)
        print(render(rows, style))
        waiting = 0 if arguments["env"] else count_waiting(arguments["runs"])
        if waiting:
            verb = "has" if waiting == 1 else "have"
            print(f"{counted(waiting, 'run')} {verb} no evaluation yet", file=sys.stderr)
        if plot:
            from offbench.reports.curves import plot_curves

            print(f"curves in {plot_curves(arguments['runs'], plot)}", file=sys.stderr)

    parser.set_defaults(run=run)


def report_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `report`."""
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--out", default="report", metavar="DIR", help="where the report goes (default: report)")

    def run(**arguments: Any) -> None:
        from offbench.reports.report import report

        print(f"report in {report(**arguments)}")

    parser.set_defaults(run=run)


def compare_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `compare`."""
    parser.add_argument("a", metavar="A", help="a group of runs: ALGO or ALGO/VARIANT, e.g. td3_bc")
    parser.add_argument("b", metavar="B", help="the other one, e.g. bdb/beta=0.5")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="folder of the run directories (default: runs)")
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(json: bool, **arguments: Any) -> None:
        from offbench.analysis.compare import compare

        found = compare(**arguments)
        print(dumps(found.row(), indent=1) if json else "\n".join(found.lines()))

    parser.set_defaults(run=run)


def evaluate_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `evaluate`."""
    parser.add_argument("paths", nargs="+", metavar="RUN_OR_POLICY", help="run directories or policy files")
    parser.add_argument("--env", help="a recipe, instead of the environment the policy names")
    parser.add_argument("--episodes", type=whole, default=10, help="default: 10")
    parser.add_argument("--seed", type=natural, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the mode")
    parser.add_argument("--similarity", action="store_true", help="a run's similar score on its dataset, no episodes")
    parser.add_argument("--tolerance", type=number, default=0.05, help="of the similar score, share of |Q|")
    parser.add_argument("--action-tolerance", type=number, default=0.1, help="of its second reading")
    parser.add_argument("--workers", type=whole, help="processes (default: one a core)")
    trust(parser)

    def similar(path: str, tolerance: float, action_tolerance: float, seed: int) -> None:
        from offbench.evaluation.evaluate import similarity

        found = similarity(path, tolerance=tolerance, action_tolerance=action_tolerance, seed=seed)
        print(f"{path}: similar score at step {found['step']:,} over {found['samples']:,} transitions")
        print(f"by Q       {found['q_similar']:.2f}%  (within {100 * tolerance:g}% of |Q1(s, a)|)")
        print(f"by action  {found['action_similar']:.2f}%  (root mean square distance at most {action_tolerance:g})")

    def run(paths: list[str], similarity: bool, tolerance: float, action_tolerance: float, **arguments: Any) -> None:
        from offbench.evaluation.evaluate import evaluate

        for path in paths:
            if similarity:
                similar(path, tolerance, action_tolerance, arguments["seed"])
            else:
                print("\n".join(([path] if len(paths) > 1 else []) + evaluate(path, **arguments).lines()))

    parser.set_defaults(run=run)
