"""The command line: parse, call, print. Every command calls a function of the package."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn, TextIO

from offbench.cli import data, results, tools, training
from offbench.cli.arguments import Command, Parser
from offbench.common.errors import OffbenchError, unknown
from offbench.common.files import write_errors
from offbench.common.interrupts import stop_handlers
from offbench.common.terminal import labeled
from offbench.common.text import printable
from offbench.training.failures import describe_failure

COMMANDS: dict[str, dict[str, Command]] = {
    "Data": {
        "collect": Command(
            "record a dataset at a level: random, medium, expert, ...",
            data.collect_arguments,
            [
                "collect hopper --level medium",
                "collect hopper --mix random:0.5,expert:0.5 --steps 100000",
                "collect hopper --policy ppo.zip --name ppo --steps 100000",
            ],
        ),
        "list": Command(
            "list environments, levels, algorithms and datasets, or runs",
            data.list_arguments,
            ["list", "list runs", "list datasets --json"],
        ),
        "show": Command("print the contents of a dataset", data.show_arguments, ["show hopper-medium-v0"]),
        "verify": Command(
            "check a dataset's arrays and metadata, and replay episodes",
            data.verify_arguments,
            ["verify hopper-medium-v0"],
        ),
        "import-d4rl": Command(
            "convert a D4RL file (v0, v1, v2) to a Minari dataset",
            data.import_arguments,
            ["import-d4rl hopper_medium-v2.hdf5 --id d4rl-hopper-medium-v2"],
        ),
        "export": Command(
            "write a dataset as a D4RL file or as arrays (.npz)",
            data.export_arguments,
            ["export hopper-medium-v0 --out hopper-medium.hdf5"],
        ),
        "card": Command(
            "write an environment's dataset card, or a card for Hugging Face",
            data.card_arguments,
            ["card hopper", "card hopper-medium-v0 --huggingface"],
        ),
        "behaviour": Command(
            "train a behaviour agent (SAC) and build its ladder of policies",
            data.behaviour_arguments,
            ["behaviour hopper --steps 300000"],
        ),
    },
    "Train": {
        "train": Command(
            "train an algorithm on a dataset and evaluate it",
            training.train_arguments,
            [
                "train td3_bc --dataset hopper-medium-v0",
                "train bdb --dataset hopper-medium-v0 --seeds 0:5 --beta 0.5 adaptive",
            ],
        ),
        "benchmark": Command(
            "train a grid: datasets x algorithms x settings x seeds",
            training.benchmark_arguments,
            ["benchmark smoke", "benchmark paper-small --plan"],
        ),
    },
    "Results": {
        "normalize": Command(
            "print the score table of all runs, or score given returns",
            results.normalize_arguments,
            ["normalize", "normalize --env hopper 1234.5 987"],
        ),
        "report": Command(
            "write a page with tables and figures of all runs",
            results.report_arguments,
            ["report", "report --datasets 'hopper-*' --methods td3_bc 'bdb (adaptive)'"],
        ),
        "compare": Command(
            "compare two methods over the datasets and seeds of both",
            results.compare_arguments,
            ["compare td3_bc 'bdb (adaptive)'"],
        ),
        "evaluate": Command(
            "run episodes with a run's policy or a policy file",
            results.evaluate_arguments,
            ["evaluate runs/hopper-medium-v0/td3_bc/default/seed-0 --episodes 100"],
        ),
        "video": Command(
            "record a video of a run's policy, a policy file or a level",
            results.video_arguments,
            ["video hopper:medium --out hopper.gif"],
        ),
        "export-policy": Command(
            "write a policy for use without offbench",
            results.export_policy_arguments,
            [
                "export-policy runs/hopper-medium-v0/bc/default/seed-0 --out bc.pt",
                "export-policy agent.safetensors --out policy.onnx",
            ],
        ),
    },
    "Tools": {
        "doctor": Command(
            "check this machine; exit code 1 if something is broken", tools.doctor_arguments, ["doctor"]
        ),
        "completion": Command(
            "print the script for shell completion",
            tools.completion_arguments,
            ["completion bash > ~/.local/share/bash-completion/completions/offbench"],
        ),
    },
}
BY_NAME = {name: command for group in COMMANDS.values() for name, command in group.items()}


RESUMABLE = ("collect", "train", "benchmark", "behaviour")  # commands that keep checkpoints


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command.

    Exits with 0, 1 if `verify` or `doctor` found a problem, 2 for an error that the user can fix, 130 after Ctrl-C,
    143 after SIGTERM, 129 after SIGHUP.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if {"_ARGCOMPLETE", "COMP_LINE", "COMP_POINT"} <= os.environ.keys():  # a shell asks for completions
        _complete()
    _open_closed()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: terminals whose encoding lacks a ±
    os.environ["MPLBACKEND"] = "Agg"  # figures are files; matplotlib does not import with a name that it does not have
    try:
        with contextlib.redirect_stderr(_IgnoreWriteErrors(sys.stderr)):
            _main(words)
    finally:
        _drop_unwritten()


def _main(words: list[str]) -> None:
    try:
        with _stop_on_signals(), _printable_output():
            _run(words)
    except KeyboardInterrupt as stop:
        without = " without --fresh" if "--fresh" in words else ""
        resume = f"; rerun the same command{without} to resume from the last checkpoint, if there is one"
        print(file=sys.stderr)
        labeled("offbench", f"stopped{resume if _command(words) in RESUMABLE else ''}", "bold yellow")
        sys.exit(128 + (stop.number if isinstance(stop, Terminated) else signal.SIGINT))
    except _ReaderLeftError:
        sys.exit(0)
    except Exception as error:
        labeled("offbench", " ".join(describe_failure(error).split()), "bold red")
        sys.exit(2)


class _ReaderLeftError(BrokenPipeError):
    """The program that reads our output from a pipe (`| head`) has ended."""


class _Stream:
    """A text stream whose `write` a subclass replaces."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Printable(_Stream):
    """Escapes control characters, so that text from files cannot control the terminal."""

    @property
    def raw_stream(self) -> TextIO:
        """The stream itself, for text with colors of our own."""
        return self._stream

    def write(self, text: str) -> int:
        with _reader_left(), write_errors("the output"):
            return self._stream.write(printable(text))

    def flush(self) -> None:
        with _reader_left(), write_errors("the output"):
            self._stream.flush()


class _IgnoreWriteErrors(_Stream):
    """Ignores write errors: training continues if the disk of its log is full, or its terminal is closed."""

    def write(self, text: str) -> int:
        with _ignored_write_errors():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with _ignored_write_errors():
            self._stream.flush()


@contextlib.contextmanager
def _ignored_write_errors() -> Iterator[None]:
    try:
        with _reader_left():
            yield
    except _ReaderLeftError:
        raise
    except OSError:
        pass


@contextlib.contextmanager
def _reader_left() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError as error:
        raise _ReaderLeftError from error


@contextlib.contextmanager
def _printable_output() -> Iterator[None]:
    """Print to stdout through `_Printable`, and flush it: a full disk is an error here, not when Python exits."""
    with contextlib.redirect_stdout(_Printable(sys.stdout)):
        try:
            yield
        finally:
            sys.stdout.flush()


def _open_closed() -> None:
    """Open the standard streams that the shell has closed (`2>&-`), or other files and pipes get their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null == number:
                os.set_inheritable(null, True)
            else:
                os.dup2(null, number)
                os.close(null)
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="backslashreplace", closefd=False))


def _drop_unwritten() -> None:
    """Drop what stdout and stderr could not write, or Python would try again at its exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class Terminated(KeyboardInterrupt):
    """SIGTERM (Slurm's time limit, a stopped container) or SIGHUP (a closed terminal) came.

    Attributes:
        number: the signal's.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def _stop_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end a command as Ctrl-C does: its processes end too, and a line is printed."""

    def stop(number: int, _: object) -> NoReturn:
        if number != signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)  # a closed terminal may send SIGHUP twice
        raise Terminated(number)

    def resend(ignored: sys.UnraisableHookArgs) -> None:
        if isinstance(ignored.exc_value, KeyboardInterrupt):
            number = getattr(ignored.exc_value, "number", signal.SIGINT)
            threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
        else:
            hook(ignored)

    before = {number: handler for number, handler in stop_handlers().items() if number != signal.SIGINT}
    for number in before:
        signal.signal(number, stop)
    hook, sys.unraisablehook = sys.unraisablehook, resend  # a stop within `__del__` or a callback would be lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            if signal.getsignal(number) == stop:
                signal.signal(number, handler)


class _MainParser(Parser):
    """The parser of `offbench` itself: its help shows the commands in groups."""

    def format_help(self) -> str:
        """Return usage, commands and a way to begin."""
        lines = ["usage: offbench COMMAND ...", "", f"{self.description}"]
        for title, group in COMMANDS.items():
            lines += ["", f"{title}:", *(f"  {name:<15}{command.help}" for name, command in group.items())]
        lines += ["", "Quickstart:"]
        first = ("collect", "train", "normalize", "report")
        lines += [f"  offbench {BY_NAME[name].examples[0]}" for name in first]
        lines += [
            "",
            "`offbench COMMAND --help` shows the options of a command, with examples.",
            "`offbench --version` prints the version.",
        ]
        return "\n".join(lines) + "\n"


def _parser(words: list[str]) -> Parser:
    """Return the parser for a command line; only the command that runs gets its arguments, which take time to load."""
    parser = _MainParser(prog="offbench", description="Record offline-RL datasets and benchmark algorithms on them.")
    version = _version() if "--version" in words else ""  # it takes a while to read
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(prog="offbench", dest="command", metavar="COMMAND", parser_class=Parser)
    name = _command(words)
    for each, command in BY_NAME.items():
        description = command.help[0].upper() + command.help[1:].removesuffix(", ...") + "."
        sub = commands.add_parser(each, help=command.help, description=description, epilog=command.epilog())
        if each == name:
            command.add_arguments(sub, words[words.index(name) + 1 :])
    return parser


def _run(words: list[str]) -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise OffbenchError("the current folder was deleted; change to another one") from None
    name = _command(words)
    if name is not None and name not in BY_NAME:
        raise unknown("command", name, BY_NAME)
    parser = _parser(words)
    arguments = vars(parser.parse_args(words))
    if arguments.pop("command") is None:
        parser.print_help()
        return
    run: Callable[..., int | None] = arguments.pop("run")
    if arguments.pop("trust", False):
        from offbench.envs.trust import trusting

        run = trusting()(run)
    try:
        exit_code = run(**arguments)
    except SystemExit as error:
        raise OffbenchError(f"an environment, a policy or an algorithm called sys.exit({error.code!r})") from error
    if exit_code:
        sys.exit(exit_code)


def _complete() -> NoReturn:
    """Answer a shell that asks for completions."""
    from argcomplete import autocomplete
    from argcomplete.lexers import split_line

    line, point = os.environ["COMP_LINE"], int(os.environ["COMP_POINT"])
    _, _, _, words, _ = split_line(line, point)
    autocomplete(_parser(words[1:]))
    sys.exit(0)


def _command(words: list[str]) -> str | None:
    return next((word for word in words if not word.startswith("-")), None)


def _version() -> str:
    from importlib.metadata import version

    return f"offbench {version('offbench')}"
