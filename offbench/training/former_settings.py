"""Settings that algorithms had in earlier versions, in the config.json of older runs."""

from __future__ import annotations

from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject

# Each with the value that has no effect. bdb_plus now has some of bdb's; the others lowered the scores and were
# removed (docs/results.md).
REMOVED: JsonObject = {"uncertainty": "absolute", "uncertainty_scale": 1.0, "cloning_steps": 0}
MOVED: JsonObject = {
    "beta_max": 1.0,
    "beta_target": 0.05,
    "beta_learning_rate": 3e-4,
    "critic_penalty": "none",
    "penalty_weight": 1.0,
    "penalty_actions": 10,
}
FORMER_SETTINGS: dict[str, JsonObject] = {"bdb": MOVED | REMOVED, "bdb_plus": REMOVED}


def current_settings(algorithm: str, settings: JsonObject, where: str) -> JsonObject:
    """Return a run's recorded settings without those that its algorithm had in an earlier version only.

    Raises:
        OffbenchError: one of them had an effect, so that the run can be reported but not resumed or restored.
    """
    former = FORMER_SETTINGS.get(algorithm, {})
    used = {name: settings[name] for name, off in former.items() if settings.get(name, off) != off}
    if algorithm == "bdb" and settings.get("beta") == "learned":
        used["beta"] = "learned"
    if used:
        name, value = next(iter(used.items()))
        fate = "was removed" if name in REMOVED else "is a setting of bdb_plus now"
        raise OffbenchError(
            f"{where} was trained by an earlier version of {algorithm} with {name} = {value!r}, which {fate}; the run "
            "can still be reported and evaluated, but not resumed"
        )
    return {name: value for name, value in settings.items() if name not in former}
