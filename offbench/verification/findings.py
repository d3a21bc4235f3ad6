"""The faults that `verify` reports: a code for programs, a description and a remedy for people."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field

from offbench.common.text import counted

RECORD_AGAIN = "record or download the dataset again"
FAULTS: dict[str, tuple[str, str]] = {
    # code: (what it means, what to do)
    "unreadable": ("the files cannot be read", RECORD_AGAIN),
    "empty": ("there is no transition", RECORD_AGAIN),
    "counts": ("the metadata's counts are not those of the data", RECORD_AGAIN),
    "shape": ("arrays do not fit the spaces or each other (T + 1 observations, T of all else)", RECORD_AGAIN),
    "dtype": ("numbers are of another type than their space", "convert them, or correct the space"),
    "not-finite": ("NaN or infinite numbers", "filter these episodes out of the dataset"),
    "outside-space": ("observations outside the observation space", "correct the space's bounds or the data"),
    "action-bounds": (
        "actions outside the action space",
        "clip them to what the environment executed; rewards that have an action cost then differ from its own",
    ),
    "clipped-actions": (
        "actions are cut off at a bound that is not the space's: other actions were executed",
        "record what the environment was given",
    ),
    "early-end": ("an end is flagged before the last step", "cut the episode there"),
    "no-end": ("the last step is flagged neither terminated nor truncated", "flag the cut as a truncation"),
    "too-long": ("an episode is longer than the environment's time limit", "cut it, or correct the env_spec"),
    "duplicate-episodes": ("the same episode twice", "keep one of them"),
    "repeated-seeds": ("several episodes were reset with the same seed", "give every episode its own"),
    "wrong-seeds": ("seeds are not those of the recorded seed and part", RECORD_AGAIN),
    "content-hash": ("the arrays are not those that were recorded", RECORD_AGAIN),
    "metadata": ("the metadata about the recording is damaged", RECORD_AGAIN),
    "parts": ("the recorded parts do not end where episodes end", RECORD_AGAIN),
    "wrong-level": (
        "a part's mean return is not the one measured for its level: levels swapped, or other data",
        RECORD_AGAIN,
    ),
    "level-order": ("levels are out of order: random, medium, expert", "correct the metadata, or record again"),
    "other-spaces": ("the environment has other spaces than the dataset", "correct the env_spec"),
    "shifted-observations": (
        "observations lie one step off their actions",
        "align them: row t before action t, row t + 1 after it",
    ),
    "other-start": ("the seed resets the environment to another start", "correct the seeds or the env_spec"),
    "other-physics": (
        "the environment moves differently from what was recorded",
        "use the simulator and the env_spec it was recorded with",
    ),
    "not-replayable": ("the environment fails when the episode is played again", "correct the data or the env_spec"),
    "other-rewards": ("the environment gives other rewards", "correct the rewards or the env_spec's kwargs"),
    "timeouts-as-terminations": (
        "marked as terminated where the environment does not terminate: bootstrapping stops wrongly",
        "mark these ends as truncations",
    ),
    "terminations-as-timeouts": (
        "the environment terminates where the data say truncated or nothing",
        "mark these ends as terminations",
    ),
    "steps-after-end": ("there are steps after the environment ended the episode", "cut the episodes there"),
}


@dataclass(frozen=True)
class Finding:
    """One type of fault, and where in the dataset it occurs."""

    code: str
    where: str
    what: str
    remedy: str
    count: int

    def line(self) -> str:
        """Return it as one line."""
        return f"{self.code}: {self.where}: {self.what}; {self.remedy}"


class Findings:
    """Collects faults, in one finding per code, however often it occurs."""

    SHOWN = 3

    def __init__(self) -> None:
        self._seen: dict[str, list[tuple[str, str]]] = {}

    def add(self, code: str, where: str, detail: str = "") -> None:
        """Record one occurrence. `detail` says more than the code's description."""
        assert code in FAULTS, code
        self._seen.setdefault(code, []).append((where, detail))

    def withdraw(self, code: str) -> bool:
        """Remove all occurrences of a fault; return whether there were any."""
        return self._seen.pop(code, None) is not None

    def all(self) -> tuple[Finding, ...]:
        """Return the findings in the order of FAULTS."""
        return tuple(self._finding(code) for code in FAULTS if code in self._seen)

    def _finding(self, code: str) -> Finding:
        seen, (what, remedy) = self._seen[code], FAULTS[code]
        locations = list(dict.fromkeys(where for where, _ in seen))
        where = ", ".join(locations[: self.SHOWN])
        if len(locations) > self.SHOWN:
            where += f" and {len(locations) - self.SHOWN:,} more"
        detail = next((detail for _, detail in seen if detail), "")
        return Finding(code, where, f"{what} ({detail})" if detail else what, remedy, len(locations))


@dataclass
class Report:
    """What `verify` checked, and its findings."""

    dataset_id: str
    transitions: int = 0
    episodes: int = 0
    findings: tuple[Finding, ...] = ()
    checked: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True if there are no findings."""
        return not self.findings

    def lines(self) -> list[str]:
        """Return the report as text."""
        lines = [f"{self.dataset_id}: {counted(self.transitions, 'transition')}, {counted(self.episodes, 'episode')}"]
        for title, items in (("checked", self.checked), ("skipped", self.skipped), ("warning", self.warnings)):
            lines += [f"  {title}  {item}" for item in items]
        lines += [f"  FOUND    {finding.line()}" for finding in self.findings]
        return [*lines, "no problems found" if self.ok else counted(len(self.findings), "finding")]

    def to_json(self) -> str:
        """Return the report as JSON."""
        return json.dumps({"ok": self.ok} | dataclasses.asdict(self), indent=1)
