"""The commands for this machine: `doctor` and `completion`. Parse, call, print."""

from __future__ import annotations

from dataclasses import asdict
from json import dumps

import offbench
from offbench.cli.arguments import Parser
from offbench.common.terminal import print_table

SHELLS = ("bash", "zsh", "fish")


def doctor_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `doctor`."""
    parser.add_argument("--json", action="store_true", help="print JSON")

    def run(json: bool) -> int:
        from offbench.tools.doctor import BROKEN, OK

        findings = offbench.doctor()
        if json:
            print(dumps([asdict(finding) for finding in findings], indent=1))
        else:
            rows = [[finding.name, finding.state, finding.text] for finding in findings]
            not_ok = {(i, 1) for i, finding in enumerate(findings) if finding.state != OK}
            print_table(["check", "state", "details"], rows, names=3, marked=not_ok)
        return int(any(finding.state == BROKEN for finding in findings))

    parser.set_defaults(run=run)


def completion_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `completion`."""
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))

    def run(shell: str) -> None:
        from argcomplete.shell_integration import shellcode

        print(shellcode(["offbench"], shell=shell))

    parser.set_defaults(run=run)
