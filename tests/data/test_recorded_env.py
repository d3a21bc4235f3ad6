"""Data that others recorded are replayed, trained and evaluated with the contact margins they were recorded with."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import offbench
from offbench.common import seeds
from offbench.common.errors import OffbenchError
from offbench.common.seeds import Purpose
from offbench.data import minari_store
from offbench.data.recorded_env import recorded_margin
from offbench.envs.contact_margins import SUMMED_SINCE, release
from offbench.envs.environments import env_spec
from offbench.envs.margin_rule import MAX_RULE, SUM_RULE, with_margin, without_margin
from offbench.rollouts.policy import read_policy_file
from offbench.verification.verify import verify

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import minari
    from minari.data_collector import EpisodeBuffer

ITS_OWN, OTHER = (SUM_RULE, MAX_RULE) if release(mujoco.__version__) >= SUMMED_SINCE else (MAX_RULE, SUM_RULE)
MARGIN = {SUM_RULE: "mujoco>=3.5", MAX_RULE: "mujoco<3.5"}


def record_theirs(name: str, requirements: list[str] | None) -> list[EpisodeBuffer]:
    """Record Hopper with nothing but Gymnasium and Minari."""
    env = gym.make("Hopper-v5")
    env.action_space.seed(0)
    episodes = []
    for seed in range(6):
        observations, steps = [env.reset(seed=seed)[0]], []
        while not steps or not (steps[-1][2] or steps[-1][3]):
            action = env.action_space.sample()
            observation, *rest, _ = env.step(action)
            observations.append(observation)
            steps.append((action, *rest))
        names = ("actions", "rewards", "terminations", "truncations")
        columns = dict(zip(names, map(np.array, zip(*steps, strict=True)), strict=True))
        episodes.append(EpisodeBuffer(seed=seed, observations=np.array(observations), infos={}, **columns))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(name, episodes, env=env, data_format="hdf5", requirements=requirements)
    return episodes


def played_by_gymnasium(policy_file: Path, count: int) -> list[float]:
    """Return the returns of the evaluation episodes, played with Gymnasium alone."""
    env, policy, returns = gym.make("Hopper-v5"), read_policy_file(policy_file), []
    for i in range(count):
        observation, _ = env.reset(seed=seeds.integer(0, Purpose.RESET, int(Purpose.REFERENCE), 2, i))
        returns.append(0.0)
        over = False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(policy.act(observation[None], None)[0])
            returns[-1] += float(reward)
            over = terminated or truncated
    return returns


def train(name: str) -> Path:
    runs = offbench.train("bc", name, seeds=[0], steps=20, eval_every=20, eval_episodes=1, workers=1)
    return runs[0]


def test_a_dataset_recorded_without_offbench_has_its_own_physics(capsys: pytest.CaptureFixture[str]) -> None:
    episodes = record_theirs("theirs-v0", [f"mujoco=={mujoco.__version__}"])
    report = verify("theirs-v0", workers=1)
    assert report.ok, report.lines()
    assert any("6 episodes played again from their seeds, bit for bit" in line for line in report.checked)
    env = offbench.make_env("theirs-v0")
    for episode in episodes:
        np.testing.assert_array_equal(env.reset(seed=episode.seed)[0], episode.observations[0])
        for action, observation in zip(episode.actions, episode.observations[1:], strict=True):
            np.testing.assert_array_equal(env.step(action)[0], observation)
    run = train("theirs-v0")
    said = capsys.readouterr().err
    assert ("MuJoCo 3.5 and later" in said) == (ITS_OWN == SUM_RULE)
    wanted = played_by_gymnasium(run / "policy.safetensors", 3)
    evaluation = offbench.evaluate(run, episodes=3, workers=1)
    np.testing.assert_allclose(evaluation.returns, wanted, rtol=1e-12)
    assert ("MuJoCo 3.5 and later" in evaluation.lines()[0]) == (ITS_OWN == SUM_RULE)
    # under the other rule the same policy has other returns
    config = json.loads((run / "config.json").read_text())
    config["env_spec"] = with_margin(config["env_spec"], OTHER)
    (run / "config.json").write_text(json.dumps(config))
    assert np.abs(np.array(offbench.evaluate(run, episodes=3, workers=1).returns) - wanted).max() > 1e-6
    with pytest.raises(offbench.OffbenchError, match="environment"):
        train("theirs-v0")


def test_where_no_version_is_recorded_verify_finds_the_margins(capsys: pytest.CaptureFixture[str]) -> None:
    record_theirs("theirs-v0", None)
    report = verify("theirs-v0", workers=1)
    assert report.ok, report.lines()
    assert any(MARGIN[ITS_OWN] in line for line in report.warnings), report.warnings
    offbench.make_env("theirs-v0").close()
    said = capsys.readouterr().err
    assert all(word in said for word in ("theirs-v0", "before 3.5", "offbench verify"))
    minari.load_dataset("theirs-v0").storage.update_metadata({"requirements": [MARGIN[ITS_OWN]]})
    report = verify("theirs-v0", workers=1)
    assert report.ok, report.lines()
    assert not report.warnings


@pytest.mark.parametrize(
    ("metadata", "rule"),
    [
        ({}, None),
        ({"requirements": ["mujoco==3.4.0", "gymnasium>=1"]}, MAX_RULE),
        ({"requirements": ["gymnasium>=4", "mujoco == 3.10.0"]}, SUM_RULE),
        ({"requirements": ["mujoco>=3.1.0,<3.2.0"]}, MAX_RULE),
        ({"requirements": ["mujoco>=3.2"]}, None),
        ({"requirements": ["mujoco<4"]}, None),
        ({"requirements": ["mujoco<3.5"]}, MAX_RULE),
        ({"requirements": ["mujoco>=3.5,<5"]}, SUM_RULE),
        ({"requirements": ["mujoco-py>=4", "mujoco_py>=4"]}, None),
        ({"requirements": "mujoco==4.0.0"}, None),
        ({"requirements": ["mujoco==3.*"]}, None),
        ({"requirements": ["mujoco==3.4.*"]}, MAX_RULE),
        ({"offbench": {"versions": {}}}, MAX_RULE),
        ({"offbench": {"contact_margin": "sum", "versions": {"mujoco": "3.4.0"}}}, SUM_RULE),
        ({"offbench": {"contact_margin": None, "versions": {"mujoco": "4.0.0"}}}, MAX_RULE),
        ({"offbench": {"imported": {}}, "requirements": ["mujoco==4.0.0"]}, SUM_RULE),
    ],
)
def test_metadata_tell_the_rule(metadata: dict[str, Any], rule: str | None) -> None:
    assert recorded_margin(metadata) == rule


def test_a_recipe_may_ask_for_the_rule_of_later_versions(
    tiny: tuple[str, str], home: Path, offbench_cli: Callable[..., Any]
) -> None:
    recipe = home / "added.toml"
    recipe.write_text('contact_margin = "sum"\n' + Path(tiny[0]).read_text())
    offbench.collect(str(recipe), "random", steps=50, workers=1, dataset_id="added-v0")
    metadata = minari_store.read_metadata("added-v0")
    for key in ("env_spec", "eval_env_spec"):
        assert without_margin(metadata[key]) == (metadata[key], MAX_RULE)  # Gymnasium's own, nothing added
    assert metadata["offbench"]["contact_margin"] == SUM_RULE
    assert minari.load_dataset("added-v0").recover_environment(eval_env=True).spec.id == "InvertedPendulum-v5"
    recipe.write_text('env_id = "Hopper-v5"\ncontact_margin = "sum"')
    margins = {
        rule: offbench.make_env(name).unwrapped.model.geom_margin.max()  # type: ignore[attr-defined]
        for rule, name in ((SUM_RULE, str(recipe)), (MAX_RULE, "hopper"))
    }
    assert margins[ITS_OWN] == gym.make("Hopper-v5").unwrapped.model.geom_margin.max()  # type: ignore[attr-defined]
    assert margins[SUM_RULE] == 2 * margins[MAX_RULE]
    recipe.write_text('env_id = "Hopper-v5"\ncontact_margin = "both"')
    done = offbench_cli("collect", str(recipe))
    assert done.returncode == 2
    assert all(word in done.stderr for word in ("contact_margin", "both", "max", "sum"))


def test_an_environment_is_made_by_the_name_of_a_recipe_or_dataset(medium: str, home: Path) -> None:
    assert offbench.make_env(medium).spec.id == "InvertedPendulum-v5"  # type: ignore[union-attr]
    env = offbench.make_env("walker2d", render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    assert env.spec.max_episode_steps == 1000  # type: ignore[union-attr]
    with pytest.raises(offbench.OffbenchError, match="hoper"):
        offbench.make_env("hoper")
    with pytest.raises(offbench.OffbenchError, match="contact_margin"):
        without_margin(env_spec("Hopper-v5")[:-1] + ', "contact_margin": "none"}')


def test_making_an_environment_writes_no_log_and_prints_nothing(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    offbench.make_env("halfcheetah").close()
    assert not list(home.glob("MUJOCO_LOG*"))
    said = capfd.readouterr()
    assert not said.out + said.err


@pytest.mark.parametrize("text", ["null", "[]", '{"id": 3}'])
def test_a_spec_that_is_no_environment_is_damage(text: str, medium: str, home: Path) -> None:
    path = home / "minari" / medium / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"eval_env_spec": text}))
    for call in (offbench.make_env, offbench.load, offbench.show):
        with pytest.raises(OffbenchError, match=r"metadata\.json is damaged: eval_env_spec names no environment"):
            call(medium)
