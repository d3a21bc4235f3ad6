"""The report's datasets: which runs were trained on what, and where two of them do not compare."""

from __future__ import annotations

import importlib.resources
import json
import shutil
from pathlib import Path

import pytest

import offbench
from offbench.common.files import write_json
from offbench.data import transitions
from tests.made_runs import made_run
from tests.pages import Page, rows


def test_the_datasets_are_those_of_the_runs(medium: str, home: Path) -> None:
    data = transitions.load(medium)
    for algorithm, content in (("td3_bc", data.content_sha256), ("cql", "fedc" * 16)):
        run = made_run(home / "runs", medium, algorithm, "default", 0, 50)
        own = {"dataset_sha256": content, "env_id": data.env_id}
        write_json(run.config_path, json.loads(run.config_path.read_text()) | own)
    made_run(home / "runs", "my-data-v0", "td3_bc", "default", 0, 50)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "Datasets that the runs were trained on" in page.text
    assert "Shipped cards" not in page.text  # none of these environments has one
    found = {row["content"]: list(row.values()) for row in rows(home / "out" / "tables" / "datasets.csv")}
    counts = [f"{len(data):,}", f"{len(data.ends):,}", f"{data.returns.mean():,.1f}"]
    scale = "0.0 to 100.0"
    assert found[data.content_sha256[:12]] == [medium, "InvertedPendulum-v5", *counts, scale, data.content_sha256[:12]]
    # recorded again since, and not on this machine: nothing is known but what the runs say
    assert found["fedcfedcfedc"] == [medium, "InvertedPendulum-v5", "-", "-", "-", scale, "fedcfedcfedc"]
    assert found["000000000000"] == ["my-data-v0", "Hopper-v5", "-", "-", "-", scale, "000000000000"]


def test_a_damaged_dataset_is_named(
    medium: str, home: Path, capsys: pytest.CaptureFixture[str], undrawn: None
) -> None:
    made_run(home / "runs", medium, "td3_bc", "default", 0, 50)
    next(home.glob("minari/*/data/metadata.json")).write_text("{")
    offbench.report(home / "runs", home / "out")
    assert f"the report has no sizes of {medium}: " in capsys.readouterr().err


@pytest.mark.parametrize("torn", [False, True])
def test_datasets_of_one_environment_on_two_scales_are_named(home: Path, torn: bool) -> None:
    references = ([0.0, 50.0 if torn else 100.0], [-10.0, 190.0])
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    made_run(home / "runs", "hopper-expert-v0", "td3_bc", "default", 0, 50, references=references)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert ("The datasets of hopper were recorded with different references" in page.text) == torn


def test_no_curve_over_all_tasks_without_a_method_that_has_them(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    made_run(home / "runs", "hopper-expert-v0", "bc", "default", 0, 50)
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "all tasks, 95% interval shaded; methods" not in page.text
    assert not list((home / "out").rglob("curves-iqm*"))


def test_a_shipped_dataset_card_is_shown(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = Path(str(importlib.resources.files("offbench.reports")))
    shutil.copytree(package / "assets", home / "package" / "assets")
    shutil.copytree(package / "published", home / "package" / "published")
    values = {"transitions": 1000, "episodes": 7, "return": 12.3, "std": 4.5, "score": 33.3, "terminated": 0.25}
    card = {
        "versions": {"mujoco": "3.4.0"},
        "levels": {"medium": values | {"content_sha256": {"3.4.0": "0123456789abcdef"}}},
    }
    write_json(home / "package" / "datasets" / "hopper" / "card.json", card)
    (home / "package" / "datasets" / "hopper" / "card.png").write_bytes(b"\x89PNG")
    (home / "package" / "datasets" / "hopper" / "recipe.toml").touch()
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50)
    made_run(home / "runs", "my-medium-v0", "td3_bc", "default", 0, 50)
    monkeypatch.setattr(importlib.resources, "files", lambda _: home / "package")
    page = Page(offbench.report(home / "runs", home / "out"))
    assert "hopper (mujoco 3.4.0)" in page.text
    assert page.text.index("Datasets that the runs were trained on") < page.text.index("Shipped cards, for reference")
    assert "25.0%" in page.text
    pictures = [a for name, a in page.elements if name == "img"]
    assert len(pictures) == 1
    assert (pictures[0]["src"] or "").startswith("data:image/png;base64,")
    assert "hopper" in (pictures[0]["alt"] or "")
