"""`verify`: is a dataset what it says? Its episodes, its metadata against them, and a sample of them played again.

scan          one pass over every episode: shapes, ends, numbers, bounds, duplicates, seeds, content hash
metadata      parts, levels and their returns, as offbench recorded them
resimulate    a sample of episodes played again in the environment
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from gymnasium.spaces import Box

from offbench.common import seeds
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import JsonObject
from offbench.common.processes import default_workers
from offbench.common.provenance import versions
from offbench.common.seeds import Purpose
from offbench.common.text import counted
from offbench.data import minari_store
from offbench.data.file_stamps import unchanged
from offbench.data.minari_reader import Recorded, episodes_of, open_minari, reading
from offbench.data.recorded_env import margins_matter, recorded_margin, recorded_mujoco
from offbench.envs.environments import box, same_bounds, untrusted_env
from offbench.envs.margin_rule import ADDED, EARLIER, SINCE, with_margin
from offbench.rollouts.rollouts import Rollouts, result
from offbench.verification.findings import Findings, Report
from offbench.verification.metadata import check_claims
from offbench.verification.resimulate import Verdict, check
from offbench.verification.scan import Survey, scan

if TYPE_CHECKING:
    from minari import MinariDataset

EPISODES = 300  # played again by default: half a minute for a million transitions
SOME = 10  # of them, about, that are played under both rules for contact margins if the metadata name none
REQUIREMENT = {EARLIER: "mujoco<3.5", ADDED: "mujoco>=3.5"}
SEVERAL = 3  # terminations at the time limit, and none elsewhere, are no coincidence
FEW = 20_000  # steps to play again that are not worth worker processes


def verify(dataset_id: str, *, episodes: int | None = None, workers: int | None = None) -> Report:
    """Check a local Minari dataset with flat Box spaces, recorded by offbench or not.

    Args:
        dataset_id: its id.
        episodes: how many are played again in the environment, where that is possible (default: 300).
        workers: processes for it (default: one per core).

    Returns:
        The report; `report.ok` is False if something is off. Damaged data are findings, not errors.

    Raises:
        OffbenchError: no such dataset, spaces other than flat Boxes, or it was replaced meanwhile.
    """
    with unchanged(dataset_id):
        return _verify(dataset_id, episodes, workers)


def _verify(dataset_id: str, episodes: int | None, workers: int | None) -> Report:
    report, findings = Report(dataset_id), Findings()
    if not minari_store.exists(dataset_id):
        minari_store.read_metadata(dataset_id)  # raises, and names the nearest id
    workers, episodes = default_workers(workers), EPISODES if episodes is None else episodes
    code = "metadata"
    try:
        metadata = minari_store.read_metadata(dataset_id)
        code = "unreadable"
        data = open_minari(dataset_id)
        box(data.observation_space, f"{dataset_id}: observations")
        box(data.action_space, f"{dataset_id}: actions")
        limit = _limit(metadata.get("env_spec"))
        with reading(dataset_id):
            survey = scan(dataset_id, data, limit, findings)
    except DamagedError as error:
        text = str(error)
        findings.add(code, dataset_id, text.rpartition("; ")[0] or text)  # the finding has a remedy of its own
        report.findings = findings.all()
        return report
    report.transitions, report.episodes = survey.steps, len(survey.lengths)
    report.checked.append("every episode: shapes, types, ends, finite numbers, bounds, duplicates, seeds")
    if not survey.steps:
        findings.add("empty", dataset_id)
    _counts(metadata, dataset_id, survey, findings)
    _terminations(survey, limit, findings)
    last = check_claims(minari_store.provenance(metadata), survey, limit, report, findings)
    chosen = _choose(survey, limit, last, episodes)
    _play(data, chosen, survey, metadata, workers, report, findings)
    report.findings = findings.all()
    return report


def _limit(spec: str | None) -> int | None:
    """Return the time limit that an EnvSpec (JSON) names, if it does."""
    try:
        limit = json.loads(spec or "null")["max_episode_steps"]
    except (TypeError, KeyError, ValueError, RecursionError):
        return None
    return limit if isinstance(limit, int) and limit > 0 else None


def _counts(metadata: JsonObject, dataset_id: str, survey: Survey, findings: Findings) -> None:
    for key, count in (("total_steps", survey.steps), ("total_episodes", len(survey.lengths))):
        if metadata.get(key) != count:
            findings.add("counts", "metadata", f"{key} is {metadata.get(key)}, the data have {count}")
    if metadata.get("dataset_id") != dataset_id:
        findings.add("metadata", "metadata", f"it calls itself {metadata.get('dataset_id')!r}")


def _terminations(survey: Survey, limit: int | None, findings: Findings) -> None:
    """Report an environment's clock marked as termination: every termination lies exactly at the time limit."""
    lengths = [length for length, (terminated, _) in zip(survey.lengths, survey.ended, strict=True) if terminated]
    if limit is not None and len(lengths) >= SEVERAL and set(lengths) == {limit}:
        detail = f"all {len(lengths):,} terminations lie exactly at the time limit of {limit:,} steps"
        findings.add("timeouts-as-terminations", "ends", detail)


def _play(
    data: MinariDataset,
    chosen: Sequence[int],
    survey: Survey,
    metadata: JsonObject,
    workers: int,
    report: Report,
    findings: Findings,
) -> None:
    """Play the chosen episodes again, by the strictest means that each allows."""
    spec = metadata.get("env_spec")
    if not spec:
        report.skipped.append("playing episodes again: the dataset names no environment")
        return
    if not chosen or not _same_spaces(spec, data, report, findings):
        return
    made, here = recorded_mujoco(metadata), versions()["mujoco"]
    exact = made == here
    if made is not None and not exact:
        report.warnings.append(f"recorded with mujoco {made}, installed is {here}: compared within a tolerance")
    last_unknown = minari_store.provenance(metadata).final_observations == "repeated"
    steps = sum(survey.lengths[i] for i in chosen)
    names = [int(data.episode_indices[i]) for i in chosen]
    with Rollouts(spec, workers if workers > 1 and steps > FEW else 0) as rollouts:

        def replay(spec: str, episodes: Iterable[Recorded]) -> list[Verdict]:
            jobs = [rollouts.call(check, spec, e, exact, last_unknown and bool(e.terminations[-1])) for e in episodes]
            return [result(job) for job in jobs]

        rule = recorded_margin(metadata)
        if rule is None and margins_matter(spec):
            some = list(episodes_of(data, names[:: max(1, len(names) // SOME)]))
            off = {rule: sum(bool(v.faults) for v in replay(with_margin(spec, rule), some)) for rule in SINCE}
            rule = min(off, key=off.__getitem__)
            if off[EARLIER] != off[ADDED]:
                report.warnings.append(
                    f"recorded with the contact margins of MuJoCo {SINCE[rule]}, as {counted(len(some), 'episode')} "
                    f"show, and its metadata do not tell: add {REQUIREMENT[rule]!r} to its requirements, so that "
                    "policies are evaluated with them"
                )
        verdicts = replay(with_margin(spec, rule or EARLIER), episodes_of(data, names))
    _report(verdicts, made if exact else None, report, findings)


def _same_spaces(spec: str, data: MinariDataset, report: Report, findings: Findings) -> bool:
    """Return whether the environment can be made and has the dataset's spaces; report why not."""
    try:
        env = untrusted_env(spec, "playing episodes again")
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


def _choose(survey: Survey, limit: int | None, last: Sequence[int], episodes: int) -> list[int]:
    """Return the episodes to play again: a random sample, the last of each part, and those that end at the limit."""
    sound = [i for i, good in enumerate(survey.sound) if good]
    if not sound or episodes < 1:
        return []
    rng = seeds.generator(0, Purpose.SAMPLE)
    sample = rng.choice(sound, min(episodes, len(sound)), replace=False).tolist()
    suspects = [i for i in sound if survey.lengths[i] == limit and survey.ended[i][0]][:episodes]
    return sorted({*sample, *suspects, *(i for i in last if survey.sound[i])})


def _report(verdicts: Sequence[Verdict], mujoco: str | None, report: Report, findings: Findings) -> None:
    ways = {
        "seed": f"from their seeds, {f'bit for bit (mujoco {mujoco})' if mujoco else 'within a tolerance'}",
        "step": "one step at a time from recorded states",
    }
    for how, words in ways.items():
        played = [verdict for verdict in verdicts if verdict.how == how]
        if played:
            steps = sum(verdict.steps for verdict in played)
            report.checked.append(f"{counted(len(played), 'episode')} played again {words}: {counted(steps, 'step')}")
    open_ends = sum(verdict.how != "none" and not verdict.end for verdict in verdicts)
    if open_ends:
        words = f"the {'ends' if open_ends > 1 else 'end'} of {counted(open_ends, 'episode')}"
        report.skipped.append(f"{words}: the last step cannot be played from its observation")
    left = sum(verdict.how == "none" for verdict in verdicts)
    if left:
        words = f"playing {counted(left, 'episode')} again"
        report.skipped.append(f"{words}: no seed, and no state to be set from observations")
    for verdict in verdicts:
        for code, detail in verdict.faults:
            findings.add(code, f"episode {verdict.index}", detail)
