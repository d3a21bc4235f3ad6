"""A small dataset, and what the random tests have tried in all, at the end of the output: for `make nightly`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

import offbench

WHAT = {"kills": "commands were killed", "files": "damaged files were read", "refused": "of these were refused"}


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the sums of what `record_property` has recorded, for passed tests."""
    counts: Counter[str] = Counter()
    for report in terminalreporter.getreports("passed"):
        counts.update({name: int(value) for name, value in report.user_properties if name in WHAT})
    if not counts:
        return
    terminalreporter.section("random faults")
    for name, words in WHAT.items():
        if counts[name]:
            terminalreporter.write_line(f"{counts[name]:,} {words}")
    failed = len(terminalreporter.getreports("failed")) + len(terminalreporter.getreports("error"))
    terminalreporter.write_line(f"{failed} tests failed, which are not counted" if failed else "none failed")


@pytest.fixture
def recorded(home: Path) -> str:
    """The id of a small dataset."""
    return offbench.collect("inverted-pendulum", "random", steps=300, workers=1)
