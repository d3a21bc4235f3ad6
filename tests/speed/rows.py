"""The rows of the benchmark: two sides, what is expected of their ratio, and what the row says."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from offbench.common.processes import cores
from offbench.common.provenance import has_bfloat16

PEERS = Path(__file__).parent.parent.parent / ".venv-peers" / "bin" / "python"


@dataclass(frozen=True)
class Row:
    """A comparison: `ours` against `theirs`, in units a second.

    Attributes:
        at_least, aim: of the ratio; None where a row only informs.
        seconds: of a side's turn; sides take turns `rounds` times.
        pinned: both sides run on one core, the same.
    """

    name: str
    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    at_least: float | None = None
    aim: float | None = None
    seconds: float = 2.0
    rounds: int = 7
    pinned: bool = False


def side(which: str, **arguments: object) -> tuple[str, ...]:
    """Return the command of one of our sides."""
    return (sys.executable, "-m", "tests.speed.sides", which, *(f"{key}={value}" for key, value in arguments.items()))


def peer(library: str, which: str, algorithm: str) -> tuple[str, ...]:
    """Return the command of a side of another library: d3rlpy or jax."""
    return (str(PEERS), "-m", f"tests.speed.{library}_peer", which, f"algorithm={algorithm}")


def update_rows() -> list[Row]:
    """Return the rows of updates, all with networks of two layers."""
    td3_bc, bdb = (side("train", algorithm=name) for name in ("td3_bc", "bdb"))
    cql = side("train", algorithm="cql", hidden="256,256")
    found = [
        ("td3_bc updates vs JAX", td3_bc, peer("jax", "update", "td3_bc"), 0.85, 1.05),
        ("td3_bc updates vs d3rlpy", td3_bc, peer("d3rlpy", "update", "td3_bc"), 2.5, 4),
        ("td3_bc updates vs its matrix products alone", td3_bc, peer("jax", "products", "td3_bc"), 0.6, 0.8),
        ("bdb updates vs td3_bc", bdb, td3_bc, 0.85, 0.92),
        ("bdb updates vs its matrix products alone", bdb, peer("jax", "products", "bdb"), None, None),
        ("cql updates vs JAX", cql, peer("jax", "update", "cql"), 1.3, 1.5),
        ("cql updates vs d3rlpy", cql, peer("d3rlpy", "update", "cql"), 1.25, 1.5),
        ("cql updates vs its matrix products alone", cql, peer("jax", "products", "cql"), None, None),
    ]
    if has_bfloat16():
        half, cql_half = (
            side("train", algorithm=name, hidden="256,256", precision="bfloat16") for name in ("td3_bc", "cql")
        )
        found += [
            ("td3_bc updates in bfloat16 vs JAX in float32", half, peer("jax", "update", "td3_bc"), 1.15, 1.5),
            ("td3_bc updates in bfloat16 vs float32", half, td3_bc, 1.3, 1.6),
            ("cql updates in bfloat16 vs float32", cql_half, cql, 1.7, 2.0),
        ]
    return [Row(*row, seconds=5.0 if "cql" in row[0] else 2.0, pinned=True) for row in found]


def rows(dataset: str) -> list[Row]:
    """Return the rows with a target. `dataset` is a recorded one of a million transitions."""
    n = cores()
    return [
        *update_rows(),
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
            0.001,  # a load: the two differ by less than the machine's speed changes within a second
            1000,
            pinned=True,
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
