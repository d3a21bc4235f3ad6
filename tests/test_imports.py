"""Imports run one way, and no more is imported than a command needs."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# offbench/algos is a link to algos/ in a checkout
TOOLKIT = [path for path in sorted((ROOT / "offbench").rglob("*.py")) if "algos" not in path.relative_to(ROOT).parts]


def imported(path: Path) -> set[str]:
    """Return every module that a file imports, at its top or in a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", TOOLKIT, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_toolkit_knows_no_algorithm_by_import(path: Path) -> None:
    assert not {name for name in imported(path) if name.startswith(("offbench.algos", "algos"))}


@pytest.mark.parametrize("path", sorted((ROOT / "algos").glob("*.py")), ids=lambda p: p.name)
def test_no_algorithm_imports_another(path: Path) -> None:
    assert not {name for name in imported(path) if name.startswith(("offbench.algos", "algos"))}


# Top to bottom. A package imports only from those after it.
PACKAGES = [
    "cli",
    "reports",
    "tools",
    "evaluation",
    "benchmarks",
    "analysis",
    "training",
    "verification",
    "data",
    "agents",
    "rollouts",
    "algorithm",
    "envs",
    "common",
]


@pytest.mark.parametrize("path", TOOLKIT, ids=lambda p: str(p.relative_to(ROOT)))
def test_packages_import_only_from_those_below(path: Path) -> None:
    package = path.relative_to(ROOT / "offbench").parts[0]
    if package in ("__init__.py", "__main__.py"):  # they name the public functions and the command line
        return
    imports = {name.split(".")[1] for name in imported(path) if name.startswith("offbench.")} & set(PACKAGES)
    assert not [name for name in imports if PACKAGES.index(name) < PACKAGES.index(package)]


def test_no_modules_import_each_other_in_a_circle() -> None:
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in TOOLKIT}
    order = graphlib.TopologicalSorter({name: imported(path) & names.keys() for name, path in names.items()})
    order.prepare()  # raises CycleError


def test_nothing_but_packages_lies_in_offbench() -> None:
    folder = ROOT / "offbench"
    assert {path.name for path in folder.iterdir() if path.is_file()} == {"__init__.py", "__main__.py", "py.typed"}
    assert {path.parts[len(folder.parts)] for path in TOOLKIT if path.parent != folder} == set(PACKAGES)


def test_an_algorithm_imports_offbench_algorithm_alone() -> None:
    for path in (ROOT / "algos").glob("*.py"):
        found = {node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)}
        assert {name for name in found if name and name.startswith("offbench")} <= {"offbench.algorithm"}


def test_datasets_hold_no_code() -> None:
    assert not list((ROOT / "datasets").rglob("*.py"))


def test_no_module_is_longer_than_400_lines() -> None:
    files = [path for folder in ("offbench", "algos", "tests", "docs") for path in (ROOT / folder).rglob("*.py")]
    long = {path.name: n for path in files if (n := len(path.read_text().splitlines())) > 400}
    assert not long


@pytest.mark.parametrize("words", [["--help"], ["list", "--help"], ["collect", "--help"], ["train", "--help"]])
def test_help_loads_nothing_heavy(words: list[str], home: Path) -> None:
    code = f"""
import sys
from offbench.cli.main import main
try:
    main({words!r})
except SystemExit as done:
    assert done.code in (0, None), done.code
heavy = {{"torch", "numpy", "gymnasium", "minari", "mujoco", "h5py", "matplotlib", "rich", "filelock"}}
assert not heavy & sys.modules.keys(), heavy & sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=home)


@pytest.mark.parametrize("words", [["list"], ["normalize", "--env", "hopper", "1000"]])
def test_light_commands_do_not_load_pytorch(words: list[str], home: Path) -> None:
    code = f"""
import sys
from offbench.cli.main import main
try:
    main({words!r})
except SystemExit as done:
    assert done.code in (0, None), done.code
assert "torch" not in sys.modules, "torch was imported"
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=home)


def test_rollout_workers_load_neither_pytorch_nor_the_users_script(home: Path) -> None:
    """A plain script without `if __name__ == "__main__"`: its workers must not run it again."""
    (home / "script.py").write_text(
        """
print("script runs")
import numpy as np
from offbench.envs.environments import env_spec
from offbench.rollouts.policy import uniform_policy
from offbench.rollouts.rollouts import Rollouts, gather

with Rollouts(env_spec("InvertedPendulum-v5"), workers=1) as rollouts:
    policy = uniform_policy(np.full(1, -3, np.float32), np.full(1, 3, np.float32), 4, "InvertedPendulum-v5")
    print(len(gather(rollouts.start_evaluation(policy, 0, (), 3, True))), "episodes")
    loaded = "set(__import__('sys').modules) & {'torch', 'stable_baselines3'}"
    print("worker has", list(rollouts._pool.submit(eval, loaded).result()))
"""
    )
    done = subprocess.run([sys.executable, "script.py"], check=True, cwd=home, capture_output=True, text=True)
    assert done.stdout.splitlines() == ["script runs", "3 episodes", "worker has []"]
