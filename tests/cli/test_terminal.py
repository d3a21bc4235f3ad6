"""The command line on a terminal of each width, in a pipe, and without color."""

from __future__ import annotations

import errno
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Callable
from fcntl import ioctl
from pathlib import Path

import pytest

from offbench.cli.main import BY_NAME, COMMANDS, main
from tests.made_runs import made_grid, made_run

NORMALIZE = [sys.executable, "-m", "offbench", "normalize"]
IN_ASCII = os.environ | {"PYTHONIOENCODING": "ascii"}
COLOR = re.compile(r"\x1b\[[0-9;]*m")


@pytest.fixture
def screen(home: Path) -> Callable[..., str]:
    """Run a command in a terminal of some columns; return all that it writes."""

    def run(columns: int, *words: str, **environment: str) -> str:
        ours, theirs = pty.openpty()
        ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
        env = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES", "NO_COLOR")}
        command = [sys.executable, "-m", "offbench", *words]
        env |= {"TERM": "xterm-256color"} | environment
        process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, cwd=home, env=env)
        os.close(theirs)
        parts = []
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            parts.append(part)
        os.close(ours)
        assert process.wait() in (0, 2)
        return b"".join(parts).decode().replace("\r\n", "\n")

    return run


@pytest.mark.parametrize("columns", [60, 80])
def test_the_score_table_fits(screen: Callable[..., str], home: Path, columns: int) -> None:
    made_grid(home / "runs", envs=("halfcheetah",), seeds=2, levels=4)
    for seed in range(2):
        made_run(home / "runs", "halfcheetah-medium-v0", "bc", "default", seed, 20, reached=10_000)
    text = screen(columns, "normalize")
    assert COLOR.search(text)
    plain = COLOR.sub("", text)
    assert max(map(len, plain.splitlines())) <= columns
    for cell in ("halfcheetah-medium-expert-v0", "bdb (adaptive)", "30k", "10k of 30k", "score"):
        assert cell in plain
    assert ("evals" in plain) == (columns > 60)  # what gives way first


def test_the_table_of_a_comparison_fits(screen: Callable[..., str], home: Path) -> None:
    for variant in ("lagrange_target=10.0", "lagrange_target=5.0"):
        for seed in range(2):
            made_run(home / "runs", "halfcheetah-medium-expert-v0", "cql", variant, seed, 20)
    plain = COLOR.sub("", screen(80, "compare", "cql (lagrange_target=10.0)", "cql (lagrange_target=5.0)"))
    assert max(map(len, plain.splitlines())) <= 80
    assert re.search(
        r"^dataset +seed +cql +cql +difference\n +\(lagrange_target=10\.0\) +\(lagrange_target=5\.0\)$", plain, re.M
    )


def test_the_table_of_runs_fits(screen: Callable[..., str], home: Path) -> None:
    made_grid(home / "runs", envs=("halfcheetah",), seeds=2, levels=4)
    plain = COLOR.sub("", screen(80, "list", "runs"))
    assert max(map(len, plain.splitlines())) <= 80
    assert plain.count("halfcheetah-medium-expert-v0") == 1  # a heading above its runs
    assert plain.count("finished") == 4 * 6 * 2


@pytest.mark.parametrize("columns", [60, 80])
def test_a_message_breaks_between_words_and_not_within_a_command(screen: Callable[..., str], columns: int) -> None:
    words = ["normalize", "--runs", "a-folder-without-runs"]
    text = screen(columns, *words)
    assert "\x1b[1;31moffbench:\x1b[0m no evaluated runs" in text
    lines = COLOR.sub("", text).splitlines()
    assert max(map(len, lines)) <= columns
    command = "`offbench train ALGO --dataset ID`"
    assert any(command in line for line in lines)
    message = f"offbench: no evaluated runs below a-folder-without-runs (no such folder); start one with {command}"
    assert " ".join(lines) == message
    assert len(message) > columns


@pytest.mark.parametrize("columns", [60, 80])
def test_what_is_in_a_dataset_fits(
    screen: Callable[..., str], medium: str, columns: int, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["show", medium])  # it also converts the dataset
    plain = capsys.readouterr().out
    text = screen(columns, "show", medium)
    assert "\x1b[36mreturn          \x1b[0mmean" in text
    assert "\x1b[36m  policy_sha256 \x1b[0m" in text
    lines = COLOR.sub("", text).splitlines()
    assert max(map(len, lines)) <= columns
    assert "".join(plain.split()) == "".join("".join(lines).split())
    first = next(i for i, line in enumerate(lines) if line.startswith("versions"))
    assert lines[first + 1].startswith(16 * " ")  # below the text, not below the label


def test_the_name_of_a_method_is_no_label(screen: Callable[..., str], home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    made_run(home / "runs", "hopper-medium-v0", "bc", "default", 0, 40)
    assert "td3_bc against bc" in screen(80, "compare", "td3_bc", "bc")


def test_no_color_where_it_is_not_wanted(screen: Callable[..., str], home: Path) -> None:
    for words in (["--help"], ["list"], ["show", "nothing-v0"]):
        assert COLOR.search(screen(80, *words)), words
        assert not COLOR.search(screen(80, *words, NO_COLOR="1")), words


def test_a_pipe_gets_whole_lines(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made_grid(home / "runs", envs=("halfcheetah",), seeds=2, levels=4)
    main(["normalize"])
    lines = capsys.readouterr().out.splitlines()
    assert not COLOR.search("".join(lines))
    (line,) = [line for line in lines if line.startswith("halfcheetah-medium-expert-v0  cql")]
    assert re.search(r"  3,000  ", line)


def test_every_command_has_an_example_that_parses(capsys: pytest.CaptureFixture[str]) -> None:
    import shlex

    from offbench.cli.main import _parser

    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert [title for title in COMMANDS if f"\n{title}:\n" in text] == ["Data", "Train", "Results", "Tools"]
    for name, command in BY_NAME.items():
        assert f"\n  {name} " in text
        assert command.examples
        for example in command.examples:
            words = shlex.split(example.partition(" > ")[0])
            assert vars(_parser(words).parse_args(words))["command"] == name


@pytest.mark.parametrize("name", BY_NAME)
def test_the_help_of_a_command_fits(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([name, "--help"])
    usage, *lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf"usage: offbench {name} .*\[options\]", usage)
    assert max(map(len, lines)) <= 80


def test_only_headings_and_flags_of_the_help_have_color(screen: Callable[..., str]) -> None:
    for name in ("collect", "card"):  # a colon in the description, and a flag in the text of another one
        colored = re.findall(r"\x1b\[1;3[26]m(.+?)\x1b\[0m", screen(80, name, "--help"))
        assert {"usage:", "arguments:", "options:", "examples:", "-h, --help"} <= set(colored)
        assert len(colored) == len(set(colored))
        assert not any(":" in text[:-1] for text in colored)


def test_settings_are_grouped(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "bdb_plus", "--help"])
    text = capsys.readouterr().out
    method, optimization, ours = (
        text.index(title)
        for title in ("settings of bdb_plus:", "optimization of bdb_plus:", "extensions that are not in the paper:")
    )
    assert method < text.index("  --beta ") < optimization < text.index("  --tau ") < ours
    assert ours < text.index("  --beta-max ")


def test_collect_suggests_a_training(tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    recipe, behaviour_dir = tiny
    main(["collect", recipe, "--level", "random", "--steps", "20", "--behaviour-dir", behaviour_dir, "--workers", "1"])
    out, err = capsys.readouterr()
    assert out == "tiny-random-v0\n"
    assert err.splitlines()[-1] == "next: offbench train td3_bc --dataset tiny-random-v0"


def test_the_adaptive_beta_is_explained_and_the_next_command_can_be_pasted(
    medium: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--steps", "2", "--eval-every", "2", "--eval-episodes", "1", "--workers", "1", "--hidden", "8"]
    for algorithm, notes in (("bdb", 1), ("bdb (beta=0.5)", 0), ("td3_bc", 0)):
        main(["train", algorithm, "--dataset", medium, *words, "--runs", "my runs"])
        out, err = capsys.readouterr()
        assert err.count("note: the adaptive beta starts near 1") == notes
        assert err.splitlines()[-1] == "next: offbench normalize --runs 'my runs'"
        assert len(out.splitlines()) == 1
    assert "beta=0.5" in "".join(str(path) for path in Path("my runs").rglob("seed-0"))


@pytest.mark.parametrize("encoding", ["ascii", "koi8-r"])
def test_an_encoding_without_the_characters_of_a_table(screen: Callable[..., str], home: Path, encoding: str) -> None:
    for seed in range(2):
        made_run(home / "runs", "hopper-medium-v0", "bc", "default", seed, 40)
    assert re.search(r"\d \\xb1 \d", screen(80, "normalize", PYTHONIOENCODING=encoding))
    assert re.search(r"\d \\xb1 \d", subprocess.check_output(NORMALIZE, cwd=home, text=True, env=IN_ASCII))


def test_only_the_end_of_the_reader_ends_a_command_quietly(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made_run(home / "runs", "hopper-medium-v0", "bc", "default", 0, 40)
    with subprocess.Popen(NORMALIZE, cwd=home, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        process.stdout.close()
        assert process.stderr
        assert (process.stderr.read(), process.wait()) == ("", 0)

    def broken(**_: object) -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")  # of a worker process, for example

    monkeypatch.setattr("offbench.normalize", broken)
    with pytest.raises(SystemExit) as end:
        main(["normalize"])
    assert end.value.code == 2
    assert "Broken pipe" in capsys.readouterr().err


def test_a_users_code_that_exits_ends_no_command_quietly(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wherever it is called: environments, policies and algorithms that fail in known places are named."""
    monkeypatch.setattr("offbench.normalize", lambda **_: sys.exit(0))
    with pytest.raises(SystemExit) as end:
        main(["normalize"])
    assert end.value.code == 2
    assert "an environment, a policy or an algorithm called sys.exit(0)" in capsys.readouterr().err
