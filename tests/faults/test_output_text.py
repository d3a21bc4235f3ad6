"""Text from files in the output and in tables: control characters, markup and formulas are harmless."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from offbench.analysis import normalize
from offbench.cli.main import main
from offbench.common.text import printable
from tests.commands import run_offbench
from tests.made_runs import small_run


def test_escape_sequences_are_shown_not_obeyed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = small_run(tmp_path / "seed-0")
    config = json.loads(run.config_path.read_text()) | {"dataset": "\x1b]0;owned\x07\x1b[2J\u202e"}
    run.config_path.write_text(json.dumps(config))
    main(["normalize", "--runs", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "\\x1b[2J" in shown
    assert not set(shown) & set("\x1b\x07\u202e")
    assert printable("a\tb\n±é") == "a\tb\n±é"
    assert printable("\u061c\u200b\u2028\U000e0041") == "\\u061c\\u200b\\u2028\\U000e0041"


@pytest.mark.parametrize(
    "cell", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", " =1", "\n=1", "-1 (A1*2)"]
)
def test_no_cell_is_a_formula(cell: str) -> None:
    text = normalize.render([{"dataset": cell, "return": -1.5}], "csv")
    header, row = csv.reader(io.StringIO(text))
    assert (header, row) == (["dataset", "return"], ["'" + cell, "-1.5"])


def test_odd_terminals_get_what_they_can_show() -> None:
    assert run_offbench("list", PYTHONIOENCODING="ascii").returncode == 0
    assert run_offbench("list", before="exec >&-;").returncode == 0


def test_markup_in_a_name_is_text_in_markdown_and_latex(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = small_run(tmp_path / "seed-0")
    name = "<script>|[x](javascript:y)\\input{x}"
    run.config_path.write_text(json.dumps(json.loads(run.config_path.read_text()) | {"dataset": name}))
    main(["normalize", "--runs", str(tmp_path), "--format", "markdown"])
    text = capsys.readouterr().out
    assert "<script>" not in text
    assert r"\|\[x\](javascript:y)" in text
    main(["normalize", "--runs", str(tmp_path), "--format", "latex"])
    assert r"\input" not in capsys.readouterr().out
