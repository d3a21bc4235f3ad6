"""`verify`: check a dataset's episodes, compare its metadata with them, and replay a sample in the environment.

scan          one pass over every episode: shapes, ends, numbers, bounds, duplicates, seeds, content hash
metadata      parts, levels and their returns, as offbench recorded them
resimulate    a sample of episodes replayed in the environment
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from gymnasium.spaces import Box

from offbench.common import seeds
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import JsonObject
from offbench.common.processes import blocking_workers, default_workers
from offbench.common.provenance import versions
from offbench.common.seeds import Purpose
from offbench.common.settings import check_count
from offbench.common.text import counted
from offbench.data import minari_store
from offbench.data.file_stamps import unchanged
from offbench.data.minari_reader import RecordedEpisode, episodes_of, open_minari, reading
from offbench.data.recorded_env import recorded_margin, recorded_mujoco
from offbench.envs.environments import box, parse_spec, same_bounds, time_limit, untrusted_env
from offbench.envs.margin_rule import MAX_RULE, MUJOCO_VERSIONS, SUM_RULE, with_margin
from offbench.envs.physics import margins_matter
from offbench.rollouts.rollouts import Rollouts, result
from offbench.verification.findings import Findings, Report
from offbench.verification.metadata import check_recorded_metadata
from offbench.verification.resimulate import ReplayResult, replay_episode
from offbench.verification.scan import ScanResult, scan

if TYPE_CHECKING:
    from minari import MinariDataset

EPISODES = 300  # replayed by default: half a minute for a million transitions
RULE_EPISODES = 10  # about how many are replayed under both rules for contact margins if the metadata name none
REQUIREMENT = {MAX_RULE: "mujoco<3.5", SUM_RULE: "mujoco>=3.5"}
MIN_TERMINATIONS = 3  # fewest terminations that are a fault if all are at the time limit
FEW_STEPS = 20_000  # up to this many steps are replayed without worker processes


def verify(dataset_id: str, *, episodes: int | None = None, workers: int | None = None) -> Report:
    """Check a local Minari dataset with flat Box spaces, recorded by offbench or not.

    Args:
        dataset_id: its id.
        episodes: how many are replayed in the environment, where that is possible (default: 300).
        workers: processes for it (default: one per core).

    Returns:
        The report; `report.ok` is False if it has findings. Damaged data are findings, not errors.

    Raises:
        OffbenchError: no such dataset, spaces other than flat Boxes, or it was replaced meanwhile.
    """
    with unchanged(dataset_id):
        return _verify(dataset_id, episodes, workers)


def _verify(dataset_id: str, episodes: int | None, workers: int | None) -> Report:
    report, findings = Report(dataset_id), Findings()
    if not minari_store.exists(dataset_id):
        minari_store.read_metadata(dataset_id)  # raises, and names the nearest id
    workers, episodes = (
        default_workers(workers),
        check_count("episodes", EPISODES if episodes is None else episodes, 0),
    )
    code = "metadata"
    try:
        metadata = minari_store.read_metadata(dataset_id)
        code = "unreadable"
        data = open_minari(dataset_id)
        box(data.observation_space, f"{dataset_id}: observations")
        box(data.action_space, f"{dataset_id}: actions")
        limit = _limit(metadata.get("env_spec"))
        with reading(dataset_id):
            scanned = scan(dataset_id, data, limit, findings)
    except DamagedError as error:
        text = str(error)
        findings.add(code, dataset_id, text.rpartition("; ")[0] or text)  # the finding has a remedy of its own
        report.findings = findings.all()
        return report
    report.transitions, report.episodes = scanned.steps, len(scanned.lengths)
    report.checked.append("every episode: shapes, types, ends, finite numbers, bounds, duplicates, seeds")
    if not scanned.steps:
        findings.add("empty", dataset_id)
    _check_counts(metadata, dataset_id, scanned, findings)
    _check_terminations(scanned, limit, findings)
    last = check_recorded_metadata(minari_store.read_provenance(metadata), scanned, limit, report, findings)
    chosen = _choose_episodes(scanned, limit, last, episodes)
    if episodes < 1:
        report.skipped.append("playing episodes again: none were requested")
    _replay(data, chosen, scanned, limit, metadata, workers, report, findings)
    report.findings = findings.all()
    return report


def _limit(env_spec: str | None) -> int | None:
    """Return the time limit that an EnvSpec (JSON) names, if it does."""
    with contextlib.suppress(Exception):  # of an EnvSpec that is damaged, which `_replay` reports
        return time_limit(parse_spec(env_spec or ""))
    return None


def _check_counts(metadata: JsonObject, dataset_id: str, scanned: ScanResult, findings: Findings) -> None:
    for key, count in (("total_steps", scanned.steps), ("total_episodes", len(scanned.lengths))):
        if metadata.get(key) != count:
            findings.add("counts", "metadata", f"{key} is {metadata.get(key)}, the data have {count}")
    if metadata.get("dataset_id") != dataset_id:
        findings.add("metadata", "metadata", f"it calls itself {metadata.get('dataset_id')!r}")


def _check_terminations(scanned: ScanResult, limit: int | None, findings: Findings) -> None:
    """Report time limits marked as terminations: every termination is exactly at the time limit."""
    lengths = [length for length, (terminated, _) in zip(scanned.lengths, scanned.ended, strict=True) if terminated]
    if limit is not None and len(lengths) >= MIN_TERMINATIONS and set(lengths) == {limit}:
        detail = f"all {len(lengths):,} terminations lie exactly at the time limit of {limit:,} steps"
        findings.add("timeouts-as-terminations", "ends", detail)


def _replay(
    data: MinariDataset,
    chosen: Sequence[int],
    scanned: ScanResult,
    limit: int | None,
    metadata: JsonObject,
    workers: int,
    report: Report,
    findings: Findings,
) -> None:
    """Replay the chosen episodes, each by the strictest method that it allows."""
    spec = metadata.get("env_spec")
    if not spec:
        report.skipped.append("playing episodes again: the dataset names no environment")
        return
    if not chosen or not _same_spaces(spec, data, report, findings):
        return
    recorded_version, here = recorded_mujoco(metadata), versions()["mujoco"]
    exact = recorded_version == here
    if recorded_version is not None and not exact:
        report.warnings.append(
            f"recorded with mujoco {recorded_version}, but {here} is installed: compared within a tolerance"
        )
    last_unknown = minari_store.read_provenance(metadata).final_observations == "repeated"
    steps = sum(scanned.lengths[i] for i in chosen)
    names = [int(data.episode_indices[i]) for i in chosen]
    with Rollouts(spec, blocking_workers(workers) if steps > FEW_STEPS else 0) as rollouts:

        def replay(env_spec: str, episodes: Iterable[RecordedEpisode]) -> list[ReplayResult]:
            jobs = [
                rollouts.call(replay_episode, env_spec, e, exact, last_unknown and bool(e.terminations[-1]))
                for e in episodes
            ]
            return [result(job) for job in jobs]

        rule = recorded_margin(metadata)
        if rule is None and margins_matter(spec):
            some = list(episodes_of(data, names[:: max(1, len(names) // RULE_EPISODES)]))
            off = {
                rule: sum(bool(v.faults) for v in replay(with_margin(spec, rule), some)) for rule in MUJOCO_VERSIONS
            }
            rule = min(off, key=off.__getitem__)
            if off[MAX_RULE] != off[SUM_RULE]:
                report.warnings.append(
                    f"recorded with the contact margins of MuJoCo {MUJOCO_VERSIONS[rule]}, as "
                    f"{counted(len(some), 'episode')} show; its metadata does not say. Add {REQUIREMENT[rule]!r} "
                    "to its requirements, so that policies are evaluated with them"
                )
        replays = replay(with_margin(spec, rule or MAX_RULE), episodes_of(data, names))
    at_limit = {int(data.episode_indices[i]) for i in chosen if _terminates_at(limit, scanned, i)}
    confirmed = at_limit and all(replay.checks_end for replay in replays if replay.index in at_limit)
    if confirmed and findings.withdraw("timeouts-as-terminations"):
        report.warnings.append(
            "every termination is exactly at the time limit, where the environment terminates too (episodes played "
            "again show it)"
        )
    _add_replays(replays, recorded_version if exact else None, report, findings)


def _terminates_at(limit: int | None, scanned: ScanResult, i: int) -> bool:
    return scanned.lengths[i] == limit and scanned.ended[i][0]


def _same_spaces(env_spec: str, data: MinariDataset, report: Report, findings: Findings) -> bool:
    """Return whether the environment can be made and has the dataset's spaces; report why not."""
    try:
        env = untrusted_env(env_spec, "playing episodes again")
    except OffbenchError as error:
        report.skipped.append(str(error))
        return False
    theirs = env.action_space
    same = env.observation_space.shape == data.observation_space.shape and theirs.shape == data.action_space.shape
    same = same and isinstance(theirs, Box) and same_bounds(theirs, data.action_space.low, data.action_space.high)
    env.close()
    if not same:
        findings.add("other-spaces", "metadata", f"{env.observation_space} and {theirs}")
    return same


def _choose_episodes(scanned: ScanResult, limit: int | None, last: Sequence[int], episodes: int) -> list[int]:
    """Return the episodes to replay: a random sample, the last of each part, and those that end at the limit."""
    valid = [i for i, good in enumerate(scanned.valid) if good]
    if not valid or episodes < 1:
        return []
    rng = seeds.generator(0, Purpose.SAMPLE)
    sample = rng.choice(valid, min(episodes, len(valid)), replace=False).tolist()
    suspects = [i for i in valid if _terminates_at(limit, scanned, i)][:episodes]
    return sorted({*sample, *suspects, *(i for i in last if scanned.valid[i])})


def _add_replays(replays: Sequence[ReplayResult], mujoco: str | None, report: Report, findings: Findings) -> None:
    exact = mujoco and not any(replay.how == "seed" and replay.rounding for replay in replays)
    ways = {
        "seed": f"from their seeds, {f'bit for bit (mujoco {mujoco})' if exact else 'within a tolerance'}",
        "step": "one step at a time from recorded states",
    }
    for how, method in ways.items():
        played = [replay for replay in replays if replay.how == how]
        if played:
            steps = sum(replay.steps for replay in played)
            report.checked.append(f"{counted(len(played), 'episode')} played again {method}: {counted(steps, 'step')}")
    if rounding := sum(replay.rounding for replay in replays):
        report.warnings.append(
            f"{counted(rounding, 'episode')} played again from their seeds differ, at first in the last bits only: "
            "the processor or C library that recorded them rounds differently"
        )
    open_ends = sum(replay.how != "none" and not replay.end for replay in replays)
    if open_ends:
        text = f"the {'ends' if open_ends > 1 else 'end'} of {counted(open_ends, 'episode')}"
        report.skipped.append(f"{text}: the last step cannot be played from its observation")
    left = sum(replay.how == "none" and not (replay.faults or replay.rounding) for replay in replays)
    if left:
        text = f"playing {counted(left, 'episode')} again"
        report.skipped.append(f"{text}: no seed, and no state to be set from observations")
    faultless = replays and not any(replay.faults or replay.how == "none" for replay in replays)
    if faultless and findings.withdraw("clipped-actions"):
        report.warnings.append(
            "many actions are equal to their least or greatest value inside the bounds; the environment executed them "
            "(the episodes played again show it), so these are limits of the behaviour policy"
        )
    for replay in replays:
        for code, detail in replay.faults:
            findings.add(code, f"episode {replay.index}", detail)
