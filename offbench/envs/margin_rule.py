"""The field of an EnvSpec that says by which rule contact margins combine."""

from __future__ import annotations

import json

from offbench.common.errors import OffbenchError

MARGIN_KEY = "contact_margin"  # the field's name in an EnvSpec and in metadata
MAX_RULE, SUM_RULE = "max", "sum"  # a contact's margin is the larger of its geoms' two margins, or their sum
LAST_WITH_MAX_RULE = "3.4.0"  # the last release of MuJoCo with that rule
MUJOCO_VERSIONS = {MAX_RULE: "before 3.5", SUM_RULE: "3.5 and later"}  # the versions that have each rule
REMOVED_FIELDS = ("apply_api_compatibility", "autoreset")  # fields of Gymnasium before 1.0, which later ones refuse


def with_margin(env_spec: str, rule: str) -> str:
    """Return an EnvSpec (JSON) that names the rule for contact margins."""
    plain = without_margin(env_spec)[0]
    return plain if rule == MAX_RULE else json.dumps(json.loads(plain) | {MARGIN_KEY: rule})


def without_margin(env_spec: str) -> tuple[str, str]:
    """Return Gymnasium's own EnvSpec (JSON), and the rule for contact margins.

    Raises:
        OffbenchError: the EnvSpec names an unknown rule.
    """
    fields = json.loads(env_spec)
    rule = fields.pop(MARGIN_KEY, MAX_RULE)
    if rule not in (MAX_RULE, SUM_RULE):
        raise OffbenchError(f"{MARGIN_KEY} must be {MAX_RULE} or {SUM_RULE}, not {rule!r}")
    plain = {name: value for name, value in fields.items() if name not in REMOVED_FIELDS}
    return (env_spec if plain == fields and MARGIN_KEY not in env_spec else json.dumps(plain)), rule
