"""The field of an EnvSpec that says by which rule contact margins combine."""

from __future__ import annotations

import json

from offbench.common.errors import OffbenchError

MARGIN = "contact_margin"
EARLIER, ADDED = "max", "sum"  # a contact's margin: the larger of its geoms' two, or their sum
REMOVED_FIELDS = ("apply_api_compatibility", "autoreset")  # fields of Gymnasium before 1.0, which later ones refuse
LAST_EARLIER = "3.4.0"  # the last release with the earlier rule
MUJOCO_VERSIONS = {EARLIER: "before 3.5", ADDED: "3.5 and later"}  # that have each rule


def with_margin(env_spec: str, rule: str) -> str:
    """Return an EnvSpec (JSON) that names the rule for contact margins."""
    plain = without_margin(env_spec)[0]
    return plain if rule == EARLIER else json.dumps(json.loads(plain) | {MARGIN: rule})


def without_margin(env_spec: str) -> tuple[str, str]:
    """Return Gymnasium's own EnvSpec (JSON), and the rule for contact margins.

    Raises:
        OffbenchError: the EnvSpec names an unknown rule.
    """
    fields = json.loads(env_spec)
    rule = fields.pop(MARGIN, EARLIER)
    if rule not in (EARLIER, ADDED):
        raise OffbenchError(f"{MARGIN} must be {EARLIER} or {ADDED}, not {rule!r}")
    plain = {name: value for name, value in fields.items() if name not in REMOVED_FIELDS}
    return (env_spec if plain == fields and MARGIN not in env_spec else json.dumps(plain)), rule
