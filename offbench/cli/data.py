"""The commands for datasets. Parse, call, print."""

from __future__ import annotations

import argparse
import sys
from json import dumps
from typing import Any

import offbench
from offbench.cli.arguments import (
    Parser,
    add_trust_flag,
    complete_with,
    levels,
    local_datasets,
    non_negative_int,
    positive_int,
    recipes,
)
from offbench.common.terminal import hint, print_line, print_lines, print_table


def collect_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `collect`."""
    _env(parser, "a shipped environment (see `offbench list`) or a recipe file")
    level = parser.add_argument(
        "--level",
        help="a level, or a fraction of the expert's normalized return such as 0.6 (default: medium)",
    )
    complete_with(level, levels)
    parser.add_argument("--mix", metavar="LEVEL:SHARE,...", help="a mix of levels, e.g. random:0.5,expert:0.5")
    parser.add_argument(
        "--policy",
        metavar="POLICY",
        help="record this policy instead of a level: agent.zip (SB3), a run, a policy file, or module:function",
    )
    parser.add_argument("--name", help="with --policy: level name in the dataset id (default: the policy's name)")
    parser.add_argument("--steps", type=positive_int, help="transitions (default: the whole level, usually 1,000,000)")
    parser.add_argument("--seed", type=non_negative_int, default=0, help="seed of the episodes (default: 0)")
    parser.add_argument("--workers", type=positive_int, help="recording processes (default: one per core)")
    parser.add_argument(
        "--id", dest="dataset_id", metavar="ID", help="the dataset's id (default: <env>-<level>-v<version>)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset with the same id")
    parser.add_argument(
        "--retrain", action="store_true", help="train a behaviour agent instead of using the shipped one"
    )
    parser.add_argument(
        "--accept", action="store_true", help="record the nearest policy, however far it is from the level"
    )
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.envs.environments import parse_spec
        from offbench.envs.recipes import load_recipe
        from offbench.envs.trust import needs_trust

        dataset_id = offbench.collect(**arguments)
        print(dataset_id)
        spec = parse_spec(load_recipe(arguments["env"]).env_spec())
        trust = ["--trust"] if needs_trust(spec) else []
        hint("offbench", "train", "td3_bc", "--dataset", dataset_id, *trust)

    parser.set_defaults(run=run)


def behaviour_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `behaviour`."""
    _env(parser, "a shipped environment or a recipe file")
    parser.add_argument("--seed", type=non_negative_int, default=0, help="seed of the training (default: 0)")
    parser.add_argument("--steps", type=positive_int, help="environment steps (default: the recipe's)")
    parser.add_argument("--workers", type=positive_int, help="processes that evaluate rungs (default: one per core)")
    parser.add_argument("--out", metavar="DIR", help="folder of the ladder (default: below --behaviour-dir)")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.data.other_references import warn_other_references
        from offbench.envs.recipes import load_recipe

        ladder = offbench.behaviour(**arguments)
        warn_other_references(load_recipe(arguments["env"]), ladder)
        print(f"ladder in {ladder.folder}: random {ladder.random_return:.1f}, expert {ladder.expert_return:.1f}")
        rows = [
            [rung.role, f"{rung.step:,}", f"{rung.ret:.1f}", f"{ladder.fraction(rung):.2f}"] for rung in ladder.rungs
        ]
        print_table(["rung", "step", "return", "fraction"], rows)

    parser.set_defaults(run=run)


def _env(parser: Parser, text: str) -> None:
    complete_with(parser.add_argument("env", metavar="ENV", help=text), recipes)


def _dataset(parser: Parser) -> None:
    complete_with(parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset"), local_datasets)


def _behaviour_dir(parser: Parser) -> None:
    parser.add_argument(
        "--behaviour-dir",
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="folder of behaviour agents (default: behaviour)",
    )


def list_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `list`."""
    what = ("environments", "levels", "algorithms", "datasets", "runs")
    parser.add_argument("what", nargs="?", choices=what, metavar="WHAT", help=f"only these: {', '.join(what)}")
    parser.add_argument("--runs", metavar="DIR", help="with `list runs`: their folder (default: runs)")
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(what: str | None, runs: str | None, json: bool) -> None:
        from offbench.tools.inventory import sections

        if runs is not None and what != "runs":
            parser.error("--runs has an effect only in `offbench list runs`")
        contents = offbench.inventory(what, runs=runs)
        if json:
            print(dumps(contents, indent=1))
            return
        for i, (title, header, rows) in enumerate(sections(contents)):
            print_line(f"\n{title}" if i else title, "bold")
            if header:
                print_table(header, rows, names=2 if title in ("environments", "runs") else 1, group=title == "runs")
            else:
                print("\n".join(f"  {row[0]}" for row in rows))

    parser.set_defaults(run=run)


def show_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `show`."""
    _dataset(parser)
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the histogram of returns (.png, .svg, .pdf)")

    def run(dataset_id: str, plot: str | None) -> None:
        summary = offbench.show(dataset_id)
        picture = summary.plot(plot) if plot else None
        print_lines(summary.lines())
        if picture:
            print(f"saved {picture}", file=sys.stderr)

    parser.set_defaults(run=run)


def card_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `card`."""
    about = parser.add_argument(
        "about",
        metavar="ENV_OR_ID",
        help="a shipped environment or a recipe file whose five levels are recorded; with --huggingface a dataset",
    )
    complete_with(about, lambda: [*recipes(), *local_datasets()])
    parser.add_argument(
        "--huggingface", action="store_true", help="write a dataset's card for the Hugging Face Hub instead"
    )
    parser.add_argument(
        "--out",
        metavar="PATH",
        help="folder of the card (default: <env>-card); with --huggingface its file (default: in the dataset)",
    )
    _behaviour_dir(parser)

    def run(about: str, huggingface: bool, out: str | None, **agents: str) -> None:
        if huggingface:
            if agents:
                parser.error("--behaviour-dir has no effect with --huggingface")
            print(f"saved {offbench.huggingface_card(about, out)}")
        elif about in local_datasets():
            parser.error(f"{about} is a dataset: give --huggingface, or an environment")
        else:
            print(f"saved {offbench.card(about, out, **agents)}")

    parser.set_defaults(run=run)


def verify_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `verify`."""
    _dataset(parser)
    parser.add_argument(
        "--episodes", type=non_negative_int, help="episodes to replay in the simulator (default: 300; 0: none)"
    )
    parser.add_argument("--workers", type=positive_int, help="processes (default: one per core)")
    parser.add_argument("--json", action="store_true", dest="as_json", help="print JSON")
    add_trust_flag(parser)

    def run(as_json: bool, **arguments: Any) -> int:
        report = offbench.verify(**arguments)
        if as_json:
            print(report.to_json())
        else:
            print_lines(report.lines())
        return 0 if report.ok else 1

    parser.set_defaults(run=run)


def import_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `import-d4rl`."""
    parser.add_argument("file", metavar="FILE.hdf5", help="a D4RL file, or a file that `offbench export` wrote")
    parser.add_argument(
        "--id", dest="dataset_id", required=True, metavar="ID", help="the Minari id, e.g. d4rl-hopper-medium-v2"
    )
    env = parser.add_argument(
        "--env", metavar="RECIPE", help="environment of the file, also for evaluation (default: by the file's name)"
    )
    complete_with(env, recipes)
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset with the same id")

    def run(**arguments: Any) -> None:
        dataset_id = offbench.import_d4rl(**arguments)
        print(dataset_id)
        hint("offbench", "show", dataset_id)

    parser.set_defaults(run=run)


def export_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `export`."""
    _dataset(parser)
    parser.add_argument(
        "--out", required=True, metavar="FILE", help="the file to write: .hdf5 (D4RL) or .npz (arrays)"
    )
    parser.add_argument(
        "--drop-timeouts",
        action="store_true",
        help=".npz only: drop the steps at timeouts, as D4RL's qlearning_dataset does",
    )

    parser.set_defaults(run=lambda **options: print(f"saved {offbench.export(**options)}"))
