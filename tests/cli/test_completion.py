"""`offbench completion SHELL`: the scripts are given to the shells themselves."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from offbench.cli.main import COMMANDS
from offbench.training.registry import algorithm_names

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def bash(offbench_cli: Cli, home: Path) -> Callable[..., list[str]]:
    """What bash offers after some words; the last one is not finished."""
    if not shutil.which("bash"):
        pytest.skip("no bash here")
    done = offbench_cli("completion", "bash")
    assert done.returncode == 0, done.stderr
    (home / "completion.bash").write_text(done.stdout)

    def offered(*words: str) -> list[str]:
        line = " ".join(f"'{word}'" for word in ("offbench", *words))
        code = f"set -u; . ./completion.bash; COMP_WORDS=({line}); COMP_CWORD={len(words)}; _offbench; "
        done = subprocess.run(
            ["bash", "-c", code + 'printf "%s\\n" "${COMPREPLY[@]+"${COMPREPLY[@]}"}"'],
            capture_output=True,
            text=True,
            cwd=home,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert not done.stderr
        return done.stdout.split()

    return offered


def test_bash_offers_every_command(bash: Callable[..., list[str]]) -> None:
    assert bash("") == list(COMMANDS)
    assert bash("coll") == ["collect"]


def test_bash_offers_what_a_place_and_a_flag_may_be(bash: Callable[..., list[str]]) -> None:
    assert bash("collect", "hop") == ["hopper"]
    assert bash("collect", "hopper", "--level", "medium-") == ["medium-replay", "medium-expert"]
    assert bash("train", "") == algorithm_names()
    assert bash("benchmark", "pap") == ["paper", "paper-small"]
    assert bash("normalize", "--format", "l") == ["latex"]
    assert bash("completion", "f") == ["fish"]


def test_bash_offers_flags_and_an_algorithms_own_settings(bash: Callable[..., list[str]]) -> None:
    assert bash("collect", "hopper", "--le") == ["--level"]
    assert "--beta" in bash("train", "bdb", "--b")
    assert "--beta" not in bash("train", "td3_bc", "--b")
    assert "--bc-steps" in bash("train", "cql", "--dataset", "x-v0", "--b")


def test_bash_offers_the_datasets_that_are_there_when_asked(bash: Callable[..., list[str]], home: Path) -> None:
    assert bash("train", "bdb", "--dataset", "") == []
    (home / "minari" / "my-data-v0").mkdir(parents=True)
    assert bash("train", "bdb", "--dataset", "my") == ["my-data-v0"]
    assert bash("show", "my") == ["my-data-v0"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_accept_their_script(shell: str, offbench_cli: Cli, home: Path) -> None:
    script = offbench_cli("completion", shell).stdout
    assert "medium-replay" in script
    if not shutil.which(shell):
        pytest.skip(f"no {shell} here: its script was not tried")
    (home / "script").write_text(script)
    done = subprocess.run([shell, "-n", "script"], capture_output=True, text=True, cwd=home, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    if shell == "fish":
        code = "source script; complete -C 'offbench collect hopper --level medium-'"
        done = subprocess.run([shell, "-c", code], capture_output=True, text=True, cwd=home, check=False)
        assert [line.split()[0] for line in done.stdout.splitlines()] == ["medium-expert", "medium-replay"]


def test_an_unknown_shell_is_refused_in_one_line(offbench_cli: Cli) -> None:
    done = offbench_cli("completion", "tcsh")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "bash" in done.stderr
