"""Run the rows, write docs/benchmarks-KIND.md (of processor), and say which targets were missed."""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import statistics
import tempfile
from pathlib import Path
from typing import Any

from offbench.common.files import write_bytes
from offbench.common.processes import cores
from offbench.common.provenance import hardware, versions
from offbench.common.tables import markdown
from tests.speed.rows import PEERS, Row, growth, rows
from tests.speed.side import Side

DOCS = Path(__file__).parent.parent.parent / "docs"


def measure(row: Row, quick: bool) -> dict[str, Any]:
    """Let two sides take turns; return the median ratio, its range, and both sides' rates and memory."""
    seconds, rounds = (0.5, 1) if quick else (row.seconds, row.rounds)
    core = max(os.sched_getaffinity(0)) if row.pinned and hasattr(os, "sched_getaffinity") else None
    ours, theirs = (Side([*command], environment(), core) for command in (row.ours, row.theirs))
    try:
        pairs = [(ours.rate(seconds), theirs.rate(seconds)) for _ in range(rounds)]
    finally:
        ours.close()
        theirs.close()
    ratios = [a / b for a, b in pairs]
    return {
        "name": row.name,
        "ratio": statistics.median(ratios),
        "low": min(ratios),
        "high": max(ratios),
        "ours": statistics.median(a for a, _ in pairs),
        "theirs": statistics.median(b for _, b in pairs),
        "memory": (ours.memory, theirs.memory),
        "at_least": row.at_least,
        "aim": row.aim,
    }


def environment() -> dict[str, str]:
    """One thread a process, whatever it computes with; this package is found from any folder."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return os.environ | one | {"PYTHONPATH": str(DOCS.parent)}


def line(found: dict[str, Any]) -> list[str]:
    """Return a result as a table row."""
    targets = "" if found["at_least"] is None else f"{found['at_least']:g} / {found['aim']:g}"
    met = "" if found["at_least"] is None else ("yes" if found["ratio"] >= found["at_least"] else "**no**")
    return [
        found["name"],
        f"**{found['ratio']:.2f}**",
        f"{found['low']:.2f} to {found['high']:.2f}",
        targets,
        met,
        f"{found['ours']:,.1f}",
        f"{found['theirs']:,.1f}",
        " / ".join(f"{value:,.0f}" for value in found["memory"]),
    ]


def page(results: list[dict[str, Any]], grown: list[tuple[str, dict[str, Any]]]) -> str:
    """Return the page: the fixed text with this run's tables in it."""
    made = hardware()
    pins = (PEERS.parent.parent / "pins.txt").read_text(encoding="utf-8").split()
    peers = ", ".join(pin.replace("==", " ") for pin in pins if pin.startswith(("d3rlpy", "jax=", "optax")))
    where = (
        f"{datetime.date.today().isoformat()}, {made['processor']} ({made['vectors']}), {cores()} cores, "
        f"{platform.system()}; "
        + ", ".join(f"{name} {version}" for name, version in versions().items())
        + f"; {peers}"
    )
    header = [
        "ours vs theirs",
        "ratio",
        "range",
        "at least / aim",
        "met",
        "ours /s",
        "theirs /s",
        "peak MB ours / theirs",
    ]
    kinds = {"stack": "td3_bc, one process", "size": "td3_bc on a dataset of", "workers": "evaluation with"}
    grown_rows = [
        [kinds[found["name"]], what, f"{found['ratio']:.2f}", f"{found['memory'][0]:,.0f}"] for what, found in grown
    ]
    text = (Path(__file__).parent / "page.md").read_text(encoding="utf-8")
    return text.format(
        vectors=made["vectors"],
        where=where,
        table="\n".join(markdown(header, [line(found) for found in results])),
        growth="\n".join(
            markdown(
                ["", "with", "units a second, against the smallest (1 run, 100,000 transitions, 1 worker)", "peak MB"],
                grown_rows,
            )
        ),
    )


def main() -> None:
    """Run everything, in a folder of its own."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="half a second a side: does it work? Writes nothing")
    parser.add_argument("--only", default="", help="rows whose name holds this; prints, writes nothing")
    arguments = parser.parse_args()
    if not PEERS.exists():
        raise SystemExit(f"no {PEERS}: run `make bench`, which installs d3rlpy and JAX there")
    with tempfile.TemporaryDirectory() as place:
        os.environ |= {"MINARI_DATASETS_PATH": f"{place}/minari", "OFFBENCH_CACHE": f"{place}/cache"}
        from offbench.data.collect import collect

        name = collect("hopper", "medium", steps=20_000 if arguments.quick else 1_000_000)
        results = []
        for row in rows(name):
            if arguments.only in row.name:
                results.append(measure(row, arguments.quick))
                print(" | ".join(line(results[-1])), flush=True)
        grown = []
        for what, row in growth():
            if arguments.only in row.name:
                grown.append((what, measure(row, arguments.quick)))
                print(row.name, what, f"{grown[-1][1]['ratio']:.2f}", flush=True)
    if not arguments.quick and not arguments.only:
        path = DOCS / f"benchmarks-{hardware()['vectors'].lower()}.md"
        write_bytes(path, page(results, grown).encode())
        missed = [found["name"] for found in results if found["at_least"] and found["ratio"] < found["at_least"]]
        print(f"docs/{path.name} written; targets missed: {', '.join(missed) or 'none'}")


if __name__ == "__main__":
    main()
