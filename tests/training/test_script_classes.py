"""Algorithms that are classes of a script or a notebook: an edit of what they use is noticed, other edits are not."""

from __future__ import annotations

import runpy
import sys
import types
from pathlib import Path

import pytest

import offbench
from offbench.common.code_hash import MAIN, describe_changes
from offbench.common.errors import OffbenchError
from offbench.training import registry
from offbench.training.source_code import code_of

SCRIPT = """
from offbench.algos.bc import BC
from offbench.training.source_code import code_of
from offbench.training.registry import register
import helper
from helper import halved

SCALE = 2.0
steps = 20

def doubled(value):
    return weighted(value) * SCALE

def weighted(value):
    return 3.0 * value

def unused():
    return 1

def shifted(function):
    def call(self, run):
        return function(self, run) + 7
    return call

class Mine(BC):
    limit = SCALE

    @shifted
    def policy(self, run):
        self.steps = 1
        return halved(doubled(super().policy(run)))

code = code_of(register(Mine))
"""
HELPER = "import parts\ndef halved(value):\n    return value * parts.HALF\n"


@pytest.fixture(autouse=True)
def _forget(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    """Forget the classes and modules of each test."""
    monkeypatch.setattr(registry, "_user_algorithms", {})
    monkeypatch.syspath_prepend(str(home))
    for name in ("helper", "parts"):
        monkeypatch.delitem(sys.modules, name, raising=False)


def of_script(home: Path, script: str, half: str = "HALF = 0.5\n") -> dict[str, str]:
    (home / "script.py").write_text(script)
    (home / "helper.py").write_text(HELPER)
    (home / "parts.py").write_text(half)
    registry._user_algorithms.clear()
    for name in ("helper", "parts"):
        sys.modules.pop(name, None)
    code: dict[str, str] = runpy.run_path("script.py", run_name="__main__")["code"]
    return code


@pytest.mark.parametrize(
    ("old", "new", "changed"),
    [
        ("SCALE = 2.0", "SCALE = 4.0", {"__main__: SCALE", "__main__: Mine.limit"}),
        ("3.0 * value", "5.0 * value", {"__main__: weighted"}),
        ("+ 7", "+ 8", {"__main__: shifted.<locals>.call"}),
        ("self.steps = 1", "self.steps = 2", {"Mine"}),
        ("steps = 20", "steps = 40", set()),
        ("return 1", "return 2", set()),
        ("def unused", "# a comment\ndef unused", set()),
    ],
)
def test_an_edit_of_what_a_scripts_class_uses_is_noticed(home: Path, old: str, new: str, changed: set[str]) -> None:
    before, now = of_script(home, SCRIPT), of_script(home, SCRIPT.replace(old, new))
    assert {"Mine", "bc.py", "__main__: doubled", "__main__: helper.py", "__main__: parts.py"} <= before.keys()
    assert {name for name in {**before, **now} if before.get(name) != now.get(name)} == changed


def test_an_edit_of_a_file_beside_a_script_is_noticed(home: Path) -> None:
    before, now = of_script(home, SCRIPT), of_script(home, SCRIPT, "HALF = 0.25\n")
    assert {name for name in before if before[name] != now[name]} == {"__main__: parts.py"}


CELL = """
import dataclasses
from offbench.algos.td3_bc import TD3BC, Config

WEIGHT = 1.0

def weighed(loss):
    return WEIGHT * loss

class Mine(TD3BC):
    def policy(self, run):
        weighed(1.0)
        return super().policy(run)
"""


def test_an_edited_cell_of_a_notebook_is_noticed(home: Path, medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The source of a cell is not in a file; what was trained with the cell before is not continued."""
    notebook = types.ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", notebook)

    def train(cell: str, steps: int = 20) -> None:
        exec(cell, vars(notebook))
        registry._user_algorithms.clear()
        small = {"hidden": (8,), "batch_size": 8, "eval_every": 10, "eval_episodes": 1, "workers": 1}
        offbench.train(vars(notebook)["Mine"], medium, steps=steps, **small)

    train(CELL)
    first = code_of("Mine")
    assert {"Mine", "td3_bc.py", "__main__: weighed", "__main__: WEIGHT"} <= first.keys()
    train(CELL.replace("WEIGHT = 1.0", "WEIGHT = 1.0  # a comment"), steps=30)
    for old, new, name in (
        ("WEIGHT = 1.0", "WEIGHT = 2.0", "__main__: WEIGHT"),
        ("WEIGHT * loss", "WEIGHT * loss * 2", "__main__: weighed"),
        ("weighed(1.0)", "weighed(2.0)", "Mine"),
    ):
        with pytest.raises(OffbenchError, match=f"trained by other code of Mine: {name} has changed"):
            train(CELL.replace(old, new), steps=30)
    train(CELL, steps=40)


def test_an_error_in_a_scripts_class_is_the_scripts(
    medium: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notebook = types.ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", notebook)
    exec(CELL.replace("weighed(1.0)", "{}['missing']"), vars(notebook))
    small = {"hidden": (8,), "batch_size": [8, 16], "steps": 10, "eval_every": 10, "eval_episodes": 1, "workers": 1}
    with pytest.raises(OffbenchError, match=r"an error in your script: KeyError: 'missing'.*see the traceback above"):
        offbench.train(vars(notebook)["Mine"], medium, **small)
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("value", "other"),
    [
        ("torch.ones(2)", "torch.tensor([1.0, 2.0])"),
        ("np.arange(3)", "np.arange(3.0)"),
        ('{"a", "b"}', '{"a", "c"}'),
    ],
)
def test_other_content_of_an_array_or_a_set_is_noticed(home: Path, value: str, other: str) -> None:
    script = SCRIPT.replace("SCALE = 2.0", f"import numpy as np, torch\nSCALE = {value}").replace("limit = SCALE", "")
    before, now = of_script(home, script), of_script(home, script.replace(value, other))
    assert of_script(home, script) == before
    assert describe_changes(before, now) == "__main__: SCALE: content has changed"
    earlier = {name: text for name, text in before.items() if "content" not in name}
    assert describe_changes(earlier, now) == ""


FACTORY = """
from offbench.algos.bc import BC

def make(scale):
    class Mine(BC):
        def policy(self, run):
            assert scale
            return super().policy(run)
    return Mine
"""


@pytest.mark.parametrize("module", ["__main__", "factory"])
def test_classes_that_a_function_makes_with_other_values_are_told_apart(
    home: Path, medium: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (home / "factory.py").write_text(FACTORY)
    source = types.ModuleType(module)
    source.__file__ = str(home / "factory.py")
    monkeypatch.setitem(sys.modules, module, source)
    exec(compile(FACTORY, source.__file__, "exec"), vars(source))
    small = {"hidden": (8,), "batch_size": 8, "eval_every": 10, "eval_episodes": 1, "workers": 1, "steps": 10}
    offbench.train(source.make(1.0), medium, **small)
    offbench.train(source.make(1.0), medium, **small | {"steps": 20})
    with pytest.raises(OffbenchError, match=r"trained by other code of Mine: .*policy: scale has changed"):
        offbench.train(source.make(2.0), medium, **small)


def test_a_scripts_class_of_an_earlier_version_has_not_changed(home: Path) -> None:
    """Earlier versions hashed the class, its Config and its bases only."""
    now = of_script(home, SCRIPT)
    before = {name: text for name, text in now.items() if not name.startswith(MAIN)}
    assert {"Mine", "Config", "bc.py"} == before.keys()
    assert not describe_changes(before, now)
    assert describe_changes(before | {"Mine": "0" * 64}, now) == "Mine has changed"
    assert describe_changes(now, of_script(home, SCRIPT, "HALF = 0.25\n")) == "__main__: parts.py has changed"
