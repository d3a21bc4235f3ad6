"""D4RL files come in and go out: every version of the format, and the same transitions as D4RL's own loader."""

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
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data import minari_store, transitions
from offbench.data.export import export
from offbench.data.import_d4rl import import_d4rl
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.verification.verify import verify
from tests.commands import refusal
from tests.made_datasets import episode, foreign

Columns = dict[str, npt.NDArray[Any]]
KEYS = ("observations", "actions", "rewards", "next_observations", "terminals")
OBS, ACT = 11, 3  # hopper's


def d4rl_file(path: Path, lengths: list[tuple[int, str]], version: int, rng: np.random.Generator) -> Columns:
    """Write a file as D4RL has it; `lengths` are (steps, how it ends: terminal, timeout, both or cut)."""
    rows = sum(steps for steps, _ in lengths)
    columns: Columns = {
        "observations": rng.normal(size=(rows, OBS)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, ACT)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "terminals": np.zeros(rows, bool),
    }
    timeouts, following = np.zeros(rows, bool), rng.normal(size=(rows, OBS)).astype(np.float32)
    last = -1
    for steps, how in lengths:
        first, last = last + 1, last + steps
        following[first:last] = columns["observations"][first + 1 : last + 1]
        columns["terminals"][last] = how in ("terminal", "both")
        timeouts[last] = how in ("timeout", "both")
    with h5py.File(path, "w") as file:
        if version == 0:  # a column of rewards, as some v0 files have it
            columns["rewards"] = columns["rewards"][:, None]
            columns["terminals"] = columns["terminals"][:, None]
        if version >= 1:
            columns["timeouts"] = timeouts
            file["infos/qpos"] = rng.normal(size=(rows, 6))
            file["infos/action_log_probs"] = rng.normal(size=rows)
        if version >= 2:
            columns["next_observations"] = following
            file["metadata/algorithm"] = np.bytes_("SAC")
            file["metadata/policy/fc0/weight"] = rng.normal(size=(4, 4))
            file["metadata/iteration"] = np.array(3)
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip")
    return {
        name: values[:, 0] if name in ("rewards", "terminals") and version == 0 else values
        for name, values in columns.items()
    }


def qlearning(file: Columns, limit: int = 1000) -> Columns:
    """What D4RL's loader makes of a file, from its description: row by row, slowly, with its own counting.

    A step at a timeout is skipped (by the flag, else every `limit` steps), the very last row is never read, and the
    next observation is always the row behind, which means nothing where the step terminates.
    """
    found: dict[str, list[Any]] = {key: [] for key in KEYS}
    steps = 0
    for row in range(len(file["rewards"]) - 1):
        at_limit = file["timeouts"][row] if "timeouts" in file else steps == limit - 1
        if at_limit:
            steps = 0
            continue
        for key in ("observations", "actions", "rewards", "terminals"):
            found[key].append(file[key][row])
        found["next_observations"].append(file["observations"][row + 1])
        steps = 0 if file["terminals"][row] else steps + 1
    return {key: np.array(values) for key, values in found.items()}


LENGTHS = [(40, "terminal"), (1000, "timeout"), (3, "terminal"), (1, "terminal"), (1000, "both"), (120, "terminal")]
TAILS: dict[str, list[tuple[int, str]]] = {
    "a cut": [(77, "cut")],
    "a termination": [(20, "terminal")],
    "a timeout": [(1000, "timeout")],
    "one step": [(1, "cut")],
}


@pytest.mark.parametrize("version", [0, 1, 2])
@pytest.mark.parametrize("tail", TAILS)
def test_transitions_are_those_of_d4rls_loader(version: int, tail: str, home: Path, rng: np.random.Generator) -> None:
    file = d4rl_file(home / f"hopper_medium-v{version}.hdf5", LENGTHS + TAILS[tail], version, rng)
    import_d4rl(home / f"hopper_medium-v{version}.hdf5", "theirs-v0")
    with np.load(export("theirs-v0", home / "out.npz", drop_timeouts=True), allow_pickle=False) as arrays:
        ours = dict(arrays)
    theirs = qlearning(file)
    if TAILS[tail][-1][1] == "terminal":  # the very last row, which their loop never reaches: a termination is kept
        theirs = {
            key: np.concatenate([rows, file.get(key, file["observations"])[-1:]]) for key, rows in theirs.items()
        }
    for key in KEYS[:3]:
        np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)
    np.testing.assert_array_equal(ours["terminals"], theirs["terminals"])
    goes_on = ~theirs["terminals"]
    np.testing.assert_array_equal(ours["next_observations"][goes_on], theirs["next_observations"][goes_on])
    assert {ours[key].dtype for key in KEYS[:4]} == {np.dtype(np.float32)}


@pytest.mark.parametrize("version", [0, 1, 2])
def test_nothing_bootstraps_over_a_gap(version: int, home: Path, rng: np.random.Generator) -> None:
    """In what offbench trains on: every next observation is the true one wherever it counts."""
    columns = d4rl_file(home / "hopper_mixed.hdf5", [*LENGTHS, (77, "cut")], version, rng)
    data = offbench.load(import_d4rl(home / "hopper_mixed.hdf5", "mixed-v0"))
    assert data.env_id == "Hopper-v5"
    where = {row.tobytes(): i for i, row in enumerate(columns["observations"])}
    for t in range(len(data)):
        i = where[np.asarray(data.observations[data.rows[t]]).tobytes()]
        np.testing.assert_array_equal(data.actions[t], columns["actions"][i])
        assert data.masks[t] == 1 - columns["terminals"][i]
        if data.masks[t]:
            true = columns["next_observations"][i] if version == 2 else columns["observations"][i + 1]
            np.testing.assert_array_equal(data.observations[data.rows[t] + 1], true)


def test_a_v2_file_keeps_every_row_and_v1_all_but_the_timeouts(home: Path, rng: np.random.Generator) -> None:
    rows = sum(steps for steps, _ in LENGTHS)
    for version, kept in ((1, rows - 1), (2, rows)):  # a step that is both is a termination that needs no next one
        d4rl_file(home / "walker2d_medium.hdf5", LENGTHS, version, rng)
        with pytest.raises(OffbenchError, match="give the right --env"):
            import_d4rl(home / "walker2d_medium.hdf5", f"x{version}-v0", env="walker2d")
        import_d4rl(home / "walker2d_medium.hdf5", f"x{version}-v0", env="hopper")
        assert minari_store.read_metadata(f"x{version}-v0")["total_steps"] == kept
        ours = minari_store.read_provenance(minari_store.read_metadata(f"x{version}-v0"))
        assert ours.timeouts == ("dropped" if version == 1 else "kept")
        assert ours.final_observations == ("repeated" if version == 1 else "kept")


def test_the_first_environment_is_on_record(home: Path, rng: np.random.Generator) -> None:
    d4rl_file(home / "hopper_medium-v2.hdf5", LENGTHS, 2, rng)
    main(["import-d4rl", "hopper_medium-v2.hdf5", "--id", "d4rl/hopper-medium-v2"])
    metadata = minari_store.read_metadata("d4rl/hopper-medium-v2")
    assert json.loads(metadata["env_spec"])["id"] == "Hopper-v2"
    assert json.loads(metadata["eval_env_spec"])["id"] == "Hopper-v5"
    ours = minari_store.read_provenance(metadata)
    assert ours.contact_margin == "max"
    assert ours.d4rl == (-20.272305, 3234.3)
    assert len(ours.imported["sha256"]) == 64
    assert "ref_min_score" not in metadata  # D4RL's constants are of another environment than it is evaluated in
    report = verify("d4rl/hopper-medium-v2", workers=1)
    assert report.ok, report.lines()
    assert any("cannot make its environment" in line for line in report.skipped)
    offbench.show("d4rl/hopper-medium-v2").lines()


def test_it_trains_and_is_scored_by_d4rls_constants(home: Path, rng: np.random.Generator) -> None:
    d4rl_file(home / "hopper_medium-v2.hdf5", LENGTHS, 2, rng)
    import_d4rl(home / "hopper_medium-v2.hdf5", "theirs-v2")
    offbench.train("td3_bc", "theirs-v2", steps=20, eval_every=10, eval_episodes=1, hidden=(8,), batch_size=4)
    (row,) = offbench.normalize()
    assert row["score"] is None
    assert row["d4rl_score"] is not None


def test_an_environment_that_fits_no_more_is_left_out(home: Path, rng: np.random.Generator) -> None:
    """Ant-v2 had 111 observations, Ant-v5 has 105."""
    with h5py.File(home / "ant_random.hdf5", "w") as file:
        file["observations"] = rng.normal(size=(50, 111)).astype(np.float32)
        file["actions"] = rng.uniform(-1, 1, (50, 8)).astype(np.float32)
        file["rewards"], file["terminals"] = np.zeros(50, np.float32), np.zeros(50, bool)
    metadata = minari_store.read_metadata(import_d4rl(home / "ant_random.hdf5", "ant-v0"))
    assert json.loads(metadata["env_spec"])["id"] == "Ant-v2"
    assert "eval_env_spec" not in metadata
    assert offbench.load("ant-v0").observations.shape == (50, 111)


def test_rows_that_do_not_go_on_are_cut(home: Path, rng: np.random.Generator) -> None:
    """A boundary that no flag tells of: next_observations do."""
    columns = d4rl_file(home / "hopper_full_replay-v2.hdf5", [(30, "cut"), (20, "timeout")], 2, rng)
    import_d4rl(home / "hopper_full_replay-v2.hdf5", "cut-v0")
    episodes = list(episodes_of(open_minari("cut-v0")))
    assert [len(e) for e in episodes] == [30, 20]
    assert episodes[0].truncations[-1]
    np.testing.assert_array_equal(episodes[0].observations[-1], columns["next_observations"][29])


@pytest.mark.parametrize("level", ["medium", "medium-expert", "medium-replay"])
def test_a_dataset_comes_back_the_same(level: str, tiny: tuple[str, str], home: Path) -> None:
    """Content, seeds, spaces, references and provenance; and `verify` still plays it again bit for bit."""
    name = offbench.collect(tiny[0], level, behaviour_dir=tiny[1], workers=1)
    main(["export", name, "--out", "out.hdf5"])
    main(["import-d4rl", "out.hdf5", "--id", "back-v0"])
    ours, back = minari_store.read_metadata(name), minari_store.read_metadata("back-v0")
    assert minari_store.read_provenance(back).content_sha256 == minari_store.read_provenance(ours).content_sha256
    assert minari_store.read_provenance(back).imported["file"] == "out.hdf5"
    same = ["env_spec", "eval_env_spec", "observation_space", "action_space", "ref_min_score", "ref_max_score"]
    same += ["author", "requirements", "algorithm_name", "total_steps", "total_episodes", "num_episodes_average_score"]
    assert {key: back[key] for key in same} == {key: ours[key] for key in same}
    seeds = [[e.seed for e in episodes_of(open_minari(x))] for x in (name, "back-v0")]
    assert seeds[0] == seeds[1]
    report = verify("back-v0", workers=1)
    assert report.ok, report.lines()
    assert any("played again" in line for line in report.checked)


def test_the_references_of_another_environment_are_left_out(
    medium: str, tiny: tuple[str, str], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(medium, "out.hdf5")
    recipe = home / "mine.toml"
    recipe.write_text(Path(tiny[0]).read_text())
    import_d4rl("out.hdf5", "same-v0", env=str(recipe))
    assert minari_store.read_metadata("same-v0")["ref_max_score"] > 0
    recipe.write_text('contact_margin = "sum"\n' + Path(tiny[0]).read_text())
    import_d4rl("out.hdf5", "other-v0", env=str(recipe))
    assert "--env names another environment than out.hdf5 does" in capsys.readouterr().err
    metadata = minari_store.read_metadata("other-v0")
    assert not {"ref_min_score", "ref_max_score"} & metadata.keys()
    assert minari_store.read_provenance(metadata).contact_margin == "sum"
    assert not minari_store.read_provenance(metadata).references


def test_npz_holds_what_offbench_trains_on(medium: str, home: Path) -> None:
    main(["export", medium, "--out", "arrays.npz"])
    with np.load(home / "arrays.npz", allow_pickle=False) as file:
        arrays = dict(file)
    data = offbench.load(medium)
    np.testing.assert_array_equal(arrays["observations"], data.observations[data.rows])
    np.testing.assert_array_equal(arrays["next_observations"], data.observations[data.rows + 1])
    np.testing.assert_array_equal(arrays["rewards"], data.rewards)
    np.testing.assert_array_equal(1 - arrays["terminals"], data.masks)
    np.testing.assert_allclose(arrays["actions"] / 3, data.actions, atol=1e-7)  # bounds of 3
    assert arrays["timeouts"].sum() == 1


def test_blocks_join_right(medium: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small blocks on both ways: episodes lie across them."""
    monkeypatch.setattr("offbench.data.export.CHUNK", 37)
    monkeypatch.setattr("offbench.data.import_d4rl.BLOCK", 41)
    import_d4rl(export(medium, home / "out.hdf5"), "back-v0")
    assert transitions.load("back-v0").content_sha256 == transitions.load(medium).content_sha256


def test_a_failed_export_leaves_the_old_file(medium: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "out.hdf5").write_text("old")

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("offbench.data.export.os.replace", fail)
    with pytest.raises(OffbenchError, match="No space left"):
        export(medium, home / "out.hdf5")
    assert (home / "out.hdf5").read_text() == "old"
    assert not list(home.glob(".out*"))


def spoil(path: Path, kind: str) -> None:
    with h5py.File(path, "a") as file:
        rows = len(file["rewards"])
        if kind == "nan":
            file["observations"][5, 2] = np.nan
        elif kind == "no actions":
            del file["actions"]
        elif kind == "lengths":
            del file["actions"]
            file["actions"] = np.zeros((rows - 1, ACT), np.float32)
        elif kind == "text":
            del file["rewards"]
            file["rewards"] = np.array([b"a"] * rows)
        elif kind == "group":
            del file["rewards"]
            file.create_group("rewards")
        elif kind == "one dimension":
            del file["observations"]
            file["observations"] = np.zeros(rows, np.float32)
        elif kind == "empty":
            for key in ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations"):
                shape = (0, *file[key].shape[1:])
                del file[key]
                file[key] = np.zeros(shape)
        elif kind == "another file":
            del file["rewards"]
            file["rewards"] = h5py.ExternalLink("/etc/hostname", "rewards")
        elif kind == "a raw file outside":
            del file["rewards"]
            file.create_dataset("rewards", (rows,), np.float32, external=[("/etc/hostname", 0, h5py.h5f.UNLIMITED)])
        elif kind == "huge":
            for key in ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations"):
                shape = (10**10, *file[key].shape[1:])
                del file[key]
                file.create_dataset(key, shape, np.float32, chunks=True)
        elif kind == "next":
            del file["next_observations"]
            file["next_observations"] = np.zeros((rows, OBS - 1), np.float32)
        else:
            file.attrs["offbench"] = kind


SPOILED = {
    "nan": "NaN or infinite",
    "no actions": "it has no actions",
    "lengths": "actions (49, 3) float32 does not fit 50 rows",
    "text": "does not fit",
    "group": "rewards is not data of this file",
    "one dimension": "are not rows of numbers",
    "empty": "are not rows of numbers",
    "another file": "rewards is not data of this file",
    "a raw file outside": "rewards is not data of this file",
    "huge": "more than the file can contain",
    "next": "differ from observations",
    "{": "metadata is damaged",
    "5": "metadata is damaged",
    "[]": "",  # no metadata of ours in it, and nothing that harms: it is imported
    '{"env_spec": 5}': "metadata is damaged",
    '{"env_spec": "{}"}': "metadata is damaged",
    '{"offbench": []}': "metadata is damaged",
    '{"author": 5}': "metadata is damaged",
    '{"ref_min_score": NaN}': "metadata is damaged",
    '{"observation_space": "{}", "action_space": "{}"}': "metadata is damaged",
    "[" * 5000: "metadata is damaged",
}


@pytest.mark.parametrize("kind", SPOILED, ids=lambda kind: kind[:30])
def test_spoiled_files_are_one_clear_line(
    kind: str, home: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    path = home / "hopper_medium-v2.hdf5"
    d4rl_file(path, [(30, "terminal"), (20, "timeout")], 2, rng)
    spoil(path, kind)
    if kind == "[]":
        assert import_d4rl(path, "spoiled-v0") in minari_store.local_ids()
        return
    line = refusal(["import-d4rl", str(path), "--id", "spoiled-v0"], capsys)
    assert any(part in line for part in SPOILED[kind].split("|")), line
    assert minari_store.local_ids() == []


def test_an_exported_file_that_was_changed_is_refused(
    medium: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It carries the content hash of the dataset."""
    export(medium, home / "out.hdf5")
    with h5py.File(home / "out.hdf5", "a") as file:
        file["rewards"][7] += 1e-9
    assert "not those that were exported" in refusal(["import-d4rl", "out.hdf5", "--id", "back-v0"], capsys)
    assert minari_store.local_ids() == [medium]


def test_metadata_in_a_file_run_no_code(medium: str, home: Path) -> None:
    """An env_spec that names os.system is kept as text and refused when somebody wants to play in it."""
    export(medium, home / "evil.hdf5")
    with h5py.File(home / "evil.hdf5", "a") as file:
        about = json.loads(file.attrs["offbench"])
        spec = json.loads(about["env_spec"]) | {
            "entry_point": "os:system",
            "id": "Evil-v0",
            "kwargs": {"command": "touch PWNED"},
        }
        file.attrs["offbench"] = json.dumps(about | {"env_spec": json.dumps(spec), "eval_env_spec": json.dumps(spec)})
    import_d4rl(home / "evil.hdf5", "evil-v0")
    with pytest.raises(OffbenchError, match=r"os:system.*--trust"):
        offbench.train("td3_bc", "evil-v0", steps=10, hidden=(8,))
    assert not verify("evil-v0", workers=1).findings
    assert not (home / "PWNED").exists()


def test_spaces_of_another_kind_are_refused() -> None:
    discrete = {"actions": np.zeros(3, np.int64)}
    foreign("discrete-v0", [episode(3, 0, True, **discrete)], actions=gym.spaces.Discrete(2))
    with pytest.raises(OffbenchError, match="must be a Box space"):
        export("discrete-v0", "out.hdf5")
