"""The command line of data that travels and are checked: verify, import-d4rl, export, export-policy."""

from __future__ import annotations

import sys
from typing import Any

from offbench.cli.arguments import Parser, natural, trust, whole


def verify_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `verify`."""
    parser.add_argument("dataset_id", metavar="ID", help="a local Minari dataset, anybody's")
    parser.add_argument("--episodes", type=natural, help="to play again (default: 300; 0: none)")
    parser.add_argument("--workers", type=whole, help="processes (default: one a core)")
    parser.add_argument("--json", action="store_true", dest="as_json", help="print the report as JSON")
    trust(parser)

    def run(as_json: bool, **arguments: Any) -> None:
        from offbench.verification import verify

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
        from offbench.d4rl import import_d4rl

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
        from offbench.exports import export

        print(f"written to {export(**arguments)}")

    parser.set_defaults(run=run)


def export_policy_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `export-policy`."""
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run directory or a policy file")
    parser.add_argument("--out", required=True, metavar="FILE.pt", help="the file to write")

    def run(**arguments: Any) -> None:
        from offbench.deploy import export_policy

        print(f"written to {export_policy(**arguments)}")

    parser.set_defaults(run=run)
