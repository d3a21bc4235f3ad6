"""An edit of an environment's code is noticed by everything that was made with it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import pytest

import offbench
from offbench.analysis.results import read_results
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.envs.environment_code import _files, environment_code
from offbench.envs.environments import env_spec
from offbench.envs.model_files import loaded_files
from offbench.training.run import Run
from tests.conftest import TINY_RECIPE, forget_modules

ENVIRONMENT = """
import gymnasium as gym
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

from gains import GAIN


class Pushed(InvertedPendulumEnv):
    def step(self, action):
        return super().step(GAIN * action)


gym.register("Pushed-v0", "pushed:Pushed", max_episode_steps=100)
"""
SMALL: dict[str, Any] = {"eval_every": 2, "eval_episodes": 1, "hidden": (8,), "batch_size": 4, "workers": 1}


@pytest.fixture
def recipe(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A recipe of an environment in two modules of the working directory."""
    (home / "pushed.py").write_text(ENVIRONMENT)
    (home / "gains.py").write_text("GAIN = 1.0\n")
    (home / "pushed.toml").write_text(
        TINY_RECIPE.replace("InvertedPendulum-v5", "pushed:Pushed-v0").replace("tiny", "pushed")
    )
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.setenv("OFFBENCH_TRUST", "1")
    yield home / "pushed.toml"
    gym.registry.pop("Pushed-v0", None)


def edit(home: Path, name: str, text: str) -> None:
    """Write a module, as if the next command were another process."""
    (home / name).write_text(text)
    forget_modules(home)
    gym.registry.pop("Pushed-v0", None)
    sys.path_importer_cache.clear()


def test_what_is_hashed(home: Path, recipe: Path) -> None:
    assert environment_code(env_spec("Hopper-v5")) == {}
    before = environment_code(env_spec("pushed:Pushed-v0"))
    assert list(before) == ["gains.py", "pushed.py"]
    edit(home, "gains.py", "# of the motor\nGAIN = 1.0\n")
    assert environment_code(env_spec("pushed:Pushed-v0")) == before
    edit(home, "gains.py", "GAIN = 2.0\n")
    after = environment_code(env_spec("pushed:Pushed-v0"))
    assert [name for name in before if before[name] != after[name]] == ["gains.py"]


def test_a_word_among_the_arguments_is_no_file(home: Path) -> None:
    """Whatever the current folder holds."""
    for name in ("float32", "scene.xml"):
        (home / name).write_text("a file")
    found = list(_files("", {"dtype": "float32", "files": ["scene.xml", "./float32"]}))
    assert found == [("files.0", "scene.xml"), ("files.1", "./float32")]


def test_a_model_that_an_argument_names_is_hashed(home: Path) -> None:
    assets = Path(gym.envs.mujoco.__file__).parent / "assets"
    model = home / "heavy.xml"
    model.write_bytes((assets / "inverted_pendulum.xml").read_bytes())
    spec = env_spec("InvertedPendulum-v5", xml_file=str(model))
    before = environment_code(spec)
    assert list(before) == ["heavy.xml"]
    model.write_text(model.read_text().replace('gravity="0 0 -9.81"', 'gravity="0 0 -5"'))
    assert environment_code(spec) != before


ROBOT = """<mujoco>
  <compiler meshdir="meshes"/>
  <include file="parts/world.xml"/>
  <asset><mesh name="foot" file="foot.obj"/></asset>
</mujoco>"""
FOOT = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
PARTS = {"parts/world.xml": '<mujoco><include file="gravity.xml"/></mujoco>', "meshes/foot.obj": FOOT}
GRAVITY = '<mujoco><option gravity="0 0 -5"/></mujoco>'


@pytest.fixture
def robot(home: Path) -> Path:
    """A MuJoCo model that includes a file which includes another, and loads a mesh."""
    for name, text in {"robot.xml": ROBOT, **PARTS, "parts/gravity.xml": GRAVITY, "parts/unused.xml": GRAVITY}.items():
        (home / name).parent.mkdir(exist_ok=True)
        (home / name).write_text(text)
    return home / "robot.xml"


def test_the_files_of_a_model_are_those_that_mujoco_loads(robot: Path) -> None:
    found = {str(robot.parent / name) for name in loaded_files(robot)}
    assert found == {str(robot.parent / name) for name in (*PARTS, "parts/gravity.xml")}
    if hasattr(mujoco, "mju_getXMLDependencies"):  # not in the oldest MuJoCo
        assert found | {str(robot)} == set(mujoco.mju_getXMLDependencies(str(robot)))


def test_files_that_a_model_loads_are_hashed(robot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(robot.parent))
    spec = {"entry_point": "gymnasium.envs:X", "kwargs": {"xml_file": "~/robot.xml"}}
    before = environment_code(json.dumps(spec))
    assert list(before) == ["robot.xml", *(f"robot.xml: {name}" for name in sorted([*PARTS, "parts/gravity.xml"]))]
    (robot.parent / "parts/gravity.xml").write_text(GRAVITY.replace("-5", "-9"))
    after = environment_code(json.dumps(spec))
    assert describe_changes(before, after) == "robot.xml: parts/gravity.xml has changed"
    assert describe_changes({"robot.xml": before["robot.xml"]}, after) == ""  # recorded by an earlier version
    assert describe_changes({"robot.xml": "0" * 64}, after) == "robot.xml has changed"


def test_the_model_of_a_class_is_hashed(home: Path, recipe: Path) -> None:
    assets = Path(gym.envs.mujoco.__file__).parent / "assets"
    model = home / "heavy.xml"
    model.write_bytes((assets / "inverted_pendulum.xml").read_bytes())
    init = f"        super().__init__(xml_file={str(model)!r})\n"
    edit(home, "pushed.py", ENVIRONMENT.replace("    def step", f"    def __init__(self):\n{init}\n    def step"))
    spec = env_spec("pushed:Pushed-v0")
    before = environment_code(spec)
    assert list(before) == ["gains.py", "model: heavy.xml", "pushed.py"]
    model.write_text(model.read_text().replace('gravity="0 0 -9.81"', 'gravity="0 0 -5"'))
    assert describe_changes(before, environment_code(spec)) == "model: heavy.xml has changed"


def test_files_of_one_name_and_in_lists_are_all_hashed(home: Path) -> None:
    names = ["a/model.xml", "b/model.xml", "c/part.xml"]
    for name in names:
        (home / name).parent.mkdir()
        (home / name).write_text(name)
    robot, scene, part = (str(home / name) for name in names)
    spec = {"entry_point": "gymnasium.envs:X", "kwargs": {"robot": robot, "scene": scene, "assets": {"all": [part]}}}
    before = environment_code(json.dumps(spec))
    assert list(before) == ["model.xml", "model.xml (scene)", "part.xml"]
    for name in names:
        (home / name).write_text("edited")
        after = environment_code(json.dumps(spec))
        assert sum(before[key] != after[key] for key in before) == 1
        before = after


def test_an_edit_is_noticed(home: Path, recipe: Path, capfd: pytest.CaptureFixture[str]) -> None:
    dataset = offbench.collect(recipe, "random", workers=1)
    offbench.collect(recipe, "medium", workers=1)
    (folder,) = offbench.train("bc", dataset, steps=2, **SMALL)
    edit(home, "gains.py", "GAIN = 1.0  # the same\n")
    offbench.collect(recipe, "medium", workers=1)
    assert "recorded already" in capfd.readouterr().err
    edit(home, "gains.py", "GAIN = -1.0\n")
    with pytest.raises(OffbenchError, match=r"agent in .* was trained in other code of its environment: gains.py has"):
        offbench.collect(recipe, "expert", workers=1)
    with pytest.raises(OffbenchError, match=r"began in other code of its environment: gains.py has changed"):
        offbench.behaviour(recipe, workers=1)
    with pytest.raises(OffbenchError, match=r"was trained in other code of its environment: gains.py has changed"):
        offbench.normalize(env=recipe, returns=[1.0])
    (home / "behaviour").rename(home / "old")
    with pytest.raises(OffbenchError, match=r"pushed-random-v0 was recorded in other code of its env.*: gains.py"):
        offbench.collect(recipe, "random", workers=1)
    with pytest.raises(OffbenchError, match=r"was evaluated in other code of its environment: gains.py has changed"):
        offbench.train("bc", dataset, steps=4, **SMALL)
    capfd.readouterr()
    offbench.evaluate(folder, episodes=1, workers=1)
    assert "environment has changed since it was trained: gains.py" in capfd.readouterr().err
    offbench.train("bc", dataset, steps=2, seeds=[1], **SMALL)
    assert f"{dataset} was recorded in other code of its environment: gains.py" in capfd.readouterr().err
    with pytest.raises(OffbenchError, match="evaluated in environments of different code"):
        read_results("runs")


def test_runs_and_ladders_of_earlier_versions_stay_valid(home: Path, recipe: Path) -> None:
    dataset = offbench.collect(recipe, "random", workers=1)
    (folder,) = offbench.train("bc", dataset, steps=2, **SMALL)
    path = Run(folder).config_path
    text = path.read_text()
    assert '"env_code"' in text
    path.write_text(text.replace('"env_code"', '"of_an_earlier_version"'))
    edit(home, "gains.py", "GAIN = -1.0\n")
    offbench.train("bc", dataset, steps=4, **SMALL)
    assert sorted(Run(folder).evaluations()) == [2, 4]
