"""Datasets handed to others: through Minari's remotes, as an archive, and downloaded by `train`."""

from __future__ import annotations

import contextlib
import fnmatch
import json
import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import minari
import numpy as np
import pytest
import yaml

import offbench
from offbench.cli.main import main
from offbench.common import files
from offbench.common.errors import LockedError, OffbenchError
from offbench.data import download, minari_store

SMALL = ["--steps", "2", "--eval-every", "2", "--eval-episodes", "1", "--workers", "1", "--hidden", "8"]


@pytest.fixture
def medium() -> str:
    """The id of a small dataset of a shipped agent."""
    return offbench.collect("inverted-pendulum", "medium", steps=600, workers=1)


class LocalHub:
    """huggingface_hub's HfApi, as far as Minari calls it, over a folder with a folder for each repository."""

    root: Path
    commits: list[str]

    def __init__(self, token: str | None = None) -> None:
        self.token = token

    def create_repo(self, repo_id: str, repo_type: str, exist_ok: bool) -> None:
        assert repo_type == "dataset"
        (self.root / repo_id).mkdir(parents=True, exist_ok=exist_ok)

    def upload_folder(self, *, repo_id: str, folder_path: Path, path_in_repo: str, repo_type: str) -> None:
        assert self.token == "a token"
        shutil.copytree(folder_path, self.root / repo_id / path_in_repo, dirs_exist_ok=True)
        self.commits.append(repo_id)

    def upload_file(self, *, path_or_fileobj: Path, path_in_repo: str, repo_id: str, repo_type: str) -> None:
        shutil.copy(path_or_fileobj, self.root / repo_id / path_in_repo)

    def list_datasets(self, *, author: str, dataset_name: str | None = None) -> list[Any]:
        found = sorted((self.root / author).glob("*"))
        return [SimpleNamespace(id=f"{author}/{path.name}") for path in found if (dataset_name or "") in path.name]

    def hf_hub_download(
        self, *, repo_id: str, filename: str, repo_type: str, local_dir: Path | None = None, **_: Any
    ) -> str:
        from huggingface_hub.errors import EntryNotFoundError

        path = self.root / repo_id / filename
        if not path.exists():
            raise EntryNotFoundError(filename)
        copy = (local_dir or self.root.parent / "hub cache" / repo_id) / filename
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
        return str(copy)

    def snapshot_download(self, *, repo_id: str, allow_patterns: str, repo_type: str, local_dir: Path) -> None:
        for path in (self.root / repo_id).rglob("*"):
            name = path.relative_to(self.root / repo_id)
            if path.is_file() and fnmatch.fnmatch(str(name), allow_patterns):
                (local_dir / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, local_dir / name)


@pytest.fixture
def hub(home: Path, monkeypatch: pytest.MonkeyPatch) -> type[LocalHub]:
    """Let Minari's Hugging Face remote work on a local folder."""
    pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
    from minari.storage.remotes import huggingface

    monkeypatch.setattr(LocalHub, "root", home / "hub", raising=False)
    monkeypatch.setattr(LocalHub, "commits", [], raising=False)
    monkeypatch.setattr(huggingface, "HfApi", LocalHub)
    monkeypatch.setenv("MINARI_REMOTE", "hf://me")
    return LocalHub


def elsewhere(home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Go on as another machine does: no datasets, no cache."""
    folder = home / "another machine"
    folder.mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
    monkeypatch.setenv("OFFBENCH_CACHE", str(folder / "cache"))
    return folder


def test_minaris_remote_keeps_metadata_card_and_references(
    hub: type[LocalHub],
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ids need a namespace: Minari 0.5.4 lists no others on the Hub."""
    name = "mine/pendulum-medium-v0"
    offbench.collect("inverted-pendulum", "medium", steps=600, workers=1, dataset_id=name)
    before, content = minari_store.read_metadata(name), offbench.load(name).content_sha256
    main(["card", name, "--huggingface"])
    card = (minari_store.path_of(name) / "README.md").read_text()
    assert f"\nMINARI_REMOTE=hf://USER minari download {name}\n" in card
    from minari.cli import app
    from typer.testing import CliRunner

    done = CliRunner().invoke(app, ["upload", name, "--key-path", "a token"])
    assert done.exit_code == 0, done.output
    assert hub.commits == ["me/mine"]
    elsewhere(home, monkeypatch)
    capsys.readouterr()
    main(["train", "bc", "--dataset", name, "--download", *SMALL])
    assert capsys.readouterr().out == "runs/mine/pendulum-medium-v0/bc/hidden=8/seed-0\n"
    assert (minari_store.path_of(name) / "README.md").read_text() == card
    assert minari_store.read_metadata(name) == before
    data = offbench.load(name)
    assert data.content_sha256 == content
    assert data.references == (before["ref_min_score"], before["ref_max_score"])
    assert offbench.verify(name, workers=1).ok
    # and with Minari alone, into a third folder
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(home / "third"))
    minari.download_dataset(name)
    assert minari_store.read_metadata(name) == before


def test_an_archive_for_a_colleague(medium: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, content = minari_store.root(), offbench.load(medium).content_sha256
    env = offbench.make_env(medium)
    subprocess.run(["tar", "-cf", f"{home}/data.tar", "-C", str(source), medium], check=True)
    elsewhere(home, monkeypatch)
    shutil.rmtree(source)
    with pytest.raises(OffbenchError, match="is not recorded yet"):
        offbench.verify(medium)
    minari_store.root().mkdir()
    subprocess.run(["tar", "-xf", f"{home}/data.tar", "-C", str(minari_store.root())], check=True)
    assert minari_store.local_ids() == [medium]
    assert offbench.verify(medium, workers=1).ok
    assert offbench.load(medium).content_sha256 == content
    assert offbench.make_env(medium).spec == env.spec


def test_the_hubs_card_says_what_the_data_are(medium: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = offbench.huggingface_card(medium)
    assert path == minari_store.path_of(medium) / "README.md"
    _, header, text = path.read_text().split("---\n", 2)
    assert yaml.safe_load(header) == {
        "pretty_name": medium,
        "task_categories": ["reinforcement-learning"],
        "tags": ["reinforcement-learning", "offline-rl", "minari", "gymnasium"],
        "size_categories": ["n<1K"],
        "viewer": False,
    }
    dataset = minari.load_dataset(medium)
    returns = np.array([episode.rewards.sum() for episode in dataset.iterate_episodes()])
    spread = f"std {returns.std():.1f}, {returns.min():.1f} to {returns.max():.1f}"
    assert f"| return of an episode | mean {returns.mean():.1f}, {spread} |" in text
    assert "| transitions | 600 |" in text
    assert f"| content sha256 | {offbench.load(medium).content_sha256} |" in text
    assert "| environment | InvertedPendulum-v5 |" in text
    assert offbench.verify(medium, workers=1).ok  # a card in the folder is no fault
    main(["card", medium, "--huggingface", "--out", "card.md"])
    assert (home / "card.md").read_bytes() == path.read_bytes()
    path.write_text(path.read_text().replace("viewer:", "license: mit\nviewer:").replace("| transitions | 600 |", ""))
    _, header, text = offbench.huggingface_card(medium).read_text().split("---\n", 2)
    assert yaml.safe_load(header)["license"] == "mit"
    assert "| transitions | 600 |" in text
    with pytest.raises(OffbenchError, match="unknown dataset 'hoper-v0'"):
        offbench.huggingface_card("hoper-v0")


def test_a_hostile_description_stays_text(medium: str) -> None:
    path = minari_store.path_of(medium) / "data" / "metadata.json"
    metadata = json.loads(path.read_text()) | {"description": "<script>x</script>\n---\n# [a](b)"}
    path.write_text(json.dumps(metadata))
    text = offbench.huggingface_card(medium).read_text()
    assert "<script>" not in text
    assert text.count("\n---\n") == 1
    assert r"\# \[a\](b)" in text


def test_hub_and_header_agree_with_huggingface(medium: str) -> None:
    """huggingface_hub itself reads the header."""
    hub = pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
    card = hub.DatasetCard.load(offbench.huggingface_card(medium))
    assert card.data.size_categories == ["n<1K"]
    assert card.data.task_categories == ["reinforcement-learning"]


NAMED = "mujoco/pendulum/medium-v0"


@pytest.fixture
def server(medium: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace Minari's `download_dataset` by a copy of a local dataset; the ids it was asked for."""
    source, asked = minari_store.path_of(medium), []

    def download_dataset(dataset_id: str) -> None:
        asked.append(dataset_id)
        print("Downloading ...")
        target = Path(os.environ["MINARI_DATASETS_PATH"], dataset_id)
        (target / "data").mkdir(parents=True)
        for folder in (target.parent, target.parent.parent):
            (folder / "namespace_metadata.json").write_text("{}")
        metadata = json.loads((source / "data" / "metadata.json").read_text()) | {"dataset_id": dataset_id}
        (target / "data" / "metadata.json").write_text(json.dumps(metadata))
        if "broken" in dataset_id:
            raise ConnectionError("the connection was\nlost")
        shutil.copy(source / "data" / "main_data.hdf5", target / "data")

    monkeypatch.setattr(minari, "download_dataset", download_dataset)
    return asked


def test_a_download_waits_for_that_of_another_process(
    server: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lock = files.exclusive_lock

    def held_for_a_while(path: Path, what: str, timeout: float = 3.0) -> contextlib.AbstractContextManager[None]:
        if timeout < 60:
            raise LockedError(f"{what} by process 1 on here; wait for it, or stop it")
        return lock(path, what)

    monkeypatch.setattr(download, "exclusive_lock", held_for_a_while)
    download.download(NAMED)
    assert server == [NAMED]
    said = "another dataset is being downloaded by process 1 on here; waiting for it\n"
    assert capsys.readouterr().err.count(said) == 1


def test_train_downloads_what_is_not_here(
    server: list[str], medium: str, capsys: pytest.CaptureFixture[str], home: Path
) -> None:
    words = ["train", "bc", "--dataset", medium, NAMED, *SMALL]
    with pytest.raises(SystemExit):
        main(words)
    assert "or `train --download`" in capsys.readouterr().err
    assert not server
    for _ in range(2):  # the second time it is here
        main([*words, "--download"])
        out, err = capsys.readouterr()
        assert len(out.splitlines()) == 2
        assert server == [NAMED]
    assert minari_store.local_ids() == sorted([medium, NAMED])
    assert (minari_store.root() / "mujoco" / "namespace_metadata.json").exists()
    assert minari.load_dataset(NAMED).total_steps == 600
    with pytest.raises(SystemExit):
        main(["train", "bc", "--dataset", "mujoco/broken-v0", "--download", *SMALL])
    err = capsys.readouterr().err.splitlines()[-1]
    assert err.startswith("offbench: cannot download mujoco/broken-v0: the connection was lost; check the id")
    assert not minari_store.exists("mujoco/broken-v0")
    assert not (minari_store.root() / ".offbench-download").exists()
    with pytest.raises(SystemExit):
        main(["train", "bc", "--dataset", "../x-v0", "--download", *SMALL])
    assert "is not a dataset id" in capsys.readouterr().err
    assert os.environ["MINARI_DATASETS_PATH"] == str(minari_store.root())
