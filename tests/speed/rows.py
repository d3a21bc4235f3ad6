"""The rows of the benchmark: two sides, what is expected of their ratio, and what the row says."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

from offbench.workers import cores

PEER = Path(__file__).parent.parent.parent / ".venv-d3rlpy" / "bin" / "python"


@dataclass(frozen=True)
class Row:
    """A comparison: `ours` against `theirs`, in units a second.

    Attributes:
        at_least, aim: of the ratio; None where a row only informs.
        seconds: of a side's turn; sides take turns `rounds` times.
    """

    name: str
    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    at_least: float | None = None
    aim: float | None = None
    seconds: float = 2.0
    rounds: int = 11
    environment: dict[str, str] = field(default_factory=dict)


def side(which: str, **arguments: object) -> tuple[str, ...]:
    """Return the command of one of our sides."""
    return (sys.executable, "-m", "tests.speed.sides", which, *(f"{key}={value}" for key, value in arguments.items()))


def peer(algorithm: str) -> tuple[str, ...]:
    """Return the command of one of d3rlpy's sides."""
    return (str(PEER), "-m", "tests.speed.peer", "update", f"algorithm={algorithm}")


def rows(dataset: str) -> list[Row]:
    """Return the rows with a target. `dataset` is a recorded one of a million transitions."""
    n = cores()
    td3_bc, bdb, cql = (side("train", algorithm=name) for name in ("td3_bc", "bdb", "cql"))
    return [
        Row("td3_bc updates vs d3rlpy", td3_bc, peer("td3_bc"), 1.7, 2.2),
        Row("td3_bc updates vs its matrix products alone", td3_bc, side("products", algorithm="td3_bc"), 0.6, 0.8),
        Row("bdb updates vs td3_bc", bdb, td3_bc, 0.8, 0.92),
        Row("bdb updates vs its matrix products alone", bdb, side("products", algorithm="bdb")),
        Row(
            "cql updates vs d3rlpy (2-layer networks)",
            side("train", algorithm="cql", hidden="256,256"),
            peer("cql"),
            1.25,
            1.5,
            5.0,
        ),
        Row(
            "cql updates (2-layer) vs its matrix products alone",
            cql,
            side("products", algorithm="cql"),
            None,
            None,
            5.0,
        ),
        Row(
            "CQL's largest matrix product: oneDNN vs torch.bmm",
            side("product", way="onednn"),
            side("product", way="bmm"),
        ),
        Row(
            f"recording with {n} workers vs SB3 predict + Minari DataCollector",
            side("record", workers=n),
            side("sb3_collector"),
            5,
            9,
            10.0,
            3,
        ),
        Row(
            f"recording with {n} workers vs mj_step alone on {n} cores",
            side("record", workers=n),
            side("physics", workers=n),
            0.45,
            0.8,
            10.0,
            3,
        ),
        Row(
            "loading a million transitions from the cache vs Minari's iterate_episodes",
            side("load_cached", dataset_id=dataset),
            side("load_minari", dataset_id=dataset),
            30,
            300,
            3.0,
            3,
        ),
        Row(
            "loading a million transitions from the cache vs without checking hashes",
            side("load_cached", dataset_id=dataset),
            side("load_unchecked", dataset_id=dataset),
            0.95,
            0.98,
            1.0,
            11,
        ),
        Row(
            f"evaluation with {n} workers vs SB3's evaluate_policy",
            side("evaluate", workers=n),
            side("sb3_evaluate"),
            4,
            8,
            6.0,
            3,
        ),
    ]


def growth() -> list[tuple[str, Row]]:
    """Return what cost grows with, a row each against the smallest: (what is shown, row)."""
    n = cores()
    one = side("train", algorithm="td3_bc")
    found = [
        (f"{runs} runs in a stack", Row("stack", side("train", algorithm="td3_bc", runs=runs), one, rounds=3))
        for runs in (2, 4, 8, 16)
    ]
    found += [
        (f"{rows:,} transitions", Row("size", side("train", algorithm="td3_bc", rows=rows), one, rounds=3))
        for rows in (1_000_000, 10_000_000)
    ]
    solo = side("evaluate", workers=1)
    for workers in sorted({2, n} - {1}):
        found.append((f"{workers} workers", Row("workers", side("evaluate", workers=workers), solo, rounds=3)))
    return found
