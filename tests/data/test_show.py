"""`show` against numbers worked out by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import offbench
from offbench.data import minari_store
from tests.made_datasets import episode, foreign


@pytest.fixture
def four_episodes() -> str:
    """A dataset with the returns 1, 1, 4 and 10, the references 1 and 11, and one termination."""
    rewards = ([1.0, 0.0], [0.0, 0.5, 0.5], [1.0, 1.0, 1.0, 1.0], [4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 6.0])
    episodes = [episode(len(r), 10 * i, i == 2, rewards=np.array(r)) for i, r in enumerate(rewards)]
    name = foreign("four-v0", episodes)
    path = minari_store.path_of(name) / "data" / "metadata.json"
    references = {"ref_min_score": 1.0, "ref_max_score": 11.0, "description": "four episodes"}
    path.write_text(json.dumps(json.loads(path.read_text()) | references))
    return name


def test_the_summary_by_hand(four_episodes: str) -> None:
    """The mean return is 4, its deviation sqrt((9 + 9 + 0 + 36) / 4), its score 100 (4 - 1) / (11 - 1)."""
    full, half = "█" * 40, "█" * 20
    assert offbench.show(four_episodes).lines() == [
        "four-v0: four episodes",
        "spaces          observations Box (2,) float64, actions Box (2,) float32",
        "episodes        4, 16 transitions, length 4 (2 to 7), 25% terminated",
        "return          mean 4.0, std 3.7, 1.0 to 10.0",
        "references      random 1.0, expert 11.0: normalized mean return 30.0",
        "",
        f"       1.0 to       1.8  {full} 2",
        f"       1.8 to       2.5  {'':40} 0",
        f"       2.5 to       3.2  {'':40} 0",
        f"       3.2 to       4.0  {'':40} 0",
        f"       4.0 to       4.8  {half}{'':20} 1",
        f"       4.8 to       5.5  {'':40} 0",
        f"       5.5 to       6.2  {'':40} 0",
        f"       6.2 to       7.0  {'':40} 0",
        f"       7.0 to       7.8  {'':40} 0",
        f"       7.8 to       8.5  {'':40} 0",
        f"       8.5 to       9.2  {'':40} 0",
        f"       9.2 to      10.0  {half}{'':20} 1",
        "",
        "provenance",
        "not recorded by offbench",
    ]


def test_returns_that_differ_by_rounding_are_one_bar(home: Path) -> None:
    sums = ([0.1, 0.2, 0.3], [0.3, 0.2, 0.1])
    name = foreign("sums-v0", [episode(3, 0, True, rewards=np.array(rewards)) for rewards in sums])
    summary = offbench.show(name)
    assert summary.returns[0] != summary.returns[1]
    assert [line.rsplit(maxsplit=1)[-1] for line in summary.lines() if " to " in line and "█" in line] == ["2"]
    assert summary.plot(home / "sums.png").exists()


def test_the_figure_by_hand(four_episodes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr("offbench.data.show.save", lambda fig, path: drawn.append(fig))
    offbench.show(four_episodes).plot("returns.png")
    (axes,) = drawn[0].axes
    bars = {round(bar.get_x(), 3): bar.get_height() for bar in axes.patches if bar.get_height()}  # type: ignore[attr-defined]
    assert bars == {1.0: 2, 3.925: 1, 9.775: 1}  # 40 bins of 0.225
    assert [list(line.get_xdata()) for line in axes.lines] == [[4.0, 4.0]]  # type: ignore[arg-type]
