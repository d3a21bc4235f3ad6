"""From episodes to transitions: T + 1 rows, truncation bootstraps, termination does not."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

import offbench
from offbench.common.errors import OffbenchError
from offbench.data import minari_store, transitions
from tests.made_datasets import episode, foreign

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import minari


@pytest.mark.parametrize(
    "call", [offbench.load, offbench.show, offbench.verify, lambda name: offbench.train("bc", name)]
)
def test_a_dataset_is_named_by_its_id(call: Callable[[Any], object]) -> None:
    name = foreign("named-v0", [episode(3, 0, True)])
    for wrong in (minari.load_dataset(name), Path(name)):
        with pytest.raises(OffbenchError, match="a dataset is named by its id, such as 'hopper-medium-v0'"):
            call(wrong)


def test_rows_point_at_each_transitions_observation() -> None:
    data = offbench.load(foreign("rows-v0", [episode(3, 0, True), episode(2, 100, False)]))
    assert len(data) == 5
    np.testing.assert_array_equal(data.rows, [0, 1, 2, 4, 5])
    np.testing.assert_array_equal(data.observations[data.rows][:, 0], [0, 2, 4, 100, 102])
    np.testing.assert_array_equal(data.observations[data.rows + 1][:, 0], [2, 4, 6, 102, 104])
    np.testing.assert_array_equal(data.rewards, [0, 1, 2, 100, 101])
    np.testing.assert_array_equal(data.ends, [3, 5])
    np.testing.assert_array_equal(data.returns, [3, 201])


def test_termination_masks_and_truncation_does_not() -> None:
    data = offbench.load(foreign("masks-v0", [episode(3, 0, True), episode(2, 100, False)]))
    np.testing.assert_array_equal(data.masks, [1, 1, 0, 1, 1])


def test_actions_are_scaled_by_the_action_space() -> None:
    actions = np.array([[-2.0, 0.0], [0.0, 5.0], [2.0, 10.0]], np.float32)
    data = offbench.load(foreign("scale-v0", [episode(3, 0, True, actions=actions)]))
    np.testing.assert_allclose(data.actions, [[-1, -1], [0, 0], [1, 1]])


def test_actions_out_of_bounds_are_clipped_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    actions = np.array([[-3.0, 0.0], [0.0, 5.0]], np.float32)
    data = offbench.load(foreign("clip-v0", [episode(2, 0, True, actions=actions)]))
    assert data.actions.min() == -1
    assert "1 actions out of bounds" in capsys.readouterr().err


def test_the_normaliser_sees_transitions_alone(medium: str) -> None:
    """std + 1e-3 over the observations that have an action, as TD3+BC's authors compute it."""
    data = offbench.load(medium)
    episodes = minari.load_dataset(medium).iterate_episodes()
    states = np.concatenate([e.observations[:-1] for e in episodes]).astype(np.float32)
    mean, std = data.normalizer()
    np.testing.assert_allclose(mean, states.astype(np.float64).mean(0), atol=1e-6)
    np.testing.assert_allclose(std, states.astype(np.float64).std(0) + 1e-3, rtol=1e-5)


def test_the_second_load_maps_the_cache(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first = offbench.load(medium)
    monkeypatch.setattr(transitions, "_convert", None)  # would fail if it were called
    second = offbench.load(medium)
    assert isinstance(second.observations, np.memmap)
    np.testing.assert_array_equal(first.observations, second.observations)


def test_a_changed_dataset_is_converted_anew(tiny: tuple[str, str], medium: str) -> None:
    recipe, behaviour_dir = tiny
    before = offbench.load(medium).content_sha256
    offbench.collect(recipe, "medium", behaviour_dir=behaviour_dir, workers=1, seed=9, overwrite=True)
    assert offbench.load(medium).content_sha256 != before


BAD = {
    "inf": ([episode(3, np.inf, True)], "observations contain NaN or infinite"),
    "no-next": ([episode(3, 0, True, observations=np.zeros((3, 2)))], r"shape \(3, 2\), expected \(4, 2\)"),
    "width": ([episode(3, 0, True, actions=np.zeros((3, 1), np.float32))], r"shape \(3, 1\), expected \(3, 2\)"),
}


def planted(name: str, rows: str, values: Any) -> str:
    """Put rows of another kind into a dataset's first episode, of three steps."""
    foreign(name, [episode(3, 0, True)])
    with h5py.File(minari_store.path_of(name) / "data" / "main_data.hdf5", "a") as file:
        del file[f"episode_0/{rows}"]
        file[f"episode_0/{rows}"] = values
    return name


@pytest.mark.parametrize(
    ("rows", "values", "message"),
    [
        ("terminations", np.array([0, 0, 0.5]), "terminations contain values other than 0 and 1"),
        ("terminations", np.array([0, 0, 7]), "terminations contain values other than 0 and 1"),
        ("terminations", np.array([0, 0, np.nan]), "terminations contain NaN"),
        ("rewards", np.zeros(3, complex), "rewards are complex128, not numbers"),
        ("rewards", np.zeros(3, [("a", float)]), "rewards are .*, not numbers"),
        ("rewards", np.array([b"a", b"b", b"c"]), r"rewards are .*, not numbers"),
        ("rewards", np.zeros((3, 1)), r"shape \(3, 1\), expected|do not fit"),
        ("rewards", np.array([0, np.nan, 1]), "rewards contain NaN"),
    ],
)
def test_rows_of_another_kind_are_neither_trained_on_nor_exported(
    rows: str, values: Any, message: str, home: Path
) -> None:
    name = planted("kinds-v0", rows, values)
    with pytest.raises(OffbenchError, match=message):
        offbench.load(name)
    for file in ("out.hdf5", "out.npz"):
        with pytest.raises(OffbenchError, match=message):
            offbench.export(name, file)
        assert not (home / file).exists()


@pytest.mark.parametrize("kind", [np.int8, np.float32, np.uint8])
def test_flags_that_are_numbers_count_as_flags(kind: Any) -> None:
    name = planted("numbers-v0", "terminations", np.array([0, 0, 1], kind))
    np.testing.assert_array_equal(offbench.load(name).masks, [1, 1, 0])
    with np.load(offbench.export(name, "out.npz")) as arrays:
        np.testing.assert_array_equal(arrays["terminals"], [False, False, True])


def test_an_export_does_not_round_numbers_to_infinity(home: Path) -> None:
    foreign("large-v0", [episode(3, 0, True, rewards=np.array([0, 1e39, 0]))])
    with pytest.raises(OffbenchError, match=r"rewards reach 1e\+39, beyond float32"):
        offbench.export("large-v0", "out.npz")
    offbench.export("large-v0", "out.hdf5")
    with h5py.File(home / "out.hdf5") as file:
        assert file["rewards"][1] == 1e39  # of the same precision as the dataset


@pytest.mark.parametrize("kind", BAD)
def test_bad_data_are_refused(kind: str) -> None:
    episodes, message = BAD[kind]
    name = foreign(f"{kind}-v0", episodes)
    with pytest.raises(OffbenchError, match=message):
        offbench.load(name)
    assert not list(transitions.cache().glob("*/meta.json"))


def test_other_spaces_are_refused() -> None:
    discrete = {"actions": np.zeros(3, np.int64)}
    name = foreign("discrete-v0", [episode(3, 0, True, **discrete)], actions=gym.spaces.Discrete(2))
    with pytest.raises(OffbenchError, match="actions must be a Box space, not Discrete"):
        offbench.load(name)
    unbounded = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    name = foreign("unbounded-v0", [episode(3, 0, True)], actions=unbounded)
    with pytest.raises(OffbenchError, match="must be bounded"):
        offbench.load(name)


@pytest.mark.parametrize("fault", ["empty", "truncated", "no episodes", "metadata"])
def test_damaged_files_are_a_clear_error(medium: str, fault: str) -> None:
    folder = minari_store.path_of(medium) / "data"
    file = folder / "main_data.hdf5"
    if fault == "empty":
        file.write_bytes(b"")
    elif fault == "truncated":
        file.write_bytes(file.read_bytes()[:3000])
    elif fault == "no episodes":
        with h5py.File(file, "a") as data:
            del data["episode_1"]
    else:
        (folder / "metadata.json").write_text("{")
    with pytest.raises(OffbenchError, match=r"damaged|cannot be read"):
        offbench.load(medium)


def test_a_dataset_without_references_trains_and_scores_nothing(home: Path) -> None:
    name = foreign("plain-v0", [episode(40, 0, True), episode(30, 5, False)])
    (folder,) = offbench.train("td3_bc", name, steps=20, eval_every=10, hidden=(8,), batch_size=4)
    assert (folder / "policy.safetensors").exists()
    assert not (folder / "evaluations.csv").read_text().splitlines()[1:]


@pytest.mark.parametrize("column", ["observations", "rewards"])
@pytest.mark.parametrize("value", [1e60, -1e39, 2**70])
def test_numbers_beyond_float32_are_called_that(column: str, value: float, recwarn: pytest.WarningsRecorder) -> None:
    sound = episode(3, 0, True)
    large = sound[column].copy()
    large[1] = value
    foreign("large-v0", [sound | {column: large}])
    if abs(value) < 3e38:
        data = offbench.load("large-v0")
        column_of = {"observations": data.observations[1, 0], "rewards": data.rewards[1]}
        assert column_of[column] == np.float32(value)
        return
    with pytest.raises(OffbenchError, match=rf"{column} reach .*beyond float32's 3.4e\+38; scale them") as error:
        offbench.load("large-v0")
    assert "NaN" not in str(error.value)
    assert not [warning for warning in recwarn if "overflow" in str(warning.message)]


@pytest.mark.parametrize(("bound", "warned"), [(1e5, True), (4.0, False)])
def test_bounds_far_beyond_the_actions_are_said(
    bound: float, warned: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    actions = np.linspace(-3, 3, 6, dtype=np.float32).reshape(3, 2)
    space = gym.spaces.Box(-bound, bound, (2,), np.float32)
    offbench.load(foreign("wide-v0", [episode(3, 0, True, actions=actions)], actions=space))
    assert ("correct the action space" in capsys.readouterr().err) == warned
