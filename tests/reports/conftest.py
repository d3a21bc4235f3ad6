"""Reports without pictures, which take most of a report's time."""

from __future__ import annotations

from collections import defaultdict

import pytest


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures, for tests of tables and text alone."""
    monkeypatch.setattr("offbench.reports.report._figures", lambda *_: defaultdict(list))
