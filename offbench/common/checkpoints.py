"""Checkpoints: safetensors files of tensors and a JSON state, of which the newest two are kept."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from offbench.common.arrays import arrays_sha256
from offbench.common.errors import DamagedError
from offbench.common.files import JsonObject, open_regular, read_errors, write_bytes
from offbench.common.terminal import inform

KEPT = 2
_NAME = re.compile(r"checkpoint-(\d{9,})\.safetensors")


def path_of(folder: Path, step: int) -> Path:
    """Return the file of a checkpoint."""
    return folder / f"checkpoint-{step:09d}.safetensors"


def save_checkpoint(folder: Path, step: int, tensors: dict[str, torch.Tensor], state: JsonObject) -> None:
    """Write checkpoint-<step>.safetensors, whole or not at all."""
    saved = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # one key, because safetensors writes several in any order, and a run's bytes should depend on the run alone
    header = {**state, "sha256": _sha256(saved, state)}
    data = save(saved, metadata={"offbench": json.dumps(header, sort_keys=True)})
    write_bytes(path_of(folder, step), data)


def steps(folder: Path) -> list[int]:
    """Return the steps that have a checkpoint in `folder`, newest first."""
    matches = (_NAME.fullmatch(path.name) for path in folder.glob("checkpoint-*.safetensors"))
    return sorted((int(match[1]) for match in matches if match), reverse=True)


def load_checkpoint(folder: Path, step: int) -> tuple[dict[str, torch.Tensor], JsonObject] | None:
    """Read one checkpoint; None (and a line on stderr) if it is damaged.

    Raises:
        OffbenchError: it cannot be read for another reason, so that a run does not resume from an older one.
    """
    path = path_of(folder, step)
    try:
        with read_errors(str(path), "is damaged", "it is not used"):
            os.close(open_regular(path))  # safe_open would wait for a FIFO
            with safe_open(path, framework="pt") as file:
                state = json.loads((file.metadata() or {})["offbench"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if not isinstance(state, dict) or state.get("step") != step:
                raise ValueError(f"it does not hold step {step}")
            _check_state(state)
            recorded = state.pop("sha256", None)  # older files have none
            if recorded is not None and recorded != _sha256(tensors, state):
                raise ValueError("its SHA-256 does not match its content")
            return tensors, state
    except (DamagedError, FileNotFoundError) as error:
        inform(str(error))
        return None


def _check_state(state: JsonObject) -> None:
    """Raise ValueError if a part of a run's state has another type than it is written with."""
    if not isinstance(state.get("origin", {}), dict):
        raise ValueError("its origin is not an object")
    for name, total, count in state.get("unlogged", []):
        if not isinstance(name, str) or type(total) not in (int, float) or type(count) is not int or count < 1:
            raise ValueError("its unlogged sums are not numbers")


def _sha256(tensors: dict[str, torch.Tensor], state: JsonObject) -> str:
    return arrays_sha256({name: tensor.numpy() for name, tensor in tensors.items()}, state)


def load_newest(folder: Path) -> tuple[dict[str, torch.Tensor], JsonObject] | None:
    """Read the newest checkpoint that is not damaged, or return None."""
    return next((checkpoint for step in steps(folder) if (checkpoint := load_checkpoint(folder, step))), None)


def keep_newest(folder: Path, newest: int) -> None:
    """Delete all checkpoints except the newest two up to step `newest`. Later ones could not be loaded."""
    kept = [step for step in steps(folder) if step <= newest][:KEPT]
    for step in steps(folder):
        if step not in kept:
            path_of(folder, step).unlink(missing_ok=True)
