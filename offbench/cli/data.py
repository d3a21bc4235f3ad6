"""The command line of datasets and of what they are made with. Parse, call, print."""

from __future__ import annotations

import sys
from typing import Any

from offbench.cli.arguments import Parser, natural, whole


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
    _behaviour_dir(parser)

    def run(**arguments: Any) -> None:
        from offbench.record import collect

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


def list_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `list`."""

    def run() -> None:
        from offbench.describe import inventory_lines

        print("\n".join(inventory_lines()))

    parser.set_defaults(run=run)


def show_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `show`."""
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset")
    parser.add_argument("--plot", metavar="PICTURE", help="also draw the histogram of returns (.png, .svg, .pdf)")

    def run(dataset_id: str, plot: str | None) -> None:
        from offbench.describe import show

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
        from offbench.cards import card

        print(f"card in {card(**arguments)}")

    parser.set_defaults(run=run)
