"""Every option of every command reaches the Python function that the command calls."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.cli.arguments import auto, non_negative_int, number, positive_int, seed_list, shard
from offbench.cli.main import BY_NAME, _parser, main
from offbench.envs.trust import is_trusting
from tests.made_runs import made_run

# (the text of an option, its value) by the option's type; options without a type take any text
VALUES: dict[Any, tuple[str, object]] = {
    positive_int: ("7", 7),
    non_negative_int: ("8", 8),
    auto: ("9", 9),
    number: ("0.7", 0.7),
    seed_list: ("3,5", [3, 5]),
    shard: ("1/4", (1, 4)),
}
# command lines for the options that have no effect in the first example of their command
WITH_SIMILARITY = "evaluate runs/a --similarity"
LINES = {
    **{("evaluate", name): WITH_SIMILARITY for name in ("algorithm", "tolerance", "action_tolerance", "similarity")},
    ("benchmark", "address"): "benchmark smoke --executor ray",
    ("list", "runs"): "list runs",
}
# options that choose another function
OTHER_FUNCTIONS = {
    ("evaluate", "similarity"): "similarity",
    ("card", "huggingface"): "huggingface_card",
    ("benchmark", "plan"): "write_plan",
}
# options of the output, which the command itself handles
OF_THE_OUTPUT = {
    *((command, "json") for command in ("list", "compare", "doctor")),
    ("verify", "as_json"),
    ("show", "plot"),
    ("normalize", "plot"),
    ("normalize", "style"),
}


class Calls(list[tuple[str, dict[Any, Any]]]):
    """The calls of the functions that are replaced: name and arguments, with whether files are trusted."""

    def stand_in(self, name: str, stop: bool = True) -> Callable[..., Any]:
        def function(*args: Any, **kwargs: Any) -> None:
            self.append((name, dict(enumerate(args)) | kwargs | {"trust": is_trusting()}))
            if stop:
                raise SystemExit

        return function


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    found = Calls()
    for name in offbench._MODULES:
        monkeypatch.setitem(vars(offbench), name, found.stand_in(name))
    monkeypatch.setattr("offbench.evaluation.similarity.similarity", found.stand_in("similarity"))
    monkeypatch.setattr("offbench.benchmarks.plan.write_plan", found.stand_in("write_plan"))
    monkeypatch.setattr("offbench.benchmarks.plan.prepare", found.stand_in("prepare", stop=False))

    class Ray(str):
        cpus = 3

    def ray_executor(address: str | None) -> Ray:
        found.append(("RayExecutor", {"address": address}))
        return Ray("ray")

    monkeypatch.setattr("offbench.benchmarks.ray_executor.RayExecutor", ray_executor)
    return found


def called(line: list[str], calls: Calls) -> tuple[str, dict[Any, Any]]:
    """Run a command; return the name of the last function called, and the arguments of all."""
    calls.clear()
    with pytest.raises(SystemExit):
        main(line)
    assert calls, line
    return calls[-1][0], {key: value for _, arguments in calls for key, value in arguments.items()}


def text_and_value(action: argparse.Action) -> tuple[list[str], object]:
    """Return what to type for an option, and the value that the function must get."""
    if action.nargs == 0:
        return [], True
    words = [str(choice) for choice in action.choices or ()]
    text, value = VALUES[action.type] if action.type else (words[-1] if words else f"a-{action.dest}",) * 2
    return [text], [value] if action.nargs == "+" else value


@pytest.mark.parametrize("command", BY_NAME)
def test_every_option_reaches_the_function(command: str, calls: Calls) -> None:
    example = shlex.split(BY_NAME[command].examples[0])
    if command == "train":
        example = shlex.split("train bdb_plus --dataset hopper-medium-v0")
    for action in _parser(example)._subparsers._group_actions[0].choices[command]._actions:  # type: ignore[index, union-attr]
        option = (command, action.dest)
        if not action.option_strings or action.dest == "help" or option in OF_THE_OUTPUT:
            continue
        line = shlex.split(LINES[option]) if option in LINES else example
        text, value = text_and_value(action)
        function, arguments = called([*line, action.option_strings[-1], *text], calls)
        if option in OTHER_FUNCTIONS:
            assert function == OTHER_FUNCTIONS[option]
            continue
        name = action.dest.removeprefix("setting_")
        if command == "card":  # it passes arguments by position
            name = {"out": 1}.get(name, name)
        assert arguments[name] == value, option
        assert called(line, calls)[1].get(name) != value, f"{option}: the test's value is the default"


def test_seeds_and_shards_reach_both_kinds_of_evaluation_and_plan(calls: Calls) -> None:
    assert called(["evaluate", "runs/a", "--similarity", "--seed", "8"], calls)[1]["seed"] == 8
    assert called(["benchmark", "smoke", "--plan", "--shard", "1/4"], calls)[1][1] == (1, 4)
    assert called(["card", "a-v0", "--huggingface", "--out", "a.md"], calls)[1] == {
        0: "a-v0",
        1: "a.md",
        "trust": False,
    }


def test_a_cluster_gets_as_many_workers_as_it_has_processors(calls: Calls) -> None:
    assert called(["benchmark", "smoke", "--executor", "ray"], calls)[1]["workers"] == 3
    assert called(["benchmark", "smoke", "--executor", "ray", "--workers", "2"], calls)[1]["workers"] == 2


@pytest.mark.parametrize("command", ["normalize", "show"])
def test_plot_writes_a_picture(command: str, medium: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in range(2):
        made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", seed, 50)
    main(
        ["normalize", "--plot", "picture.png"] if command == "normalize" else ["show", medium, "--plot", "picture.png"]
    )
    assert (home / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert "saved picture.png" in capsys.readouterr().err
