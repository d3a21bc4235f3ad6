"""D4RL files unlike the newest: no timeouts, mixed precisions, other environments, no transition."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import numpy.typing as npt
import pytest

import offbench
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.data.export import export
from offbench.data.import_d4rl import import_d4rl
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.verification.verify import verify
from tests.data.test_import_and_export import ACT, LENGTHS, OBS, Columns, d4rl_file, qlearning
from tests.made_datasets import episode, foreign


def lengths(name: str) -> list[int]:
    return [len(e) for e in episodes_of(open_minari(name))]


def write(path: Path, **columns: npt.NDArray[Any]) -> None:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values


def still(rows: int, rng: np.random.Generator) -> Columns:
    """Columns for a pendulum: rows, one after the other, nowhere near a first observation."""
    return {
        "observations": 1 + rng.normal(size=(rows, 4)).astype(np.float32),
        "actions": rng.uniform(-3, 3, (rows, 1)).astype(np.float32),
        "rewards": np.ones(rows, np.float32),
        "terminals": np.zeros(rows, bool),
    }


def test_a_file_without_timeouts_is_cut_at_its_environments_limit(home: Path, rng: np.random.Generator) -> None:
    (home / "p300.toml").write_text('env_id = "InvertedPendulum-v5"\n[env_kwargs]\nmax_episode_steps = 300\n')
    columns = still(1500, rng)
    columns["terminals"][449] = True  # the limit counts from there on
    write(home / "local.hdf5", **columns)
    import_d4rl(home / "local.hdf5", "p-v0", env="p300.toml")
    assert lengths("p-v0") == [299, 150, 299, 299, 299, 149]  # of 300, 150, 300, 300, 300, 150 rows
    theirs = qlearning(columns, limit=300)
    with np.load(export("p-v0", home / "out.npz", drop_timeouts=True), allow_pickle=False) as ours:
        np.testing.assert_array_equal(ours["observations"], theirs["observations"])


def test_without_a_limit_or_timeouts_nothing_can_be_cut(
    home: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("offbench.data.import_d4rl.time_limit", lambda _: None)
    columns = still(50, rng)
    write(home / "local.hdf5", **columns)
    with pytest.raises(OffbenchError, match=r"no timeouts.*column timeouts"):
        import_d4rl(home / "local.hdf5", "p-v0", env="inverted-pendulum")
    write(home / "local.hdf5", **columns, next_observations=np.roll(columns["observations"], -1, 0))
    import_d4rl(home / "local.hdf5", "p-v0", env="inverted-pendulum")  # these tell where episodes end
    assert lengths("p-v0") == [50]


@pytest.mark.parametrize("name", ["terminals", "timeouts"])
@pytest.mark.parametrize(("flag", "right"), [(0.5, False), (2, False), (np.nan, False), (1.0, True)])
def test_flags_are_zeros_and_ones(name: str, flag: float, right: bool, home: Path, rng: np.random.Generator) -> None:
    columns = still(20, rng) | {"terminals": np.zeros(20), "timeouts": np.zeros(20)}
    columns[name][9] = flag
    write(home / "local.hdf5", **columns)
    if right:
        import_d4rl(home / "local.hdf5", "p-v0", env="inverted-pendulum")
        assert lengths("p-v0") == [10 if name == "terminals" else 9, 9]  # no next observation at a cut
    else:
        with pytest.raises(OffbenchError, match=f"{name} contain (values other than 0 and 1|NaN)"):
            import_d4rl(home / "local.hdf5", "p-v0", env="inverted-pendulum")


@pytest.mark.parametrize("kinds", [("<f4", "<f8"), ("<f8", "<f4"), ("<f8", "<f2"), (">f4", "<f8")])
def test_next_observations_are_compared_in_one_precision(
    kinds: tuple[str, str], home: Path, rng: np.random.Generator
) -> None:
    walk = np.cumsum(rng.normal(0, 0.01, (3, 101, OBS)), 1)
    write(
        home / "hopper_medium-v2.hdf5",
        observations=walk[:, :-1].reshape(300, OBS).astype(kinds[0]),
        next_observations=walk[:, 1:].reshape(300, OBS).astype(kinds[1]),
        actions=rng.uniform(-1, 1, (300, ACT)).astype(np.float32),
        rewards=rng.normal(size=300),
        terminals=np.zeros(300, bool),
        timeouts=np.arange(300) % 100 == 99,
    )
    import_d4rl(home / "hopper_medium-v2.hdf5", "mixed-v0")
    assert lengths("mixed-v0") == [100, 100, 100]


def test_an_import_that_breaks_most_rows_says_so(
    home: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rounded in one column only: no row is the next observation of the row before."""
    columns = d4rl_file(home / "hopper_medium-v2.hdf5", [(60, "terminal"), (40, "timeout")], 2, rng)
    import_d4rl(home / "hopper_medium-v2.hdf5", "sound-v0")
    assert "warning" not in capsys.readouterr().err
    columns["next_observations"] = columns["next_observations"].round(3)
    write(home / "hopper_medium-v2.hdf5", **columns)
    import_d4rl(home / "hopper_medium-v2.hdf5", "broken-v0")
    assert (
        "warning: hopper_medium-v2.hdf5: the next_observations of 98 of 100 rows"
        in capsys.readouterr().err.replace(f"{home}/", "")
    )
    assert len(lengths("broken-v0")) == 100


def test_v0_files_that_begin_in_mid_episode_are_cut_where_episodes_begin(
    home: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """As D4RL's halfcheetah v0 files are: 999 rows of each episode, and no flag at all."""
    env = gym.make("HalfCheetah-v5")
    columns: dict[str, list[Any]] = {name: [] for name in ("observations", "actions", "rewards", "terminals")}
    starts = []
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        rows = []
        for _ in range(999):
            action = rng.uniform(-1, 1, 6).astype(np.float32)
            rows.append((observation, action, 0.0, False))
            observation = env.step(action)[0]
        rows = rows[600:] if seed == 0 else rows
        starts.append(len(columns["rewards"]))
        for row in rows:
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
    write(home / "halfcheetah_random.hdf5", **{name: np.array(rows) for name, rows in columns.items()})
    import_d4rl(home / "halfcheetah_random.hdf5", "theirs-v0")
    assert starts == [0, 399, 1398, 2397]
    assert lengths("theirs-v0") == [398, 998, 998, 998]  # the last row of each has no next observation
    assert "has 3 resets within" in capsys.readouterr().err
    true = np.array(columns["observations"])
    first = [e.observations[0] for e in episodes_of(open_minari("theirs-v0"))]
    np.testing.assert_array_equal(first, true[starts])


def test_what_a_file_says_of_its_environment(home: Path, rng: np.random.Generator) -> None:
    """Hopper-v2 is known of D4RL's own files alone; else the user's word counts."""
    (home / "v4.toml").write_text('env_id = "Hopper-v5"\n[env_kwargs]\nmax_episode_steps = 500\n')
    for name, env, recorded in (("hopper_medium-v2", None, "Hopper-v2"), ("mine", "v4.toml", "Hopper-v5")):
        d4rl_file(home / f"{name}.hdf5", LENGTHS, 2, rng)
        import_d4rl(home / f"{name}.hdf5", f"{name}-v0", env=env)
        metadata = minari_store.read_metadata(f"{name}-v0")
        assert json.loads(metadata["env_spec"])["id"] == recorded
        assert json.loads(metadata["eval_env_spec"])["id"] == "Hopper-v5"
        ours = minari_store.read_provenance(metadata)
        assert ours.d4rl == ((-20.272305, 3234.3) if env is None else None)  # 500 steps are another task


def test_an_environment_guessed_from_a_name_must_fit(home: Path, rng: np.random.Generator) -> None:
    columns = still(50, rng)
    write(home / "hopper_medium-v2.hdf5", **columns)
    with pytest.raises(OffbenchError, match=r"named like.*11 observations and 3 actions, but has 4 .* and 1 .*--env"):
        import_d4rl(home / "hopper_medium-v2.hdf5", "x-v0")
    assert minari_store.local_ids() == []


@pytest.mark.parametrize("complete", [True, False])
def test_a_file_without_one_whole_transition_is_refused(complete: bool, home: Path, rng: np.random.Generator) -> None:
    columns = still(50, rng)
    write(home / "p.hdf5", **columns, timeouts=np.ones(50, bool), **({"infos/seed": np.ones(50)} if complete else {}))
    with pytest.raises(OffbenchError, match="none of its 50 rows has a next observation"):
        import_d4rl(home / "p.hdf5", "empty-v0", env="inverted-pendulum")
    assert minari_store.local_ids() == []


@pytest.mark.parametrize(
    "seeds", [[2**64 - 1, 2**63, 5], [2**64 - 1, None, 0], [2**63 - 1, None, 0], [None, None, None]], ids=str
)
def test_seeds_of_64_bits_travel(seeds: list[int | None], home: Path) -> None:
    """Minari's DataCollector draws them: half of them do not fit int64."""
    foreign("wide-v0", [episode(3, 10 * i, True, seed=seed) for i, seed in enumerate(seeds)])
    export("wide-v0", home / "wide.hdf5")
    export("wide-v0", home / "wide.npz")
    import_d4rl(home / "wide.hdf5", "back-v0")
    assert [e.seed for e in episodes_of(open_minari("back-v0"))] == seeds


def test_numbers_in_another_byte_order(home: Path, rng: np.random.Generator) -> None:
    columns = still(600, rng)
    columns["timeouts"] = np.arange(600) % 200 == 199
    swapped = {name: values.astype(values.dtype.newbyteorder(">")) for name, values in columns.items()}
    for name, kind in (("little", columns), ("big", swapped)):
        write(home / f"{name}.hdf5", **kind)
        import_d4rl(home / f"{name}.hdf5", f"{name}-v0", env="inverted-pendulum")
    hashes = {
        minari_store.read_provenance(minari_store.read_metadata(f"{n}-v0")).content_sha256 for n in ("little", "big")
    }
    assert len(hashes) == 1
    assert not any("dtype" in line for line in verify("big-v0", episodes=0).lines())


def test_an_environment_that_fails_is_not_a_damaged_file(
    home: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: object) -> None:
        raise RuntimeError("no robot")

    monkeypatch.setattr("gymnasium.envs.mujoco.inverted_pendulum_v5.InvertedPendulumEnv.reset_model", failing)
    write(home / "local.hdf5", **still(600, rng))
    with pytest.raises(OffbenchError, match=r"InvertedPendulum-v5.* failed: .*no robot"):
        import_d4rl(home / "local.hdf5", "local-v0", env="inverted-pendulum")


def test_a_dataset_without_an_environment_comes_back_the_same(home: Path) -> None:
    foreign("house-v0", [episode(3, 0, True), episode(5, 10, False)])
    import_d4rl(export("house-v0", home / "house.hdf5"), "back-v0")
    metadata = minari_store.read_metadata("back-v0")
    assert metadata.get("env_spec") is None
    assert offbench.load("back-v0").content_sha256 == offbench.load("house-v0").content_sha256
    assert metadata["action_space"] == minari_store.read_metadata("house-v0")["action_space"]


def test_an_empty_dataset_is_not_exported(home: Path) -> None:
    foreign("empty-v0", [episode(3, 0, True)])
    with h5py.File(minari_store.path_of("empty-v0") / "data" / "main_data.hdf5", "a") as file:
        del file["episode_0"]
    path = minari_store.path_of("empty-v0") / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"total_episodes": 0, "total_steps": 0}))
    with pytest.raises(OffbenchError, match="no transitions"):
        export("empty-v0", home / "empty.hdf5")
    assert not (home / "empty.hdf5").exists()
    assert {finding.code for finding in verify("empty-v0", workers=1).findings} == {"empty"}
    with pytest.raises(OffbenchError, match="no episodes"):
        offbench.show("empty-v0")


def test_an_export_of_episodes_of_several_types_keeps_every_number(home: Path) -> None:
    """Whole rewards in the first 17,000 steps, more than one block, and fractions later."""
    whole = episode(17_000, 0, False, rewards=np.zeros(17_000, np.int64))
    whole["observations"] = whole["observations"].astype(np.float32)
    fractions = episode(100, 0.1, True, rewards=np.full(100, 0.9))
    name = foreign("mixed-v0", [whole, fractions, whole])
    offbench.export(name, home / "mixed.hdf5")
    with h5py.File(home / "mixed.hdf5") as file:
        assert set(file) == {
            "observations",
            "actions",
            "rewards",
            "terminals",
            "timeouts",
            "next_observations",
            "infos",
        }
        assert file["rewards"][:].tolist() == [0.0] * 17_000 + [0.9] * 100 + [0.0] * 17_000
        np.testing.assert_array_equal(file["observations"][17_000:17_100], fractions["observations"][:-1])
        np.testing.assert_array_equal(file["observations"][:17_000], whole["observations"][:-1])
    offbench.import_d4rl(home / "mixed.hdf5", "back-v0")
    for column in ("observations", "rewards", "returns", "ends"):
        np.testing.assert_array_equal(getattr(offbench.load("back-v0"), column), getattr(offbench.load(name), column))


def test_an_export_flags_the_ends_of_episodes_without_flags(home: Path) -> None:
    unflagged = [episode(10, start, False, truncations=np.zeros(10, bool)) for start in (0, 100)]
    name = foreign("unflagged-v0", [*unflagged, episode(5, 200, True)])
    offbench.export(name, home / "out.hdf5")
    offbench.export(name, home / "out.npz")
    with h5py.File(home / "out.hdf5") as file, np.load(home / "out.npz") as arrays:
        for columns in (file, arrays):
            assert np.flatnonzero(columns["timeouts"][:]).tolist() == [9, 19]
            assert np.flatnonzero(columns["terminals"][:]).tolist() == [24]


@pytest.mark.parametrize("name", ["observations", "actions"])
def test_whole_numbers_that_no_algorithm_takes_are_refused_at_once(
    name: str, home: Path, rng: np.random.Generator
) -> None:
    columns = d4rl_file(home / "hopper_medium-v2.hdf5", [(60, "terminal")], 2, rng)
    write(home / "hopper_medium-v2.hdf5", **columns | {name: columns[name].astype(np.int64)})
    with pytest.raises(OffbenchError, match=f"{name} are int64; convert them to float32"):
        import_d4rl(home / "hopper_medium-v2.hdf5", "whole-v0")
