"""Datasets that are replaced or deleted while they are read."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.data import minari_store, minari_writer, transitions
from offbench.data.minari_reader import episodes_of
from tests.commands import refusal


@pytest.mark.parametrize("times", [1, 9])
def test_a_dataset_replaced_while_it_is_loaded(
    times: int, recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between its metadata and its arrays: the new one is read, or, if that goes on and on, none."""
    key, left = transitions._key, itertools.count()

    def replaced(*arguments: Any) -> str:
        if next(left) < times:
            shutil.rmtree(home / "minari" / recorded)
            offbench.collect("inverted-pendulum", "random", steps=300 + next(left), dataset_id=recorded, workers=1)
        return key(*arguments)

    monkeypatch.setattr(transitions, "_key", replaced)
    if times > 1:
        with pytest.raises(offbench.OffbenchError, match="was replaced while it was read"):
            transitions.load(recorded)
        return
    found = transitions.load(recorded)
    monkeypatch.undo()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / "minari"))
    monkeypatch.setenv("OFFBENCH_CACHE", str(home / "fresh"))
    now = transitions.load(recorded)
    assert found.content_sha256 == now.content_sha256 == now.metadata["offbench"]["content_sha256"]
    for name in transitions.ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(now, name))


@pytest.mark.parametrize(
    ("module", "read"),
    [("data.export", lambda name: offbench.export(name, "out.npz")), ("verification.scan", offbench.verify)],
)
def test_a_dataset_replaced_while_it_is_exported_or_verified(
    module: str, read: Callable[[str], Any], recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replaced(*arguments: Any) -> Any:
        shutil.rmtree(home / "minari" / recorded)
        offbench.collect("inverted-pendulum", "random", steps=301, dataset_id=recorded, workers=1)
        return episodes_of(*arguments)

    monkeypatch.setattr(f"offbench.{module}.episodes_of", replaced)
    with pytest.raises(offbench.OffbenchError, match=f"{recorded} was replaced while it was read"):
        read(recorded)
    assert not list(home.glob("*out.npz*"))


def test_a_dataset_deleted_while_it_is_verified(recorded: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After its arrays are read: Minari itself notices, with an error of its own."""
    monkeypatch.setattr(
        "offbench.verification.verify._check_counts", lambda *_: shutil.rmtree(home / "minari" / recorded)
    )
    with pytest.raises(offbench.OffbenchError, match="was replaced while it was read"):
        offbench.verify(recorded)


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_a_dataset_deleted_while_it_is_recorded(
    overwrite: list[str],
    recorded: str,
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["collect", "inverted-pendulum", "--level", "random", "--steps", "300", "--seed", "1", "--workers", "1"]
    words += overwrite or ["--id", "new-v0"]
    with monkeypatch.context() as patched:
        patched.setattr(minari_writer, "_check_room", lambda folder, *_: shutil.rmtree(folder))
        assert "was moved or deleted while it was written" in refusal(words, capsys)
    assert minari_store.local_ids() == [recorded]
    main(words)
    assert minari_store.read_provenance(minari_store.read_metadata(words[-1] if not overwrite else recorded)).seed == 1
