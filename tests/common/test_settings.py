"""Metadata read back from JSON: strict types, the fields of a nested dataclass, and one line for what is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from offbench.common.errors import DamagedError
from offbench.common.settings import build, read_back, setting


@dataclass(frozen=True)
class Part:
    name: str
    share: float = setting(1.0, "share", low=0.0, high=1.0)


@dataclass(frozen=True)
class Metadata:
    steps: int
    pair: tuple[float, float] | None = None
    parts: tuple[Part, ...] = ()
    scores: dict[str, float | None] = field(default_factory=dict)
    anything: dict[str, Any] = field(default_factory=dict)


SOUND: dict[str, Any] = {
    "steps": 3,
    "pair": [1, 2.5],
    "parts": [{"name": "a", "share": 0.5}, {"name": "b"}],
    "scores": {"x": 1.5, "y": None},
    "anything": {"list": [1, "two"]},
    "written by a later version": True,
}


def test_metadata_are_read_back_with_their_types() -> None:
    metadata = read_back(Metadata, SOUND, "file.json", "delete it")
    parts = (Part("a", 0.5), Part("b"))
    assert metadata == Metadata(3, (1.0, 2.5), parts, {"x": 1.5, "y": None}, {"list": [1, "two"]})


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"steps": "3"}, "steps must be a whole number, not '3'"),
        ({"steps": 3.0}, "steps"),
        ({"steps": True}, "steps"),
        ({"steps": 2**70}, "steps"),
        ({"pair": [1.0]}, "pair"),
        ({"pair": [1.0, "2"]}, "pair"),
        ({"pair": [1.0, float("nan")]}, "pair must be a finite number"),
        ({"parts": [{"share": 0.5}]}, "missing key 'name'"),
        ({"parts": [{"name": "a", "share": 2}]}, "share must be at most 1"),
        ({"parts": ["a"]}, "parts"),
        ({"scores": {"x": "1"}}, "scores"),
        ({"scores": [1]}, "scores"),
    ],
)
def test_damaged_metadata_are_one_line(change: dict[str, Any], named: str) -> None:
    with pytest.raises(DamagedError, match=r"^file.json is damaged \(.*\); delete it$") as refused:
        read_back(Metadata, SOUND | change, "file.json", "delete it")
    assert named in str(refused.value)


@pytest.mark.parametrize(("values", "named"), [([1], "JSON object"), (None, "JSON object"), ({}, "'steps'")])
def test_other_json_is_refused(values: object, named: str) -> None:
    with pytest.raises(DamagedError, match=named):
        read_back(Metadata, values, "file.json", "delete it")


def test_text_stands_for_numbers_only_where_it_is_typed() -> None:
    assert build(Part, {"name": "a", "share": "0.25"}, "here") == Part("a", 0.25)
    with pytest.raises(DamagedError, match=r"share must be a number, not '0\.25'"):
        read_back(Part, {"name": "a", "share": "0.25"}, "file.json", "delete it")
