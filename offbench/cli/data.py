"""The command line of datasets and of what they are made with. Parse, call, print."""

from __future__ import annotations

import sys
from typing import Any

from offbench.cli.arguments import Parser, natural, trust, whole


def collect_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `collect`."""
    parser.add_argument("env", metavar="ENV", help="a shipped recipe (see `offbench list`) or a recipe file")
    parser.add_argument("--level", default="medium", help="a level or a fraction such as 0.6 (default: medium)")
    parser.add_argument("--mix", metavar="LEVEL:SHARE,...", help="a blend, e.g. random:0.5,expert:0.5")
    parser.add_argument("--steps", type=whole, help="transitions (default: the recipe's, 1,000,000)")
    parser.add_argument("--seed", type=natural, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--workers", type=whole, help="recording processes (default: one a core)")
    parser.add_argument("--id", dest="dataset_id", help="the dataset's id (default: <env>-<level>-v0)")
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset of that id")
    parser.add_argument("--retrain", action="store_true", help="use an agent trained here, not the shipped one")
    parser.add_argument("--accept", action="store_true", help="take the nearest policy, however far from the level")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.data.collect import collect

        dataset_id = collect(**arguments)
        print(f"{dataset_id} recorded; next: offbench train bdb --dataset {dataset_id}")

    parser.set_defaults(run=run)


def behaviour_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `behaviour`."""
    parser.add_argument("env", metavar="ENV", help="a shipped recipe or a recipe file")
    parser.add_argument("--seed", type=natural, default=0, help="of the training (default: 0)")
    parser.add_argument("--steps", type=whole, help="environment steps (default: the recipe's)")
    parser.add_argument("--workers", type=whole, help="processes that measure rungs (default: one a core)")
    parser.add_argument("--out", metavar="DIR", help="where the ladder goes (default: in the training's folder)")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.agents.behaviour import behaviour
        from offbench.data.references import warn_other_references
        from offbench.envs.recipes import load_recipe

        ladder = behaviour(**arguments)
        warn_other_references(load_recipe(arguments["env"]), ladder)
        print(f"ladder in {ladder.folder}: random {ladder.random_return:.1f}, expert {ladder.expert_return:.1f}")
        for rung in ladder.rungs:
            print(
                f"  step {rung.step:>9,}  return {rung.ret:>8.1f}  fraction {ladder.fraction(rung):.2f}  {rung.role}"
            )

    parser.set_defaults(run=run)


def _behaviour_dir(parser: Parser) -> None:
    parser.add_argument("--behaviour-dir", default="behaviour", metavar="DIR", help="trainings (default: behaviour)")


def list_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `list`."""

    def run() -> None:
        from offbench.tools.inventory import inventory_lines

        print("\n".join(inventory_lines()))

    parser.set_defaults(run=run)


def show_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `show`."""
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset")
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the histogram of returns (.png, .svg, .pdf)")

    def run(dataset_id: str, plot: str | None) -> None:
        from offbench.data.show import show

        summary = show(dataset_id)
        picture = summary.plot(plot) if plot else None
        print("\n".join(summary.lines()))
        if picture:
            print(f"histogram in {picture}", file=sys.stderr)

    parser.set_defaults(run=run)


def card_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `card`."""
    parser.add_argument("env", metavar="ENV", help="a shipped recipe or a recipe file, its five levels recorded")
    parser.add_argument("--out", metavar="DIR", help="where the card goes (default: <env>-card)")
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.data.card import card

        print(f"card in {card(**arguments)}")

    parser.set_defaults(run=run)


def verify_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `verify`."""
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset, anybody's")
    parser.add_argument("--episodes", type=natural, help="to play again (default: 300; 0: none)")
    parser.add_argument("--workers", type=whole, help="processes (default: one a core)")
    parser.add_argument("--json", action="store_true", dest="as_json", help="print the report as JSON")
    trust(parser)

    def run(as_json: bool, **arguments: Any) -> None:
        from offbench.verification.verify import verify

        report = verify(**arguments)
        print(report.to_json() if as_json else "\n".join(report.lines()))
        if not report.ok:
            sys.exit(1)

    parser.set_defaults(run=run)


def import_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `import-d4rl`."""
    parser.add_argument("file", metavar="FILE.hdf5", help="a D4RL file, or one that `offbench export` wrote")
    parser.add_argument("--id", dest="dataset_id", required=True, help="the Minari id, e.g. d4rl-hopper-medium-v2")
    parser.add_argument("--env", metavar="RECIPE", help="the environment to evaluate in (default: by the file's name)")
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset of that id")

    def run(**arguments: Any) -> None:
        from offbench.data.import_d4rl import import_d4rl

        print(f"{import_d4rl(**arguments)} imported; next: offbench show {arguments['dataset_id']}")

    parser.set_defaults(run=run)


def export_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `export`."""
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write: .hdf5 (D4RL) or .npz")
    parser.add_argument("--format", choices=("d4rl", "npz"), dest="style", help="default: as the file ends")
    parser.add_argument(
        "--drop-timeouts", action="store_true", help="npz: without the steps that D4RL's qlearning_dataset drops"
    )

    def run(**arguments: Any) -> None:
        from offbench.data.export import export

        print(f"written to {export(**arguments)}")

    parser.set_defaults(run=run)
