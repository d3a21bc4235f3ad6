"""Checks of offbench's metadata against the data: content hash, parts, seeds, levels and their returns."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from offbench.common import seeds
from offbench.common.files import JsonObject
from offbench.common.scores import normalize
from offbench.common.seeds import Purpose
from offbench.data.levels import LEVELS
from offbench.data.minari_store import Provenance
from offbench.verification.findings import Findings, Report
from offbench.verification.scan import ScanResult

SIGMAS = 6  # standard errors that a level's mean return may deviate by,
SLACK = 0.02  # additional tolerance, as a share of the references' distance: rungs are chosen by their measured return


def check_recorded_metadata(
    provenance: Provenance, scanned: ScanResult, limit: int | None, report: Report, findings: Findings
) -> list[int]:
    """Check what offbench recorded about a dataset; return the last episode of each part."""
    last = [len(scanned.lengths) - 1] if scanned.lengths else []
    if provenance.content_sha256 is not None:
        report.checked.append("the content hash")
        if provenance.content_sha256 != scanned.content.hexdigest():
            findings.add("content-hash", "metadata", f"recorded {provenance.content_sha256[:12]}...")
    else:
        report.skipped.append("the content hash: none is recorded")
    if provenance.parts is None:
        report.skipped.append("levels and returns: not recorded by offbench")
        return last
    try:
        if provenance.seed is None or provenance.level is None:
            raise ValueError("no seed or no level is recorded")
        ranges = _part_ranges(provenance.parts, scanned, findings)
        if ranges is not None:
            _check_levels(provenance, provenance.parts, findings)
            for index, (part, (first, end)) in enumerate(zip(provenance.parts, ranges, strict=True)):
                _check_part(provenance, part, index, range(first, end), scanned, limit, findings)
            last = [end - 1 for _, end in ranges]
            _add_checked(provenance.parts, report)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ZeroDivisionError, OverflowError) as error:
        findings.add("metadata", "metadata", f"{type(error).__name__}: {error}")
    return last


def _add_checked(parts: Sequence[JsonObject], report: Report) -> None:
    """Add what of the metadata was checked to a report; a replay has no seeds, and not every policy has a return."""
    checked = ["sizes of the parts"]
    if any(part["source"] != "replay" for part in parts):
        checked.append("seeds")
    if any("return" in part for part in parts):
        checked.append("level order and mean returns")
    report.checked.append(f"{', '.join(checked)} against the metadata")


def _part_ranges(parts: Sequence[JsonObject], scanned: ScanResult, findings: Findings) -> list[tuple[int, int]] | None:
    """Return the range of episodes (first, end) of each part, or None if a part does not end with an episode."""
    ends = np.cumsum(scanned.lengths)
    wanted = np.cumsum([int(part["transitions"]) for part in parts])
    last_episodes = np.searchsorted(ends, wanted)
    if len(last_episodes) == 0 or last_episodes[-1] != len(ends) - 1 or (ends[last_episodes] != wanted).any():
        findings.add("parts", "metadata", f"parts end after {wanted.tolist()} transitions")
        return None
    return list(zip([0, *(last_episodes[:-1] + 1)], last_episodes + 1, strict=True))


def _references(provenance: Provenance) -> tuple[float, float]:
    """Return the random and the expert return; infinity for an expert that was not trained yet."""
    references = {"expert": {"return": math.inf}} | provenance.references
    return float(references["random"]["return"]), float(references["expert"]["return"])


def _check_levels(provenance: Provenance, parts: Sequence[JsonObject], findings: Findings) -> None:
    """Check that the recorded returns and fractions of the levels agree with each other."""
    low, high = _references(provenance)
    returns = {part["source"]: float(part["return"]) for part in parts if "return" in part}
    order = [returns[name] for name in ("uniform", "medium", "expert") if name in returns]
    if not low < high or order != sorted(order) or returns.get("medium", low) >= high:
        findings.add("level-order", "metadata", f"random {low:g}, expert {high:g}, parts {returns}")
    if provenance.level in LEVELS and [p.source for p in LEVELS[provenance.level]] != [p["source"] for p in parts]:
        findings.add("metadata", "metadata", f"level {provenance.level} is not made of these parts")
    for part in parts:
        if "fraction" in part and abs(normalize(float(part["return"]), low, high) / 100 - part["fraction"]) > 0.01:
            findings.add(
                "level-order", f"part {part['source']}", f"its fraction {part['fraction']} is not its return's"
            )


def _check_part(
    provenance: Provenance,
    part: JsonObject,
    index: int,
    chosen: range,
    scanned: ScanResult,
    limit: int | None,
    out: Findings,
) -> None:
    """Check one part's seeds and mean return."""
    if part["source"] != "replay":
        for k, i in enumerate(chosen):
            if scanned.seeds[i] != seeds.integer(provenance.seed or 0, Purpose.RESET, index, k):
                out.add("wrong-seeds", f"episode {i}")
    if "return" not in part:
        return
    last = chosen[-1]  # the only episode of a part that may be cut short
    whole = scanned.ended[last][0] or scanned.lengths[last] == limit
    complete = [scanned.returns[i] for i in (chosen if whole else chosen[:-1])]
    if not complete or not np.isfinite(complete).all():
        return
    count = int(part.get("episodes") or provenance.references["random"]["episodes"])
    half = (float(part["interval"][1]) - float(part["interval"][0])) / 2 / 1.96
    # standard deviation of returns: the larger of the data's and the recorded interval's
    spread = max(float(np.std(complete, ddof=1)) if len(complete) > 1 else 0.0, half * count**0.5)
    low, high = _references(provenance)
    slack = SLACK * abs(high - low) if math.isfinite(high) else 0.0
    allowed = SIGMAS * (spread**2 / len(complete) + half**2) ** 0.5 + slack
    mean, recorded = float(np.mean(complete)), float(part["return"])
    if not abs(mean - recorded) <= allowed:
        detail = f"{mean:.1f} over {len(complete)} episodes, recorded {recorded:.1f}, plausible within {allowed:.1f}"
        out.add("wrong-level", f"part {part['source']}", detail)
