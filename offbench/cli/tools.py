"""The commands that help with a machine: `video`, `doctor` and `completion`. Parse, call, print."""

from __future__ import annotations

import sys
from json import dumps
from typing import Any

from offbench.cli.arguments import Parser, natural, number, trust, whole


def video_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `video`."""
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run, a policy file, or ENV:LEVEL (hopper:medium)")
    parser.add_argument("--out", default="video.gif", metavar="FILE", help=".gif or .mp4 (default: video.gif)")
    parser.add_argument("--env", help="a recipe, instead of the environment the policy names")
    parser.add_argument("--episodes", type=whole, default=1, help="default: 1")
    parser.add_argument("--seconds", type=number, help="length of the film at most (default: whole episodes)")
    parser.add_argument("--seed", type=natural, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--fps", type=whole, default=25, help="frames a second (default: 25)")
    parser.add_argument("--size", type=whole, default=480, help="longer side in pixels (default: 480)")
    trust(parser)

    def run(**arguments: Any) -> None:
        from offbench.evaluation.video import video

        print(f"film in {video(**arguments)}")

    parser.set_defaults(run=run)


def doctor_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `doctor`."""
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(json: bool) -> None:
        from offbench.tools.doctor import BROKEN, as_json, doctor

        found = doctor()
        print(dumps(as_json(found), indent=1) if json else "\n".join(map(str, found)))
        sys.exit(any(finding.state == BROKEN for finding in found))

    parser.set_defaults(run=run)


def export_policy_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `export-policy`."""
    parser.add_argument("path", metavar="RUN_OR_POLICY", help="a run directory or a policy file")
    parser.add_argument("--out", required=True, metavar="FILE.pt", help="the file to write")

    def run(**arguments: Any) -> None:
        from offbench.evaluation.export_policy import export_policy

        print(f"written to {export_policy(**arguments)}")

    parser.set_defaults(run=run)
