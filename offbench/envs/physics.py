"""Which MuJoCo versions simulate an environment alike. MuJoCo is imported only when needed: it is slow to load."""

from __future__ import annotations

from typing import TYPE_CHECKING

from offbench.common.provenance import versions
from offbench.common.terminal import warn

if TYPE_CHECKING:
    import mujoco


def warn_other_physics(what: str, recorded_versions: dict[str, str], env_spec: str) -> None:
    """Print a warning when `what` was made on a MuJoCo that simulates an environment (EnvSpec JSON) differently."""
    recorded_version, here = recorded_versions.get("mujoco", ""), versions()["mujoco"]
    if recorded_version and not same_physics(recorded_version, here, env_spec):
        warn(
            f"{what} was made with mujoco {recorded_version}, but {here} is installed: the physics differ, so scores "
            "may not be comparable"
        )


def same_physics(a: str, b: str, env_spec: str) -> bool:
    """Return whether two MuJoCo versions simulate an environment alike; see offbench.envs.contact_margins."""
    from offbench.envs.contact_margins import RK4_ROTATIONS_SINCE, release, rotations_changed

    try:
        if (release(a) >= RK4_ROTATIONS_SINCE) == (release(b) >= RK4_ROTATIONS_SINCE):
            return True
    except ValueError:
        return a == b
    model = _model(env_spec)
    return model is None or not rotations_changed(model)


def margins_matter(env_spec: str) -> bool:
    """Return whether the rule for contact margins makes a difference in an environment (EnvSpec JSON)."""
    from offbench.envs.contact_margins import has_margins

    model = _model(env_spec)
    return model is not None and has_margins(model)


def _model(env_spec: str) -> mujoco.MjModel | None:
    from offbench.envs.contact_margins import model_of
    from offbench.envs.environments import make_env

    env = make_env(env_spec)
    env.close()
    return model_of(env)
