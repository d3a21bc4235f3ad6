"""`verify` passes what is sound and names every planted fault, also where the content hash was made to fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.data import minari_store
from offbench.data.content_hash import ContentHash
from offbench.data.levels import LEVELS
from offbench.data.minari_reader import episodes_of, open_minari
from offbench.envs.environments import env_spec
from offbench.verification.findings import FAULTS, Finding, Report
from offbench.verification.verify import verify
from tests.made_datasets import episode, foreign

Edit = Callable[[h5py.File], object]


def codes(name: str, **kwargs: Any) -> set[str]:
    """Verify a dataset in this process; return the codes of what was found."""
    report = verify(name, workers=1, **kwargs)
    assert report.ok == (not report.findings)
    return {finding.code for finding in report.findings}


def metadata_path(name: str) -> Path:
    return minari_store.path_of(name) / "data" / "metadata.json"


def change_metadata(name: str, **changes: Any) -> None:
    """Change metadata; the keys that are offbench's go below its own key."""
    metadata = json.loads(metadata_path(name).read_text())
    ours = {key: value for key, value in changes.items() if key in metadata.get("offbench", {})}
    rest = {key: value for key, value in changes.items() if key not in ours}
    metadata_path(name).write_text(json.dumps(metadata | rest | {"offbench": metadata["offbench"] | ours}))


def tamper(name: str, edit: Edit) -> str:
    """Edit a dataset's HDF5 file, then make the content hash fit, so that it is not the hash that tells."""
    with h5py.File(minari_store.path_of(name) / "data" / "main_data.hdf5", "a") as file:
        edit(file)
        change_metadata(name, total_episodes=len(file))
    content, steps = ContentHash(), 0
    for e in episodes_of(open_minari(name)):
        content.add(e.observations, e.actions, e.rewards, e.terminations, e.truncations)
        steps += len(e)
    change_metadata(name, content_sha256=content.hexdigest(), total_steps=steps)
    return name


def each(file: h5py.File) -> Iterator[h5py.Group]:
    yield from (file[f"episode_{i}"] for i in range(len(file)))


def replace(group: h5py.Group, key: str, value: Any) -> None:
    del group[key]
    group[key] = value


@pytest.fixture
def hopper() -> str:
    """A small hopper dataset: five or so whole episodes and a cut one."""
    return offbench.collect("hopper", "medium", steps=2000, workers=1)


@pytest.mark.parametrize("level", [*LEVELS, "0.6", "mix"])
def test_every_level_passes(level: str, tiny: tuple[str, str]) -> None:
    blend = {"mix": "random:0.25,expert:0.75"} if level == "mix" else {"level": level}
    name = offbench.collect(tiny[0], behaviour_dir=tiny[1], workers=1, accept=True, **blend)
    report = verify(name, workers=1)
    assert not report.findings, report.lines()
    assert not report.skipped
    assert not report.warnings
    way = "one step at a time" if level == "medium-replay" else "from their seeds, bit for bit"
    assert any(way in line for line in report.checked)


@pytest.mark.parametrize("level", ["medium-expert", "random"])
def test_the_shipped_agents_levels_pass(level: str) -> None:
    assert codes(offbench.collect("inverted-pendulum", level, steps=8000, workers=1)) == set()


def test_an_empty_sample_checks_all_but_the_environment(medium: str) -> None:
    report = verify(medium, episodes=0, workers=1)
    assert report.ok
    assert not any("played again" in line for line in report.checked)
    for episodes in ("3", 2.5, -1):
        with pytest.raises(offbench.OffbenchError, match="episodes must be a whole number from 0"):
            verify(medium, episodes=episodes)  # type: ignore[arg-type]


def shift_early(group: h5py.Group) -> None:
    rows = group["observations"][()]
    replace(group, "observations", np.concatenate([rows[1:], rows[-1:]]))


def shift_late(group: h5py.Group) -> None:
    rows = group["observations"][()]
    replace(group, "observations", np.concatenate([rows[:1], rows[:-1]]))


def forget_seed(group: h5py.Group) -> None:
    del group.attrs["seed"]


@pytest.mark.parametrize("shift", [shift_early, shift_late])
@pytest.mark.parametrize("seeded", [True, False])
def test_observations_shifted_by_one(hopper: str, shift: Callable[[h5py.Group], None], seeded: bool) -> None:
    def edit(file: h5py.File) -> None:
        for group in each(file):
            shift(group)
            if not seeded:
                forget_seed(group)

    found = codes(tamper(hopper, edit))
    assert found == ({"shifted-observations"} if seeded else {"shifted-observations", "wrong-seeds"})


def test_swapped_medium_and_expert() -> None:
    """Under each other's id, everything else made to fit."""
    names = [offbench.collect("inverted-pendulum", level, steps=20_000, workers=1) for level in ("medium", "expert")]
    files = [minari_store.path_of(name) / "data" / "main_data.hdf5" for name in names]
    contents = [path.read_bytes() for path in files]
    for path, content in zip(files, reversed(contents), strict=True):
        path.write_bytes(content)
    for name in names:
        assert codes(tamper(name, lambda _: None)) >= {"wrong-level"}


def test_swapped_halves_of_medium_expert() -> None:
    """In the metadata; then the episodes change places, seeds and all: equal parts still end where episodes end."""
    name = offbench.collect("inverted-pendulum", "medium-expert", steps=40_000, workers=1)
    parts = minari_store.read_provenance(minari_store.read_metadata(name)).parts
    change_metadata(name, parts=parts[::-1])
    assert codes(name) >= {"wrong-level", "metadata"}
    change_metadata(name, parts=parts)
    first = int(np.searchsorted(np.cumsum([len(e) for e in episodes_of(open_minari(name))]), 20_000)) + 1

    def swap(file: h5py.File) -> None:
        count = len(file)
        for i in range(count):
            file.move(f"episode_{i}", f"old_{i}")
        for new, old in enumerate([*range(first, count), *range(first)]):
            file.move(f"old_{old}", f"episode_{new}")

    assert codes(tamper(name, swap)) == {"wrong-level", "wrong-seeds"}


@pytest.mark.parametrize("seeded", [True, False])
def test_timeouts_marked_as_terminations(seeded: bool) -> None:
    """Episodes of 1000 steps that the time limit ended, and the cut one at the end."""
    name = offbench.collect("inverted-pendulum", "expert", steps=3500, workers=1)

    def edit(file: h5py.File) -> None:
        for group in each(file):
            ends = group["truncations"][()]
            replace(group, "truncations", np.zeros_like(ends))
            replace(group, "terminations", ends)
            if not seeded:
                forget_seed(group)

    assert codes(tamper(name, edit)) - {"wrong-seeds"} == {"timeouts-as-terminations"}


def test_one_timeout_among_many_is_found_without_luck() -> None:
    """It lies at the time limit, so it is played again whatever the sample."""
    name = offbench.collect("inverted-pendulum", "expert", steps=8000, workers=1)

    def edit(file: h5py.File) -> None:
        group = file["episode_3"]
        ends = group["truncations"][()]
        replace(group, "truncations", np.zeros_like(ends))
        replace(group, "terminations", ends)

    report = verify(tamper(name, edit), episodes=1, workers=1)
    assert [(f.code, f.where) for f in report.findings] == [("timeouts-as-terminations", "episode 3")]


def test_terminations_marked_as_timeouts(medium: str) -> None:
    def edit(file: h5py.File) -> None:
        for group in each(file):
            ends = group["terminations"][()] | group["truncations"][()]
            replace(group, "terminations", np.zeros_like(ends))
            replace(group, "truncations", ends)

    assert codes(tamper(medium, edit)) == {"terminations-as-timeouts"}


def test_actions_clipped_after_the_fact(hopper: str) -> None:
    def edit(file: h5py.File) -> None:
        for group in each(file):
            group["actions"][:] = np.clip(group["actions"][()], -0.9, 0.9)

    assert codes(tamper(hopper, edit)) == {"clipped-actions"}


def test_actions_clipped_after_the_fact_in_a_replay() -> None:
    name = offbench.collect("hopper", "medium-replay", steps=3000, workers=1)

    def edit(file: h5py.File) -> None:
        for group in each(file):
            group["actions"][:] = np.clip(group["actions"][()], -0.5, 0.5)

    assert "clipped-actions" in codes(tamper(name, edit))


def test_unclipped_actions(medium: str) -> None:
    """The policy's own output is kept instead of what the environment was given."""

    def edit(file: h5py.File) -> None:
        for group in each(file):
            group["actions"][:] = group["actions"][()] * 1.5

    found = verify(tamper(medium, edit), workers=1).findings
    assert "action-bounds" in {finding.code for finding in found}
    assert "by up to" in next(finding.what for finding in found if finding.code == "action-bounds")


def test_a_wrong_seed_and_wrong_rewards(medium: str) -> None:
    tamper(medium, lambda file: file["episode_2"].attrs.modify("seed", 123))
    assert codes(medium) == {"wrong-seeds", "other-start"}
    tamper(
        medium, lambda file: file["episode_3"]["rewards"].write_direct(np.full(len(file["episode_3"]["rewards"]), 2.0))
    )
    assert "other-rewards" in codes(medium)


def test_repeated_seeds(medium: str) -> None:
    tamper(medium, lambda file: file["episode_1"].attrs.modify("seed", file["episode_0"].attrs["seed"]))
    assert codes(medium) == {"wrong-seeds", "other-start", "repeated-seeds"}


@pytest.mark.parametrize(("column", "value"), [("observations", np.nan), ("actions", np.inf), ("rewards", np.nan)])
def test_numbers_that_are_none(medium: str, column: str, value: float) -> None:
    def edit(file: h5py.File) -> None:
        file["episode_1"][column][0] = value

    report = verify(tamper(medium, edit), workers=1)
    assert [(f.code, f.where) for f in report.findings] == [("not-finite", "episode 1")]


def test_duplicate_episodes(medium: str) -> None:
    def edit(file: h5py.File) -> None:
        file.copy("episode_0", f"episode_{len(file)}")
        file[f"episode_{len(file) - 1}"].attrs["id"] = len(file) - 1

    assert {"duplicate-episodes", "repeated-seeds"} <= codes(tamper(medium, edit))


@pytest.mark.parametrize(
    ("code", "edit"),
    {
        "shape": lambda group: replace(group, "observations", group["observations"][:-1]),
        "dtype": lambda group: replace(group, "actions", group["actions"][()].astype(np.float64)),
        "early-end": lambda group: replace(group, "terminations", np.ones(len(group["rewards"]), bool)),
        "no-end": lambda group: [
            replace(group, key, np.zeros(len(group["rewards"]), bool)) for key in ("terminations", "truncations")
        ],
    }.items(),
)
def test_arrays_that_do_not_fit(medium: str, code: str, edit: Callable[[h5py.Group], Any]) -> None:
    assert code in codes(tamper(medium, lambda file: edit(file["episode_1"])))


@pytest.mark.parametrize("seeded", [True, False])
def test_steps_after_the_end(medium: str, seeded: bool) -> None:
    """Two episodes glued together with no flag in between."""

    def edit(file: h5py.File) -> None:
        first, second = file["episode_0"], file["episode_1"]
        whole = {key: np.concatenate([first[key][()], second[key][()]]) for key in ("actions", "rewards")}
        whole["observations"] = np.concatenate([first["observations"][:-1], second["observations"][()]])
        for key in ("terminations", "truncations"):
            whole[key] = np.concatenate([np.zeros(len(first[key]), bool), second[key][()]])
        for key, value in whole.items():
            replace(first, key, value)
        if not seeded:
            forget_seed(first)

    assert "steps-after-end" in codes(tamper(medium, edit))


def test_a_changed_number_is_told_by_the_hash(medium: str) -> None:
    with h5py.File(minari_store.path_of(medium) / "data" / "main_data.hdf5", "a") as file:
        file["episode_1"]["rewards"][0] = 0.5
    assert "content-hash" in codes(medium, episodes=0)


@pytest.mark.parametrize("size", [0, 3000, -200])
def test_a_truncated_file(medium: str, size: int) -> None:
    path = minari_store.path_of(medium) / "data" / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[:size])
    assert codes(medium) == {"unreadable"}


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"total_steps": 5}, "counts"),
        ({"dataset_id": "other-v0"}, "metadata"),
        ({"parts": "many"}, "metadata"),
        ({"parts": [{"source": "medium", "transitions": 10}]}, "parts"),
        ({"level": "expert"}, "metadata"),
        ({"seed": 1}, "wrong-seeds"),
    ],
)
def test_metadata_against_the_data(medium: str, changes: dict[str, Any], code: str) -> None:
    change_metadata(medium, **changes)
    assert code in codes(medium)


def test_another_environment(medium: str) -> None:
    change_metadata(medium, env_spec=env_spec("Hopper-v5"))
    assert "other-spaces" in codes(medium)


def test_a_foreign_dataset_without_an_environment_passes_and_says_what_was_left_out() -> None:
    name = foreign("plain-v0", [episode(40, 0, True), episode(30, 5, False)])
    report = verify(name, workers=1)
    assert report.ok, report.lines()
    assert {line.split(":")[0] for line in report.skipped} == {
        "the content hash",
        "levels and returns",
        "playing episodes again",
    }


def test_code_named_by_the_metadata_is_not_run(medium: str, home: Path) -> None:
    """Neither as an environment to play in, nor by Minari, which asks the environment where a space is missing."""
    spec = json.loads(env_spec("InvertedPendulum-v5"))
    evil = json.dumps(spec | {"id": "Evil-v0", "entry_point": "os:system", "kwargs": {"command": "touch PWNED"}})
    change_metadata(medium, env_spec=evil)
    assert any("os:system" in line for line in verify(medium, workers=1).skipped)
    metadata = json.loads(metadata_path(medium).read_text())
    del metadata["observation_space"]
    metadata_path(medium).write_text(json.dumps(metadata))
    assert codes(medium) == {"unreadable"}
    with pytest.raises(offbench.OffbenchError, match="lack a space"):
        offbench.load(medium)
    assert not (home / "PWNED").exists()


def test_the_command_line_tells_with_its_exit_code(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    main(["verify", medium, "--workers", "1"])
    assert "no problems found" in capsys.readouterr().out
    change_metadata(medium, content_sha256="0" * 64)
    with pytest.raises(SystemExit) as stopped:
        main(["verify", medium, "--workers", "1", "--json"])
    assert stopped.value.code == 1
    report = json.loads(capsys.readouterr().out)
    assert not report["ok"]
    assert report["findings"][0]["code"] == "content-hash"
    assert report["findings"][0]["remedy"]


def test_workers_find_the_same(medium: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def edit(file: h5py.File) -> None:
        for group in each(file):
            shift_early(group)

    tamper(medium, edit)
    monkeypatch.setattr("offbench.verification.verify.FEW_STEPS", 0)
    assert verify(medium, workers=2).findings == verify(medium, workers=1).findings


def test_every_code_is_in_a_test() -> None:
    texts = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    assert [code for code in FAULTS if f'"{code}"' not in texts] == []


def test_one_finding_is_singular() -> None:
    finding = Finding("shape", "episode 0", "odd", "mend it", 1)
    assert Report("a-v0", 1, 1, (finding,)).lines()[-1] == "1 finding"
    assert Report("a-v0", 1, 1).lines()[0] == "a-v0: 1 transition, 1 episode"
    assert Report("a-v0", 1000, 2, (finding, finding)).lines()[-1] == "2 findings"
