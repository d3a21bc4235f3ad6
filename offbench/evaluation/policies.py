"""`load_policy`: the policy of a run, or a policy file, to act with."""

from __future__ import annotations

from pathlib import Path

from offbench.common.errors import OffbenchError
from offbench.common.text import printable
from offbench.rollouts.policy import Policy, read_policy_file
from offbench.training.run import Run


def load_policy(path: str | Path) -> Policy:
    """Return the policy of a run's folder, or of a policy file (`.safetensors`).

        policy = offbench.load_policy("runs/hopper-medium-v0/td3_bc/default/seed-0")
        action = policy(observation)

    Raises:
        OffbenchError: no policy there, a damaged one, or that of another run.
    """
    path = Path(path)
    if not path.is_dir():
        return read_policy_file(path)
    run = Run(path)
    config = run.config()
    if not run.policy_path.exists():
        raise OffbenchError(f"{path} has no policy yet; train the run to its first checkpoint")
    policy = read_policy_file(run.policy_path)
    for key in ("seed", "dataset_sha256"):
        found = policy.origin.get(key, getattr(config, key))
        if found != getattr(config, key):
            raise OffbenchError(
                f"{run.policy_path} is of another run: its {key} is {printable(str(found))}; put the run's own back, "
                "or delete it: the next training writes it again"
            )
    return policy
