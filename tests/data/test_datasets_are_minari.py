"""What `collect` writes is a Minari dataset in every respect, for every level."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest

import offbench
from offbench.agents.ladder import read_ladder
from offbench.common.errors import OffbenchError
from offbench.common.files import exclusive_lock
from offbench.data import minari_store
from offbench.data.content_hash import ContentHash
from offbench.data.levels import LEVELS

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import minari


@pytest.fixture(scope="module", params=[*LEVELS, "0.6", "mix"])
def recorded(request: pytest.FixtureRequest, tiny: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Every level of the tiny recipe, as Minari loads it."""
    recipe, behaviour_dir = tiny
    blend = {"mix": "random:0.25,expert:0.75"} if request.param == "mix" else {"level": request.param}
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        name = offbench.collect(recipe, behaviour_dir=behaviour_dir, workers=1, accept=True, **blend)
        return minari.load_dataset(name)


def test_every_level_is_whole(recorded: Any) -> None:
    lengths = []
    for episode in recorded.iterate_episodes():
        steps = len(episode.rewards)
        lengths.append(steps)
        assert episode.observations.shape == (steps + 1, 4)
        assert episode.observations.dtype == np.float64
        assert episode.actions.shape == (steps, 1)
        assert episode.actions.dtype == np.float32
        assert np.abs(episode.actions).max() <= 3
        ends = episode.terminations | episode.truncations
        assert ends[-1]
        assert not ends[:-1].any()
        assert not (episode.terminations & episode.truncations).any()
    assert sum(lengths) == recorded.total_steps
    assert len(lengths) == recorded.total_episodes


def test_all_of_minaris_metadata_is_filled(recorded: Any) -> None:
    metadata = recorded.storage.metadata
    for key in (
        "env_spec",
        "eval_env_spec",
        "algorithm_name",
        "author",
        "author_email",
        "code_permalink",
        "description",
        "requirements",
        "ref_min_score",
        "ref_max_score",
        "num_episodes_average_score",
        "minari_version",
        "dataset_size",
    ):
        assert metadata[key], key
    assert recorded.recover_environment().spec.id == "InvertedPendulum-v5"
    assert recorded.recover_environment(eval_env=True).spec.id == "InvertedPendulum-v5"
    low, high = metadata["ref_min_score"], metadata["ref_max_score"]
    scores = minari.get_normalized_score(recorded, np.array([low, high, (low + high) / 2]))
    np.testing.assert_allclose(scores, [0, 1, 0.5])


def test_provenance_says_what_was_measured(recorded: Any) -> None:
    ours = recorded.storage.metadata["offbench"]
    assert ours["seed"] == 0
    assert len(ours["content_sha256"]) == 64
    assert set(ours["versions"]) >= {"mujoco", "gymnasium", "stable-baselines3", "torch", "numpy"}
    assert sum(part["transitions"] for part in ours["parts"]) == recorded.total_steps
    for part in ours["parts"]:
        if "rung" in part:
            low, high = part["interval"]
            assert low <= part["return"] <= high
            assert part["episodes"] == 8


def test_the_content_hash_is_over_the_arrays(medium: str) -> None:
    """Recomputed here from Minari's own reading, and blind to how the file is laid out."""
    content = ContentHash()
    for episode in minari.load_dataset(medium).iterate_episodes():
        content.add(episode.observations, episode.actions, episode.rewards, episode.terminations, episode.truncations)
    assert content.hexdigest() == minari_store.read_provenance(minari_store.read_metadata(medium)).content_sha256
    assert content.hexdigest() == offbench.load(medium).content_sha256


def test_medium_expert_is_medium_then_expert(tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    name = offbench.collect(recipe, "medium-expert", behaviour_dir=behaviour_dir, workers=1, steps=800)
    parts = minari_store.read_provenance(minari_store.read_metadata(name)).parts
    assert parts is not None
    assert [(p["source"], p["transitions"]) for p in parts] == [("medium", 400), ("expert", 400)]
    first = offbench.collect(recipe, "medium", behaviour_dir=behaviour_dir, workers=1, steps=400)
    both, alone = (minari.load_dataset(x) for x in (name, first))
    for episode, same in zip(alone.iterate_episodes(), both.iterate_episodes(), strict=False):
        np.testing.assert_array_equal(episode.observations, same.observations)
        np.testing.assert_array_equal(episode.terminations, same.terminations)


def test_medium_replay_is_every_transition_of_training(tiny: tuple[str, str]) -> None:
    """Against the segment files that training itself wrote, stream by stream."""
    recipe, behaviour_dir = tiny
    ladder = read_ladder(Path(behaviour_dir) / "tiny" / "seed-0" / "ladder")
    assert ladder is not None
    until = ladder.info.levels["medium"]
    name = offbench.collect(recipe, "medium-replay", behaviour_dir=behaviour_dir)
    episodes = list(minari.load_dataset(name).iterate_episodes())
    assert sum(map(len, episodes)) == until
    rewards, actions, terminated = [], [], 0
    for end in range(400, until + 1, 400):
        with np.load(Path(behaviour_dir) / "tiny" / "seed-0" / "transitions" / f"{end:09d}.npz") as segment:
            for stream in range(4):
                rewards.append(segment["rewards"][:, stream])
                actions.append(segment["actions"][:, stream])
            terminated += int((segment["dones"] * (1 - segment["timeouts"])).sum())
    np.testing.assert_array_equal(np.concatenate([e.rewards for e in episodes]), np.concatenate(rewards))
    replayed = np.concatenate([e.actions for e in episodes])
    np.testing.assert_allclose(replayed, 3 * np.concatenate(actions), atol=1e-6)
    assert sum(bool(e.terminations[-1]) for e in episodes) == terminated


def test_medium_replay_of_some_environments(tiny: tuple[str, str], home: Path) -> None:
    """Where all transitions are too many to ship: whole episodes of the first of the four environments."""
    shutil.copytree(Path(tiny[1]), home / "behaviour", ignore=shutil.ignore_patterns("ladder"))
    (home / "tiny.toml").write_text("replay_envs = 1\n" + Path(tiny[0]).read_text())
    ladder = offbench.behaviour("./tiny.toml", behaviour_dir=home / "behaviour", workers=1)
    assert ladder.info.command.startswith("offbench behaviour ./tiny.toml --seed 0")
    name = offbench.collect("./tiny.toml", "medium-replay", behaviour_dir=home / "behaviour")
    rewards = [
        np.load(home / "behaviour" / "tiny" / "seed-0" / "transitions" / f"{end:09d}.npz")["rewards"][:, 0]
        for end in range(400, ladder.info.levels["medium"] + 1, 400)
    ]
    dataset = minari.load_dataset(name)
    np.testing.assert_array_equal(np.concatenate([e.rewards for e in dataset]), np.concatenate(rewards))
    assert "(1 of its 4 environments)" in dataset.storage.metadata["description"]


def test_recorded_episodes_replay_from_their_seeds(medium: str) -> None:
    """The seed that Minari stores resets an environment to the same start, and the actions do the rest."""
    data = minari.load_dataset(medium)
    env = gym.make("InvertedPendulum-v5")
    with h5py.File(Path(data.storage.data_path) / "main_data.hdf5") as file:
        for i in range(3):
            group = file[f"episode_{i}"]
            observation, _ = env.reset(seed=int(group.attrs["seed"]))
            for t, action in enumerate(group["actions"]):
                np.testing.assert_array_equal(observation, group["observations"][t])
                observation, *_ = env.step(action)


def test_an_id_is_replaced_only_when_asked(tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    name = offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=50)
    before = minari_store.read_metadata(name)["offbench"]["content_sha256"]
    with pytest.raises(OffbenchError, match="--overwrite"):
        offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=60)
    assert minari_store.read_metadata(name)["offbench"]["content_sha256"] == before
    offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=60, overwrite=True)
    assert minari_store.read_metadata(name)["total_steps"] == 60
    assert minari_store.local_ids() == [name]


def test_a_failed_recording_leaves_the_old_dataset(tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, behaviour_dir = tiny
    name = offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=50)
    before = json.dumps(minari_store.read_metadata(name))

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ContentHash, "add", fail)
    with pytest.raises(OffbenchError, match="No space left on device"):
        offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=60, overwrite=True)
    assert json.dumps(minari_store.read_metadata(name)) == before
    assert [p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")] == [name]


def test_the_same_dataset_again_is_left_as_it_is(tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    recipe, behaviour_dir = tiny

    def collect(**arguments: Any) -> str:
        return offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, **arguments)

    name = collect(steps=50)
    before = (minari_store.path_of(name) / "data" / "main_data.hdf5").stat().st_mtime_ns
    assert collect(steps=50) == name
    assert "recorded already" in capsys.readouterr().err
    assert (minari_store.path_of(name) / "data" / "main_data.hdf5").stat().st_mtime_ns == before
    for other in ({"steps": 60}, {"steps": 50, "seed": 1}):
        with pytest.raises(OffbenchError, match="exists already"):
            collect(**other)


def test_what_a_killed_process_left_beside_a_dataset_goes_when_it_is_asked_for_again(tiny: tuple[str, str]) -> None:
    """But never under the hands of a process that is at work on it."""

    def collect() -> str:
        return offbench.collect(tiny[0], "random", behaviour_dir=tiny[1], workers=1, steps=50)

    def beside() -> set[str]:
        return {p.name for p in minari_store.root().iterdir() if not p.name.endswith(".lock")} - {name}

    name = collect()
    left = {f".offbench-{name}.{ending}" for ending in ("holder", "old", "partial")}
    for folder in sorted(left)[1:]:
        (minari_store.root() / folder / "data").mkdir(parents=True)
    with exclusive_lock(minari_store.root() / f".offbench-{name}.lock", "held"):
        collect()
        assert beside() == left
    (minari_store.root() / f".offbench-{name}.holder").touch()
    collect()
    assert beside() == set()


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_replacement_that_fails_at_the_last_moment_keeps_the_old_dataset(
    tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """The renames themselves fail, or the process dies between them (then the next command mends it)."""
    recipe, behaviour_dir = tiny
    name = offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=50)
    before = json.dumps(minari_store.read_metadata(name))
    path = minari_store.path_of(name)
    if moment == "after":
        path.rename(path.with_name(f".offbench-{name}.old"))
        with pytest.raises(OffbenchError, match="exists already"):
            offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=60)
    else:
        original = Path.replace

        def fail(self: Path, target: Path) -> Path:
            if self.name.endswith(".partial"):
                raise OSError(5, "Input/output error")
            return original(self, target)

        monkeypatch.setattr(Path, "replace", fail)
        with pytest.raises(OffbenchError, match="Input/output error"):
            offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=60, overwrite=True)
    assert json.dumps(minari_store.read_metadata(name)) == before


def test_a_replaced_dataset_that_cannot_be_put_back_is_named(tiny: tuple[str, str]) -> None:
    recipe, behaviour_dir = tiny
    name = offbench.collect(recipe, "random", behaviour_dir=behaviour_dir, workers=1, steps=50)
    path = minari_store.path_of(name)
    old = path.rename(path.with_name(f".offbench-{name}.old"))
    lock = path.with_name(f".offbench-{name}.lock")
    lock.unlink(missing_ok=True)
    lock.mkdir()  # as in a folder that may not be written: the lock cannot be taken
    with pytest.raises(OffbenchError, match=re.escape(f"rename {old} to {path}")):
        offbench.verify(name)
    old.rename(path)
    assert offbench.verify(name).ok


def test_environments_that_reuse_their_array_are_recorded_right() -> None:
    from offbench.rollouts.policy import uniform_policy
    from offbench.rollouts.rollouts import EpisodeTask, _RunningEpisode

    class Reusing(gym.Env[Any, Any]):
        def __init__(self) -> None:
            self.state = np.zeros(1)
            self.observation_space = gym.spaces.Box(0, 3, (1,), np.float64)
            self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            self.state[:] = 0
            return self.state, {}

        def step(self, action: Any) -> Any:
            action *= 10
            self.state += 1
            return self.state, 0.0, bool(self.state[0] == 3), False, {}

    policy = uniform_policy(np.full(1, -1, np.float32), np.full(1, 1, np.float32), 1, "X-v0")
    lane = _RunningEpisode(Reusing(), policy, EpisodeTask("", b"", 0, (), (0,), False), 0)
    episode = next(e for e in (lane.step(np.full(1, 0.5, np.float32)) for _ in range(9)) if e)
    np.testing.assert_array_equal(episode.observations[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(episode.actions[:, 0], [0.5, 0.5, 0.5])


DOUBLE = """
import gymnasium as gym
import numpy as np


class Double(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 2), {}

    def step(self, action):
        return np.tanh(np.full(2, action[0])), float(action[0]), False, False, {}


gym.register("Double-v0", "double:Double", max_episode_steps=20)
"""


def test_actions_are_recorded_in_the_precision_of_their_space(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "double.py").write_text(DOUBLE)
    (home / "double.toml").write_text('env_id = "double:Double-v0"\n')
    monkeypatch.syspath_prepend(str(home))
    name = offbench.collect("./double.toml", "random", steps=100, workers=1)
    assert next(minari.load_dataset(name).iterate_episodes()).actions.dtype == np.float64
    assert offbench.verify(name, workers=1).ok
