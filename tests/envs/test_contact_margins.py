"""Environments move as they do on MuJoCo before 3.5, whatever MuJoCo is installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from offbench.envs import physics
from offbench.envs.contact_margins import (
    GAP_OUTSIDE_SINCE,
    SUMMED_SINCE,
    _colliding,
    release,
    rotations_changed,
    set_contacts,
)
from offbench.envs.margin_rule import MAX_RULE, SUM_RULE
from offbench.envs.recipes import load_recipe
from tests.conftest import ROOT

HERE = release(mujoco.__version__)
NEW = pytest.mark.skipif(HERE < SUMMED_SINCE, reason="this MuJoCo takes the larger margin itself")
REPLAY = """
import json, sys
import mujoco, numpy as np
from offbench.envs.environments import make_env
from offbench.common.files import read_json
from offbench.envs.recipes import load_recipe
from offbench.agents.medium_replay import load_replay

STATES = {"hopper": 11, "walker2d": 17, "halfcheetah": 17, "inverted-pendulum": 4}
errors = {}
for name, size in STATES.items():
    recipe = load_recipe(name)
    env = make_env(recipe.env_spec())
    env.reset(seed=0)
    inner = env.unwrapped
    hidden = inner.model.nq + inner.model.nv - size  # x, on which nothing depends
    folder = recipe.folder / "behaviour"
    digest = read_json(folder / "ladder.json")["medium_replay"]["sha256"]
    episodes = load_replay(
        folder / "medium-replay.hdf5", digest, env.observation_space, env.action_space.low, env.action_space.high
    )
    errors[name] = []
    positions = inner.model.nq - hidden
    steps = ((episode, t) for episode in episodes for t in range(5, len(episode), 40))
    for episode, t in steps:
        before = episode.observations[t]
        if (np.abs(before[positions:]) == 10).any():  # Hopper and Walker2d clip velocities there
            continue
        inner.set_state(np.concatenate([np.zeros(hidden), before[:positions]]), before[positions:])
        after = inner.step(episode.actions[t])[0]
        errors[name].append(float((np.abs(after - episode.observations[t + 1]) / (1 + np.abs(after))).max()))
        if len(errors[name]) == 100:
            break
print(json.dumps({"mujoco": mujoco.__version__, "errors": errors}))
"""
# A plane and two spheres just above it and each other: {0}, {1} and {2} are their margins and gaps.
SCENE = """
<mujoco><worldbody><geom name="a" type="plane" size="1 1 1" {0}/>
<body pos="0 0 .112"><freejoint/><geom name="b" size=".1" {1}/></body>
<body pos=".205 0 .109"><freejoint/><geom name="c" size=".1" {2}/></body></worldbody>{pairs}</mujoco>
"""


@pytest.mark.parametrize("version", ["installed", "3.2.3", "3.4.0", "3.5.0", "4.0.0"])
def test_shipped_transitions_come_out_again(version: str) -> None:
    folder = ROOT / ".mujoco" / version
    environment = dict(os.environ)
    if version != "installed":
        if not folder.is_dir():
            pytest.skip(f"no MuJoCo {version} in {folder}: `make mujoco-versions` installs it")
        environment["PYTHONPATH"] = str(folder)
    done = subprocess.run([sys.executable, "-c", REPLAY], env=environment, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["mujoco"] == (mujoco.__version__ if version == "installed" else version)
    for name, errors in found["errors"].items():
        assert len(errors) == 100, name
        # the states are float32: a few lie where that much carries them across a contact
        assert np.quantile(errors, 0.9) < 2e-6, (name, max(errors))
        assert np.median(errors) < 5e-7, name


def accelerations(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def by_hand(values: list[tuple[float, float]], rule: str) -> mujoco.MjModel:
    """Return the scene with each contact written out, margin and gap by the rule from those of its geoms."""
    pairs, combine = "", max if rule == MAX_RULE else lambda a, b: a + b
    for one, other in ((0, 1), (0, 2), (1, 2)):
        margin, gap = (combine(values[one][i], values[other][i]) for i in (0, 1))
        if rule == MAX_RULE and HERE >= GAP_OUTSIDE_SINCE:
            margin -= gap
        if rule == SUM_RULE and HERE < GAP_OUTSIDE_SINCE:
            margin += gap
        pairs += f'<pair geom1="{"abc"[one]}" geom2="{"abc"[other]}" margin="{margin}" gap="{gap}" condim="3"/>'
    none = 'contype="0" conaffinity="0"'
    return mujoco.MjModel.from_xml_string(SCENE.format(none, none, none, pairs=f"<contact>{pairs}</contact>"))


@pytest.mark.parametrize(
    "values",
    [
        [(0.02, 0.0)] * 3,
        [(0.02, 0.004)] * 3,
        [(0.02, 0.015)] * 3,  # within the margin but for the gap: no force between plane and spheres
        [(0.0, 0.0), (0.02, 0.0), (0.02, 0.0)],
        [(0.03, 0.0), (0.01, 0.0), (0.02, 0.0)],
        [(0.03, 0.002), (0.01, 0.001), (0.02, 0.001)],
    ],
)
def test_the_larger_margin_and_gap_decide(values: list[tuple[float, float]]) -> None:
    words = [f'margin="{margin}" gap="{gap}"' for margin, gap in values]
    model = mujoco.MjModel.from_xml_string(SCENE.format(*words, pairs=""))
    plain = accelerations(model)
    set_contacts(model, MAX_RULE, "scene")
    wanted = accelerations(by_hand(values, MAX_RULE))
    np.testing.assert_allclose(accelerations(model), wanted, rtol=1e-9, atol=1e-9)
    if HERE >= SUMMED_SINCE:
        assert np.abs(plain - wanted).max() > 1e-3  # MuJoCo's own rule gives something else


@pytest.mark.skipif(SUMMED_SINCE <= HERE < GAP_OUTSIDE_SINCE, reason="this MuJoCo takes gaps off the sum of margins")
@pytest.mark.parametrize("values", [[(0.02, 0.0)] * 3, [(0.02, 0.004)] * 3, [(0.02, 0.0), (0.01, 0.0), (0.01, 0.0)]])
def test_both_margins_together_decide_where_data_have_that_rule(values: list[tuple[float, float]]) -> None:
    model = mujoco.MjModel.from_xml_string(SCENE.format(*(f'margin="{m}" gap="{g}"' for m, g in values), pairs=""))
    set_contacts(model, SUM_RULE, "scene")
    np.testing.assert_allclose(accelerations(model), accelerations(by_hand(values, SUM_RULE)), rtol=1e-9, atol=1e-9)


def boxes(margins: list[float]) -> mujoco.MjModel:
    """Return a model of free spheres of these margins, any two of which can collide."""
    bodies = "".join(
        f'<body pos="{i} 0 0"><freejoint/><geom size=".1" margin="{m}"/></body>' for i, m in enumerate(margins)
    )
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


@NEW
def test_margins_that_nothing_restores_are_left_alone_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    margins = [0.01, 0.02, 0.03, 0.04]
    model = boxes(margins)
    set_contacts(model, MAX_RULE, "four spheres")
    assert model.geom_margin.tolist() == margins
    said = capsys.readouterr().err
    assert all(word in said for word in ("four spheres", "mujoco<3.5"))
    set_contacts(boxes(margins), MAX_RULE, "four spheres")
    assert not capsys.readouterr().err  # once is enough


def test_only_a_rotating_environment_warns_of_another_physics(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(physics, "versions", lambda: {"mujoco": "4.0.0"})
    hopper, ant = (load_recipe(name).env_spec() for name in ("hopper", "ant"))
    for spec, version in ((hopper, "3.4.0"), (hopper, "3.10.0"), (ant, "4.1.0")):
        physics.warn_other_physics("it", {"mujoco": version}, spec)
    assert not capsys.readouterr().err
    physics.warn_other_physics("the ant's data", {"mujoco": "3.4.0"}, ant)
    said = capsys.readouterr().err
    assert all(word in said for word in ("the ant's data", "3.4.0", "4.0.0"))
    assert not rotations_changed(boxes([0.0]))  # Euler's integrator


# bodies that overlap: a chain with a welded one and an exclusion, and a child of one that is welded to the world
CHAIN = """
<mujoco><option><flag filterparent="{0}"/></option><worldbody><geom name="floor" type="plane" size="1 1 1"/>
<body name="base"><geom name="base" size=".1"/><body><joint/><geom name="child of the world" size=".1"/></body></body>
<body name="a"><joint/><geom name="a" size=".1"/>
  <body name="b"><joint/><geom name="b" size=".1"/><body><geom name="welded to b" size=".1"/>
    <body name="c"><joint/><geom name="c" size=".1"/>
      <body name="d"><joint/><geom name="d" size=".1"/><geom name="other type" size=".1" contype="2" conaffinity="4"/>
</body></body></body></body></body></worldbody>
<contact><exclude body1="d" body2="a"/></contact></mujoco>
"""


@pytest.mark.parametrize("flag", ["enable", "disable"])
def test_the_pairs_that_collide_are_those_that_mujoco_finds(flag: str) -> None:
    model = mujoco.MjModel.from_xml_string(CHAIN.format(flag))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    ours = set(zip(*(side.tolist() for side in _colliding(model)), strict=True))
    assert ours == found
    assert len(found) > 8
