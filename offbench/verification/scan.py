"""One pass over all episodes: checks that need no environment, and the data that later checks need."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from offbench.common.arrays import Array
from offbench.common.progress import Progress
from offbench.data.content_hash import ContentHash
from offbench.data.minari_reader import RecordedEpisode, episodes_of, shape_faults
from offbench.verification.findings import Findings

if TYPE_CHECKING:
    from minari import MinariDataset

MIN_CLIPPED = 10  # minimum number of equal actions at a least or greatest value that count as clipped,
MIN_CLIPPED_SHARE = 0.001  # their minimum share of all actions
INSIDE = 1e-4  # share of the space's range: a value nearer than this to the space's bound counts as the bound


@dataclass
class ScanResult:
    """The results of one pass over the episodes."""

    content: ContentHash = field(default_factory=ContentHash)
    lengths: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    seeds: list[int | None] = field(default_factory=list)
    ended: list[tuple[bool, bool]] = field(default_factory=list)
    valid: list[bool] = field(default_factory=list)  # whether the arrays fit together and hold numbers

    @property
    def steps(self) -> int:
        """Transitions of all episodes."""
        return sum(self.lengths)


def scan(dataset_id: str, data: MinariDataset, limit: int | None, findings: Findings) -> ScanResult:
    """Check every episode of a MinariDataset once; `limit` is the environment's time limit, if it has one."""
    result, clipping, duplicates = ScanResult(), _ClippingDetector(data.action_space), _DuplicateDetector()
    with Progress(int(data.total_steps), f"verifying {dataset_id}") as progress:
        for episode in episodes_of(data):
            where = f"episode {episode.index}"
            numeric = all(array.dtype.kind in "fiub" for array in episode.arrays)
            valid = numeric and _check(episode, data.observation_space, data.action_space, limit, where, findings)
            ends = tuple(bool(flags[-1]) if flags.size else False for flags in episode.arrays[3:])
            result.lengths.append(len(episode))
            result.seeds.append(episode.seed)
            result.ended.append((ends[0], ends[1]))
            result.valid.append(valid)
            result.returns.append(float(np.sum(episode.rewards, dtype=np.float64)) if numeric else float("nan"))
            if numeric:
                fit = episode.terminations.shape == episode.truncations.shape and episode.terminations.size
                flags = episode.arrays[3:] if fit else [[end] for end in ends]
                result.content.add(episode.observations, episode.actions, episode.rewards, *flags)
                duplicates.add(episode, findings)
            else:
                findings.add("dtype", where, "not numbers")
            if valid:
                clipping.add(episode.actions)
            progress.to(progress.done + len(episode))
    clipping.report(findings)
    _check_seeds(result.seeds, findings)
    return result


def _check(
    e: RecordedEpisode,
    observations: gym.spaces.Box,
    actions: gym.spaces.Box,
    limit: int | None,
    where: str,
    out: Findings,
) -> bool:
    """Check one episode by itself; return whether its arrays fit together, so that it can be replayed."""
    valid = True
    for fault in shape_faults(e, observations, actions):
        out.add("shape", where, fault)
        valid = False
    for name, space in (("observations", observations), ("actions", actions)):
        if getattr(e, name).dtype != space.dtype:
            out.add("dtype", where, f"{name} are {getattr(e, name).dtype}, their space is {space.dtype}")
    for name in ("terminations", "truncations"):
        if getattr(e, name).dtype != np.bool_:
            out.add("dtype", where, f"{name} are {getattr(e, name).dtype}, not bool")
    for name in ("observations", "actions", "rewards"):
        array = getattr(e, name)
        if not np.issubdtype(array.dtype, np.number) or not np.isfinite(array).all():
            out.add("not-finite", where, name)
            valid = False
    if valid:
        _check_ends(e, limit, where, out)
        _check_bounds(e, observations, actions, where, out)
    return valid


def _check_ends(e: RecordedEpisode, limit: int | None, where: str, out: Findings) -> None:
    ends = e.terminations.astype(bool) | e.truncations.astype(bool)
    if ends[:-1].any():
        out.add("early-end", where, f"step {int(np.flatnonzero(ends)[0])} of {len(e)}")
    if not ends[-1]:
        out.add("no-end", where)
    if limit is not None and len(e) > limit:
        out.add("too-long", where, f"{len(e)} steps, the limit is {limit}")


def _check_bounds(
    e: RecordedEpisode, observations: gym.spaces.Box, actions: gym.spaces.Box, where: str, out: Findings
) -> None:
    if ((e.observations < observations.low) | (e.observations > observations.high)).any():
        out.add("outside-space", where)
    over = np.maximum(actions.low - e.actions, e.actions - actions.high)
    if (over > 0).any():
        out.add("action-bounds", where, f"by up to {over.max():g}")


class _ClippingDetector:
    """Finds actions clipped after execution: many equal ones at a least or greatest value inside the bounds."""

    def __init__(self, space: gym.spaces.Box) -> None:
        self.space, self.total = space, 0
        self.ends = [np.full(space.shape, sign * -np.inf) for sign in (-1, 1)]  # lowest and highest seen so far
        self.counts = [np.zeros(space.shape, np.int64) for _ in range(2)]

    def add(self, actions: Array) -> None:
        self.total += len(actions)
        for side, (sign, best) in enumerate(((-1, actions.min(0)), (1, actions.max(0)))):
            further = sign * best > sign * self.ends[side]
            self.ends[side] = np.where(further, best, self.ends[side])
            self.counts[side] = np.where(further, 0, self.counts[side]) + (actions == self.ends[side]).sum(0)

    def report(self, findings: Findings) -> None:
        low, high = self.space.low.astype(np.float64), self.space.high.astype(np.float64)
        near = INSIDE * np.where(np.isfinite(high - low), high - low, 0.0)
        inside = (self.ends[0] > low + near, self.ends[1] < high - near)
        for side, name in enumerate(("at least", "at most")):
            clipped = inside[side] & (self.counts[side] >= max(MIN_CLIPPED, MIN_CLIPPED_SHARE * self.total))
            for i in np.argwhere(clipped):
                index = tuple(i)
                # one constant action is no clipping
                if self.counts[side][index] < self.total:
                    detail = f"{self.counts[side][index]:,} are exactly {self.ends[side][index]:g}, all {name} that"
                    findings.add("clipped-actions", f"action {'.'.join(map(str, index))}", detail)


class _DuplicateDetector:
    """Finds episodes that occur twice."""

    def __init__(self) -> None:
        self.first_index: dict[bytes, int] = {}

    def add(self, e: RecordedEpisode, findings: Findings) -> None:
        digest = hashlib.blake2b(digest_size=16)
        for array in (e.observations, e.actions, e.rewards):
            digest.update(np.ascontiguousarray(array).data)
        first = self.first_index.setdefault(digest.digest(), e.index)
        if first != e.index:
            findings.add("duplicate-episodes", f"episodes {first} and {e.index}")


def _check_seeds(seeds: list[int | None], findings: Findings) -> None:
    first_episode: dict[int, int] = {}
    for i, seed in enumerate(seeds):
        if seed is not None and first_episode.setdefault(seed, i) != i:
            findings.add("repeated-seeds", f"episodes {first_episode[seed]} and {i}", f"seed {seed}")
