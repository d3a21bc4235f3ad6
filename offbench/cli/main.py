"""The command line: parse, call, print. Everything it does is a function of the package."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn, TextIO

from offbench.cli import data, results, tools, training
from offbench.cli.arguments import Parser
from offbench.common.errors import unknown
from offbench.common.text import printable
from offbench.training.registry import failure


def completion_arguments(parser: Parser, _: list[str]) -> None:
    """Add the arguments of `completion`."""
    from offbench.cli.completion import SHELLS, script

    parser.add_argument("shell", choices=SHELLS)

    def run(shell: str) -> None:
        def fill(words: list[str]) -> Parser:
            sub = Parser(prog="offbench")
            COMMANDS[words[0]][1](sub, words[1:])
            return sub

        print(script(shell, {command: help_ for command, (help_, _) in COMMANDS.items()}, fill))

    parser.set_defaults(run=run)


# What each does, and what adds its arguments.
COMMANDS: dict[str, tuple[str, Callable[[Parser, list[str]], None]]] = {
    "collect": (
        "record a dataset: random, medium, medium-replay, medium-expert, expert, or a fraction",
        data.collect_arguments,
    ),
    "train": ("train an algorithm on a dataset, with evaluations as it goes", training.train_arguments),
    "benchmark": ("a whole grid: datasets x algorithms x settings x seeds, resumable", training.benchmark_arguments),
    "normalize": ("the score table of all runs, or the scores of given returns", results.normalize_arguments),
    "report": ("all runs as one page, with tables and figures as files", results.report_arguments),
    "compare": ("two methods over the datasets and seeds that both have, with a verdict", results.compare_arguments),
    "evaluate": ("play a run's policy, or a policy file", results.evaluate_arguments),
    "behaviour": ("train an environment's behaviour agent (SAC) and build its ladder", data.behaviour_arguments),
    "list": ("environments, levels, algorithms and local datasets", data.list_arguments),
    "show": ("what is in a dataset", data.show_arguments),
    "verify": (
        "check a dataset: its arrays, its metadata, and a sample of episodes played again",
        data.verify_arguments,
    ),
    "import-d4rl": ("turn a D4RL file (v0, v1, v2) into a Minari dataset", data.import_arguments),
    "export": ("write a dataset as a D4RL file, or as arrays (npz)", data.export_arguments),
    "export-policy": ("write a run's policy as TorchScript", tools.export_policy_arguments),
    "card": ("write an environment's dataset card from its five recorded levels", data.card_arguments),
    "video": ("film a run's policy, a policy file, or a level such as hopper:medium", tools.video_arguments),
    "doctor": (
        "what a bug report needs: versions, physics, machine, paths; exit code 1 if something is broken",
        tools.doctor_arguments,
    ),
    "completion": ("print a shell's completion of these commands", completion_arguments),
}


RESUMED = ("collect", "train", "benchmark", "behaviour")  # that keep checkpoints


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command.

    Exits with 0, 1 if `verify` or `doctor` found something, 2 for a problem the user can mend, 130 after Ctrl-C, 143
    after SIGTERM.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with _terminable(), _printable_output():
            _run(words)
    except KeyboardInterrupt as stop:
        goes_on = "; the same command goes on from the last checkpoint, or begins again if there is none yet"
        print(f"\noffbench: stopped{goes_on if _command(words) in RESUMED else ''}", file=sys.stderr)
        sys.exit(143 if isinstance(stop, Terminated) else 130)
    except BrokenPipeError:  # the reader of a pipe (`| head`) has left
        _discard_output()
        sys.stderr.close()
        sys.exit(0)
    except Exception as error:
        _discard_output()
        print(f"offbench: {printable(' '.join(failure(error).split()))}", file=sys.stderr)
        sys.exit(2)


class _Printable:
    """A text stream that shows text of files as it is, and never obeys it or chokes on it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        encoding = self._stream.encoding or "utf-8"
        return self._stream.write(printable(text).encode(encoding, "backslashreplace").decode(encoding))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def _printable_output() -> Iterator[None]:
    """Print to stdout through `_Printable`, and to the end: a full disk is met here, not when Python exits."""
    if sys.stdout is None:  # closed by the shell
        yield
        return
    with contextlib.redirect_stdout(_Printable(sys.stdout)):
        try:
            yield
        finally:
            sys.stdout.flush()


def _discard_output() -> None:
    """Drop what stdout could not write, or Python would try again at its exit."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(KeyboardInterrupt):
    """SIGTERM came: from Slurm at its time limit, from a container that is stopped."""


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does: with what it has started ended too, and a line that says so."""

    def stop(*_: object) -> NoReturn:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # only the main thread may
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(words: list[str]) -> None:
    parser = Parser(prog="offbench", description="Offline-RL datasets and benchmarks.")
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    name = _command(words)
    if name is not None and name not in COMMANDS:
        raise unknown("command", name, COMMANDS)
    for command, (help_, add_arguments) in COMMANDS.items():
        sub = commands.add_parser(command, help=help_, description=help_[0].upper() + help_[1:] + ".")
        if command == name:  # only the command that runs pays for its arguments
            add_arguments(sub, words[words.index(name) + 1 :])
    arguments = vars(parser.parse_args(words))
    if arguments.pop("command") is None:
        parser.print_help()
        return
    run: Callable[..., None] = arguments.pop("run")
    if arguments.pop("trust", False):
        from offbench.envs.trust import trusting

        run = trusting()(run)
    run(**arguments)


def _command(words: list[str]) -> str | None:
    return next((word for word in words if not word.startswith("-")), None)


def _version() -> str:
    from importlib.metadata import version

    return f"offbench {version('offbench')}"
