"""What offbench recorded about a dataset, against the data: content hash, parts, seeds, levels and their returns."""

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
from offbench.verification.scan import Survey

SIGMAS = 6  # standard errors that a level's mean return may be off by,
SLACK = 0.02  # and by this share of the references' distance: rungs are chosen for their measured return


def check_claims(ours: Provenance, survey: Survey, limit: int | None, report: Report, findings: Findings) -> list[int]:
    """Check what offbench recorded about a dataset; return the last episode of each part."""
    last = [len(survey.lengths) - 1] if survey.lengths else []
    if ours.content_sha256 is not None:
        report.checked.append("the content hash")
        if ours.content_sha256 != survey.content.hexdigest():
            findings.add("content-hash", "metadata", f"recorded {ours.content_sha256[:12]}...")
    else:
        report.skipped.append("the content hash: none is recorded")
    if ours.parts is None:
        report.skipped.append("levels and returns: not recorded by offbench")
        return last
    try:
        if ours.seed is None or ours.level is None:
            raise ValueError("no seed or no level is recorded")
        cuts = _cuts(ours.parts, survey, findings)
        if cuts is not None:
            _levels(ours, ours.parts, findings)
            for index, (part, (first, end)) in enumerate(zip(ours.parts, cuts, strict=True)):
                _part(ours, part, index, range(first, end), survey, limit, findings)
            last = [end - 1 for _, end in cuts]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ZeroDivisionError, OverflowError) as error:
        findings.add("metadata", "metadata", f"{type(error).__name__}: {error}")
    report.checked.append("parts, seeds, level order and mean returns against the metadata")
    return last


def _cuts(parts: Sequence[JsonObject], survey: Survey, findings: Findings) -> list[tuple[int, int]] | None:
    """Return the episodes [first, end) of each part, or None if parts do not end where episodes do."""
    ends = np.cumsum(survey.lengths)
    wanted = np.cumsum([int(part["transitions"]) for part in parts])
    places = np.searchsorted(ends, wanted)
    if len(places) == 0 or places[-1] != len(ends) - 1 or (ends[places] != wanted).any():
        findings.add("parts", "metadata", f"parts end after {wanted.tolist()} transitions")
        return None
    return list(zip([0, *(places[:-1] + 1)], places + 1, strict=True))


def _references(ours: Provenance) -> tuple[float, float]:
    """Return the random and the expert return; infinity for an expert that was not trained yet."""
    references = {"expert": {"return": math.inf}} | ours.references
    return float(references["random"]["return"]), float(references["expert"]["return"])


def _levels(ours: Provenance, parts: Sequence[JsonObject], findings: Findings) -> None:
    """Check that the levels' own numbers agree with each other."""
    low, high = _references(ours)
    returns = {part["source"]: float(part["return"]) for part in parts if "return" in part}
    order = [returns[name] for name in ("uniform", "medium", "expert") if name in returns]
    if not low < high or order != sorted(order) or returns.get("medium", low) >= high:
        findings.add("level-order", "metadata", f"random {low:g}, expert {high:g}, parts {returns}")
    if ours.level in LEVELS and [p.source for p in LEVELS[ours.level]] != [p["source"] for p in parts]:
        findings.add("metadata", "metadata", f"level {ours.level} is not made of these parts")
    for part in parts:
        if "fraction" in part and abs(normalize(float(part["return"]), low, high) / 100 - part["fraction"]) > 0.01:
            findings.add(
                "level-order", f"part {part['source']}", f"its fraction {part['fraction']} is not its return's"
            )


def _part(
    ours: Provenance,
    part: JsonObject,
    index: int,
    chosen: range,
    survey: Survey,
    limit: int | None,
    out: Findings,
) -> None:
    """Check one part's seeds and mean return."""
    if part["source"] != "replay":
        for k, i in enumerate(chosen):
            if survey.seeds[i] != seeds.integer(ours.seed or 0, Purpose.RESET, index, k):
                out.add("wrong-seeds", f"episode {i}")
    if "return" not in part:
        return
    whole = [survey.returns[i] for i in chosen if survey.ended[i][0] or limit is None or survey.lengths[i] == limit]
    if not whole or not np.isfinite(whole).all():
        return
    count = int(part.get("episodes") or ours.references["random"]["episodes"])
    half = (float(part["interval"][1]) - float(part["interval"][0])) / 2 / 1.96
    # the spread of single returns: as measured here and as behind the recorded interval, whichever is wider
    spread = max(float(np.std(whole, ddof=1)) if len(whole) > 1 else 0.0, half * count**0.5)
    low, high = _references(ours)
    slack = SLACK * abs(high - low) if math.isfinite(high) else 0.0
    allowed = SIGMAS * (spread**2 / len(whole) + half**2) ** 0.5 + slack
    mean, recorded = float(np.mean(whole)), float(part["return"])
    if not abs(mean - recorded) <= allowed:
        detail = f"{mean:.1f} over {len(whole)} episodes, recorded {recorded:.1f}, plausible within {allowed:.1f}"
        out.add("wrong-level", f"part {part['source']}", detail)
