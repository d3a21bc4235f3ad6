"""The page fetches nothing, runs nothing but its own script, and can be used without eyes."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import pytest
from matplotlib.image import imread

import offbench
from offbench.common.text import printable
from offbench.reports.figures import LineStyle, _legend, _tick, shortened
from offbench.reports.markup import breakable, prose
from tests.made_runs import METHODS, made_grid, made_run
from tests.pages import HOSTILE, Page, hostile_runs


def test_names_that_are_markup_stay_text(home: Path) -> None:
    hostile_runs(home / "runs")
    path = offbench.report(home / "runs", home / "out")
    page = Page(path)
    names = [name for name, _ in page.elements]
    assert names.count("script") == 1
    assert names.count("style") == 1
    assert "img" not in names
    assert not [key for _, attributes in page.elements for key in attributes if key.startswith("on")]
    assert HOSTILE in page.text.replace("\xa0", " ")
    outside = re.sub(r"<script>.*?</script>", "", path.read_text(), flags=re.DOTALL)
    assert "hacked=1" in outside  # as text
    assert "<img" not in (home / "out" / "tables" / "scores.md").read_text()
    latex = (home / "out" / "tables" / "scores.tex").read_text()
    assert all(line.startswith(("%", "\\")) or line.endswith(r" \\") for line in latex.splitlines())
    assert "<script" not in "".join(line for line in latex.splitlines() if not line.startswith("%"))


def test_long_names_are_shortened_in_pictures() -> None:
    assert shortened("td3_bc", 8) == "td3_bc"
    assert shortened("abcdefghijkl", 8) == "abcd…jkl"
    assert len(shortened("x" * 99, 24)) == 24


def test_legend_names_that_are_cut_alike_are_numbered() -> None:
    labels = ["td3_bc", f"bdb ({'a' * 30}b{'c' * 30})", f"bdb ({'a' * 30}d{'c' * 30})"]
    _, names = _legend([LineStyle(label, "#000000", "-") for label in labels], 32)
    assert names[0] == " td3_bc"
    assert [name[:7] for name in names[1:]] == [" 2. bdb", " 3. bdb"]
    assert max(map(len, names)) <= 33


def test_control_characters_are_escaped_in_every_file_of_a_report(home: Path) -> None:
    made_grid(home / "runs", seeds=2, levels=1)
    for path in (home / "runs").rglob("config.json"):
        config = json.loads(path.read_text())
        config["settings"] |= {"beta": "\x1b]0;owned\x07\u202e"}
        config |= {"dataset": "\x1b[2J\u202etask", "command": "offbench \x9b2J"}
        config["hardware"]["processor"] = "\u200bx\x00"
        path.write_text(json.dumps(config))
    offbench.report(home / "runs", home / "out")
    files = [path for path in (home / "out").rglob("*") if path.suffix in (".html", ".md", ".tex", ".csv", ".svg")]
    assert len(files) > 10
    assert "\\x1b[2J" in (home / "out" / "tables" / "seeds.csv").read_text()
    for path in files:
        text = path.read_text()
        assert printable(text) == text, path


def test_nothing_is_fetched_and_one_script_runs(home: Path) -> None:
    made_grid(home / "runs", seeds=2, levels=1)
    path = offbench.report(home / "runs", home / "out")
    page = Page(path)
    for name, attributes in page.elements:
        for key in ("src", "srcset", "data", "action", "poster", "xlink:href"):
            value = attributes.get(key) or "#"
            assert value.startswith(("#", "data:")), (name, key, value)
        assert name not in ("link", "iframe", "object", "embed", "base", "form")
    policies = [a["content"] or "" for name, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    (script,) = re.findall(r"<script[^>]*>(.*?)</script>", path.read_text(), re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert dict(directive.strip().split(" ", 1) for directive in policies[0].split(";")) == {
        "default-src": "'none'",
        "style-src": "'unsafe-inline'",
        "img-src": "data:",
        "script-src": f"'sha256-{digest}'",
    }


def test_tables_are_accessible(home: Path) -> None:
    made_grid(home / "runs", seeds=2, levels=1)
    page = Page(offbench.report(home / "runs", home / "out"))
    count = {name: sum(n == name for n, _ in page.elements) for name in ("table", "caption", "th")}
    assert count["table"] == count["caption"] + len(METHODS)  # boxes name theirs by their heading
    assert all(a.get("scope") in ("row", "col") for name, a in page.elements if name == "th")
    pictures = [a for name, a in page.elements if a.get("role") == "img" and name == "div"]
    assert pictures
    assert all(len(a["aria-label"] or "") > 20 for a in pictures)
    assert dict(page.elements)["html"]["lang"] == "en"


def test_the_axis_of_a_million_updates_has_short_labels(home: Path) -> None:
    made_run(home / "runs", "hopper-medium-v0", "td3_bc", "default", 0, 50.0, steps=1_000_000)
    offbench.report(home / "runs", home / "out")
    svg = (home / "out" / "figures" / "curves-hopper-medium-v0.svg").read_text()
    labels = re.findall(r">([\d.,]+[kM]?)</text>", svg)
    assert labels[:4] == ["250k", "500k", "750k", "1M"]
    assert [_tick(value) for value in (0.0, 2.5, 19.5, 20.0, 12_500.0)] == ["0", "2.5", "19.5", "20", "12.5k"]


def test_long_text_breaks_but_never_within_a_number() -> None:
    assert breakable("2 seeds, 5,000 of 1,000,000 steps") == "2 seeds,<wbr> 5,000 of 1,000,000 steps"
    assert breakable("bdb alpha=2.5,beta=0.25,hidden=64x64") == (
        "bdb alpha=<wbr>2.5,<wbr>beta=<wbr>0.25,<wbr>hidden=<wbr>64x64"
    )
    assert prose("a < b, `offbench compare` says") == "a &lt; b, <code>offbench compare</code> says"


@pytest.mark.parametrize(
    "variants", [["noise_clip=0.25", "noise_clip=0.75"], [f"hidden={'8x' * n}8" for n in (1, 12, 13, 60)]]
)
def test_a_legend_is_within_its_picture(home: Path, variants: list[str]) -> None:
    for variant in variants:
        made_run(home / "runs", "hopper-medium-v0", "td3_bc", variant, 0, 50)
    offbench.report(home / "runs", home / "out")
    picture = imread(home / "out" / "figures" / "curves-hopper-medium-v0.png")
    background = picture[0, 0]
    assert not (picture == background).all()
    for edge in (picture[:, :4], picture[:, -4:]):
        assert (edge == background).all()
