"""`load_policy`: the policy of a run, or a policy file, to act with."""

from __future__ import annotations

from pathlib import Path

from offbench.rollouts.policy import Policy
from offbench.rollouts.policy import load_policy as read_policy
from offbench.training.run import Run


def load_policy(path: str | Path) -> Policy:
    """Return the policy of a run's folder, or of a policy file (`.safetensors`).

        policy = offbench.load_policy("runs/hopper-medium-v0/td3_bc/default/seed-0")
        action = policy(observation)

    Raises:
        OffbenchError: no policy there, or a damaged one.
    """
    path = Path(path)
    if path.is_dir():
        Run(path).config()  # raises if the folder is no run
        return read_policy(Run(path).policy_path)
    return read_policy(path)
