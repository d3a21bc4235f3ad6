"""The commands for results: scores, report, comparison, policies. Parse, call, print."""

from __future__ import annotations

import sys
from json import dumps
from typing import Any

import offbench
from offbench.cli.arguments import (
    Parser,
    add_trust_flag,
    complete_with,
    local_datasets,
    methods,
    non_negative_int,
    number,
    positive_int,
    recipes,
)
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject
from offbench.common.terminal import is_terminal, note, print_line, print_lines, print_table
from offbench.common.text import counted

EPISODE_OPTIONS = {"env", "episodes", "stochastic", "workers"}  # options of `evaluate` without --similarity
SIMILARITY_OPTIONS = {"algorithm", "tolerance", "action_tolerance"}  # options of `evaluate` with --similarity
RUNS_HELP = "folder of the runs (default: runs)"
STEPS_HELP = "score the runs as they were after N updates (default: at their last evaluations)"


def normalize_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `normalize`."""
    from offbench.analysis.normalize import FORMATS

    parser.add_argument("returns", nargs="*", type=number, metavar="RETURN", help="returns to score, with --env")
    complete_with(
        parser.add_argument("--env", metavar="ENV", help="environment of the returns: a shipped one or a recipe file"),
        recipes,
    )
    parser.add_argument("--runs", metavar="DIR", help=RUNS_HELP)
    parser.add_argument("--steps", type=positive_int, metavar="N", help=STEPS_HELP)
    parser.add_argument(
        "--format",
        choices=FORMATS,
        default="table",
        dest="style",
        metavar="FORMAT",
        help=f"{', '.join(FORMATS)} (default: table)",
    )
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the learning curves (.png, .svg, .pdf)")

    def run(style: str, plot: str | None, **arguments: Any) -> None:
        from offbench.analysis.normalize import without_evaluation
        from offbench.common.plotting import picture_file

        if plot and arguments["env"]:
            raise OffbenchError("--plot has no effect with --env; leave it out")
        if plot:
            picture_file(plot)
        print_scores(offbench.normalize(**arguments), style)
        runs, steps = arguments["runs"] or "runs", arguments["steps"]
        waiting, diverged = (0, 0) if arguments["env"] else without_evaluation(runs, steps)
        if waiting:
            note(f"{counted(waiting, 'run')} without an evaluation {f'within {steps:,} updates' if steps else 'yet'}")
        if diverged:
            note(f"{counted(diverged, 'run')} diverged before the first evaluation")
        if plot:
            from offbench.reports.figures import plot_curves

            print(f"saved {plot_curves(runs, plot, steps)}", file=sys.stderr)

    parser.set_defaults(run=run)


def print_scores(rows: list[JsonObject], style: str = "table") -> None:
    """Print the rows of `normalize`."""
    from offbench.analysis.normalize import notes, render, score_table

    if style != "table":
        print(render(rows, style))
        return
    print_table(**score_table(rows, is_terminal(sys.stdout)))
    for line in notes(rows):
        print_line(f"note: {line}", "dim")


def report_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `report`."""
    parser.add_argument(
        "--runs", nargs="+", default=["runs"], metavar="DIR", help="folders of runs, shown together (default: runs)"
    )
    parser.add_argument("--out", default="report", metavar="DIR", help="folder of the report (default: report)")
    parser.add_argument("--steps", type=positive_int, metavar="N", help=STEPS_HELP)
    parser.add_argument("--title", help="title of the page (default: Offline RL benchmark)")
    datasets = parser.add_argument(
        "--datasets", nargs="+", metavar="ID", help="only these datasets: ids, or patterns such as 'hopper-*'"
    )
    complete_with(datasets, local_datasets)
    only = parser.add_argument("--methods", nargs="+", metavar="NAME", help="only these methods, as tables name them")
    complete_with(only, methods)

    parser.set_defaults(run=lambda **options: print(f"saved {offbench.report(**options)}"))


def compare_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `compare`."""
    complete_with(parser.add_argument("a", metavar="A", help="a method as tables name it, e.g. td3_bc"), methods)
    complete_with(
        parser.add_argument(
            "b", metavar="B", help="the method to compare with, e.g. 'bdb (beta=0.5)' or bdb/beta=0.5"
        ),
        methods,
    )
    parser.add_argument("--runs", default="runs", metavar="DIR", help=RUNS_HELP)
    parser.add_argument("--steps", type=positive_int, metavar="N", help=STEPS_HELP)
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(json: bool, **arguments: Any) -> None:
        comparison = offbench.compare(**arguments)
        if json:
            print(dumps(comparison.row(), indent=1))
        else:
            print_lines([comparison.title, ""])
            print_table(*comparison.table())
            print_lines(["", *comparison.conclusion()])

    parser.set_defaults(run=run)


def evaluate_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `evaluate`."""
    parser.add_argument("paths", nargs="+", metavar="RUN_OR_POLICY", help="run directories or policy files")
    complete_with(
        parser.add_argument("--env", help="shipped environment or recipe file to use instead of the policy's own"),
        recipes,
    )
    parser.add_argument("--episodes", type=positive_int, help="number of episodes (default: 10)")
    parser.add_argument(
        "--seed",
        type=non_negative_int,
        default=0,
        help="seed of the episodes, or of the similar score's sample (default: 0)",
    )
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the mode")
    parser.add_argument(
        "--similarity", action="store_true", help="compute the similar score of runs on their datasets instead"
    )
    parser.add_argument(
        "--algorithm", metavar="FILE", help="similar score: FILE.py:CLASS of an algorithm that is not installed"
    )
    parser.add_argument(
        "--tolerance",
        type=number,
        help="similar score: largest difference of Q, as a share of |Q1(s, a)| (default: 0.05)",
    )
    parser.add_argument(
        "--action-tolerance",
        type=number,
        help="similar score by action: largest root mean square distance (default: 0.1)",
    )
    parser.add_argument("--workers", type=positive_int, help="processes (default: one per core)")
    add_trust_flag(parser)

    def run(paths: list[str], similarity: bool, **arguments: Any) -> None:
        given = {name: value for name, value in arguments.items() if value is not None and value is not False}
        for name in sorted(given.keys() & (EPISODE_OPTIONS if similarity else SIMILARITY_OPTIONS)):
            which = "with" if similarity else "without"
            raise OffbenchError(f"--{name.replace('_', '-')} has no effect {which} --similarity; leave it out")
        if similarity:
            _print_similarity(paths, **given)
            return
        for path in paths:
            print_lines(offbench.evaluate(path, **given).lines())

    parser.set_defaults(run=run)


def _print_similarity(paths: list[str], **options: Any) -> None:
    """Print the similar score of each run; of several, those of algorithms without a critic are left out."""
    from offbench.evaluation.similarity import NoCriticError, similarity

    left_out = 0
    for path in paths:
        try:
            result = similarity(path, **options)
        except NoCriticError as error:
            left_out += 1
            if left_out == len(paths):
                raise
            note(f"left out: {error}")
            continue
        print(f"{path}: similar score at step {result.step:,} over {result.samples:,} transitions")
        print(f"by Q       {result.q_similar:.2f}%  (within {100 * result.tolerance:g}% of |Q1(s, a)|)")
        print(
            f"by action  {result.action_similar:.2f}%  (root mean square distance at most {result.action_tolerance:g})"
        )


def video_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `video`."""
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run, a policy file, or ENV:LEVEL (hopper:medium)")
    parser.add_argument("--out", default="video.gif", metavar="FILE", help=".gif or .mp4 (default: video.gif)")
    complete_with(
        parser.add_argument("--env", help="shipped environment or recipe file to use instead of the policy's own"),
        recipes,
    )
    parser.add_argument("--episodes", type=positive_int, default=1, help="number of episodes (default: 1)")
    parser.add_argument("--seconds", type=number, help="maximum duration (default: whole episodes)")
    parser.add_argument("--seed", type=non_negative_int, default=0, help="seed of the episodes (default: 0)")
    parser.add_argument("--fps", type=positive_int, default=25, help="frames per second (default: 25)")
    parser.add_argument("--size", type=positive_int, default=480, help="longer side in pixels (default: 480)")
    add_trust_flag(parser)

    parser.set_defaults(run=lambda **options: print(f"saved {offbench.video(**options)}"))


def export_policy_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `export-policy`."""
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run directory or a policy file")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write: .pt (TorchScript) or .onnx")

    parser.set_defaults(run=lambda **options: print(f"saved {offbench.export_policy(**options)}"))
