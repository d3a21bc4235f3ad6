"""The folder of a behaviour agent's training: plain files, read without PyTorch.

training.json               recipe, seed, versions and hardware
rungs.csv                   the screening returns of every rung
policies/<step>.safetensors the policy of every rung, and policies within segments
transitions/<step>.npz      the transitions of the segment that ended at <step>
checkpoint-<step>.safetensors
ladder/                     what `build_ladder` chose (unless `--out` says otherwise)
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import (
    JsonObject,
    exclusive_lock,
    open_regular,
    read_errors,
    read_json,
    read_text,
    remove_leftovers,
)
from offbench.envs.recipes import Recipe
from offbench.rollouts.rollouts import MEASURES

RUNG_COLUMNS = (
    "step",
    "hours",
    *(f"{how}_{m}" for how in ("stochastic", "deterministic") for m in MEASURES),
    "episodes",
)
TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass(frozen=True)
class TrainingFolder:
    """Where the training of one recipe and seed keeps its files."""

    recipe: Recipe
    seed: int
    path: Path

    @property
    def rungs(self) -> Path:
        """The screening returns of every rung."""
        return self.path / "rungs.csv"

    def read_description(self) -> JsonObject:
        """Return training.json. Raises OffbenchError if it is missing or damaged."""
        path, remedy = self.path / "training.json", f"delete {self.path} to train the agent again"
        description: JsonObject = {"versions": {}, "env_code": {}} | read_json(path, remedy)
        with read_errors(str(path), "is damaged", remedy):
            for key in ("versions", "env_code"):
                if not isinstance(description[key], dict):
                    raise ValueError(f"{key} is not an object")
        return description

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder and delete leftovers. Raises OffbenchError if another process trains there."""
        with exclusive_lock(self.path / ".lock", f"{self.path} is being trained"):
            for written in (self.path, self.path / "policies", self.path / "transitions"):
                remove_leftovers(written)
            yield

    def policy(self, step: int) -> Path:
        """The policy after `step` environment steps."""
        return self.path / "policies" / f"{step:09d}.safetensors"

    def policy_steps(self) -> list[int]:
        """Return the steps whose policy was kept, in order, those within segments included."""
        return sorted(int(path.stem) for path in (self.path / "policies").glob("*.safetensors") if path.stem.isdigit())

    def transitions(self, step: int) -> Path:
        """The transitions of the segment that ended at `step`."""
        return self.path / "transitions" / f"{step:09d}.npz"

    def read_transitions(self, step: int) -> dict[str, Array]:
        """Return the transitions of the segment that ended at `step`: {name: [steps, envs, ...]}.

        Raises:
            OffbenchError: they are missing or damaged.
        """
        path, remedy = self.transitions(step), f"delete {self.path} to train the agent again"
        try:
            with (
                read_errors(str(path), "is damaged", remedy),
                open(path, "rb", opener=open_regular) as file,
                np.load(file, allow_pickle=False) as arrays,
            ):
                found = {name: arrays[name] for name in TRANSITIONS}
                for name, array in found.items():
                    dims = 3 if name in ("observations", "next_observations", "actions") else 2
                    if array.ndim != dims or array.shape[:2] != found["rewards"].shape:
                        raise ValueError(f"{name} have shape {array.shape}")
                return found
        except FileNotFoundError:
            raise OffbenchError(f"{path} is missing; {remedy}") from None


def read_rungs(path: Path) -> list[dict[str, float]]:
    """Read rungs.csv (an empty list if there is none yet). Raises OffbenchError if it is damaged."""
    if not path.exists():
        return []
    with read_errors(str(path), "is damaged", "delete its folder to train the agent again"):
        lines = read_text(path).splitlines()
        header = lines[0].split(",")
        if missing := [column for column in RUNG_COLUMNS if column not in header]:
            raise ValueError(f"it has no column {missing[0]}")
        rows = [dict(zip(header, map(float, line.split(",")), strict=True)) for line in lines[1:]]
        return [row | {"step": int(row["step"]), "episodes": int(row["episodes"])} for row in rows]
