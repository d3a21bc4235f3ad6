"""A warning if the installed MuJoCo simulates an environment differently from the recorded one."""

from __future__ import annotations

from offbench.common.provenance import versions
from offbench.common.terminal import warn


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
    from offbench.envs.contact_margins import RK4_ROTATIONS_SINCE, model_of, release, rotations_changed
    from offbench.envs.environments import make_env

    try:
        if (release(a) >= RK4_ROTATIONS_SINCE) == (release(b) >= RK4_ROTATIONS_SINCE):
            return True
    except ValueError:
        return a == b
    env = make_env(env_spec)
    model = model_of(env)
    env.close()
    return model is None or not rotations_changed(model)
