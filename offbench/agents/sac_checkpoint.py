"""Checkpoints of a behaviour agent's SAC, at the end of a segment or within one.

    at the end    networks, temperature, optimizers; the replay buffer lies in transitions/<step>.npz
    within        the same, and the segment so far: its transitions and the states of the random generators

Environments have no state that could be saved for all of them. They are deterministic, so a resume within a segment
resets them with the segment's seeds and plays the recorded actions again, which must lead to the recorded transitions.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC

from offbench.agents.training_folder import TRANSITIONS, TrainingFolder
from offbench.common import checkpoints
from offbench.common.arrays import Array
from offbench.common.checkpoints import keep_newest, load_checkpoint, save_checkpoint
from offbench.common.files import JsonObject, disk_errors
from offbench.common.terminal import warn

OPTIMIZERS = ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")


def transitions_since(model: SAC, step: int) -> dict[str, Array]:
    """Return the transitions recorded after `step`, each [steps, envs, ...]; actions in [-1, 1]."""
    buffer = model.replay_buffer
    assert buffer is not None
    rows = slice(step // buffer.n_envs, buffer.pos)
    return {name: getattr(buffer, name)[rows] for name in TRANSITIONS}


def save_segment_end(folder: TrainingFolder, model: SAC, seconds: float) -> None:
    """Write the checkpoint at the end of a segment, whose transitions are written already."""
    save_checkpoint(folder.path, model.num_timesteps, _tensors(model), _state(model, seconds))
    _keep_newest(folder, model.num_timesteps)


def save_within_segment(folder: TrainingFolder, model: SAC, seconds: float) -> None:
    """Write a checkpoint within a segment; it replaces an earlier one of the same segment."""
    step, segment = model.num_timesteps, folder.recipe.sac.segment
    arrays = transitions_since(model, step - step % segment)
    tensors = {f"transitions.{name}": torch.from_numpy(array) for name, array in arrays.items()}
    tensors["generator"] = torch.get_rng_state()
    numpy_state: Any = np.random.get_state(legacy=False)
    numpy_state["state"]["key"] = numpy_state["state"]["key"].tolist()
    state = {"numpy": numpy_state, "action_space": model.action_space.np_random.bit_generator.state}
    with disk_errors(str(folder.path)):
        save_checkpoint(folder.path, step, _tensors(model) | tensors, _state(model, seconds) | {"generators": state})
        _keep_newest(folder, step)


def _keep_newest(folder: TrainingFolder, newest: int) -> None:
    """Delete old checkpoints, but not the last one at a segment's end, which does not depend on a replay."""
    for step in checkpoints.steps(folder.path):
        if step % folder.recipe.sac.segment and step != newest:
            (folder.path / f"checkpoint-{step:09d}.safetensors").unlink(missing_ok=True)
    keep_newest(folder.path)


def restore(folder: TrainingFolder, model: SAC, start_segment: Callable[[int], None]) -> float:
    """Put the newest usable checkpoint back into `model`.

    Args:
        folder: of the training.
        model: newly made; left as it is if there is no checkpoint.
        start_segment: seeds the generators and resets the environments as at the start of the segment of that step.

    Returns:
        The seconds trained so far; `model.num_timesteps` is the checkpoint's step.

    Raises:
        OffbenchError: the transitions of an earlier segment are missing or damaged.
    """
    segment = folder.recipe.sac.segment
    for step in checkpoints.steps(folder.path):
        loaded = load_checkpoint(folder.path, step)
        if loaded is None:
            continue
        tensors, state = loaded
        _fill_buffer(folder, model, step - step % segment)
        if step % segment:
            start_segment(step)
            if not _replay_segment(model, {name: tensors[f"transitions.{name}"].numpy() for name in TRANSITIONS}):
                warn(
                    f"the environment did not repeat the episodes before step {step:,} exactly "
                    "(is it deterministic? another MuJoCo?); resuming from an earlier checkpoint"
                )
                continue
            _restore_generators(model, tensors["generator"], state["generators"])
        _load_tensors(model, tensors)
        model.num_timesteps, model._n_updates = step, int(state["n_updates"])
        return float(state["seconds"])
    if model.replay_buffer is not None:
        model.replay_buffer.reset()
    return 0.0


def _state(model: SAC, seconds: float) -> JsonObject:
    return {"step": model.num_timesteps, "n_updates": model._n_updates, "seconds": seconds}


def _tensors(model: SAC) -> dict[str, torch.Tensor]:
    """Return weights, temperature and optimizer moments by name."""
    tensors = {f"policy.{name}": value for name, value in model.policy.state_dict().items()}
    tensors["log_ent_coef"] = _temperature(model).detach()
    for name in OPTIMIZERS:
        state = _optimizer(model, name).state_dict()["state"]
        tensors |= {f"{name}.{i}.{key}": value for i, part in state.items() for key, value in part.items()}
    return tensors


def _load_tensors(model: SAC, tensors: dict[str, torch.Tensor]) -> None:
    weights = {k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")}
    model.policy.load_state_dict(weights)
    _temperature(model).data.copy_(tensors["log_ent_coef"])
    for name in OPTIMIZERS:
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(name + "."):
                index, moment = key.removeprefix(name + ".").split(".")
                moments.setdefault(int(index), {})[moment] = value
        optimizer = _optimizer(model, name)
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})


def _temperature(model: SAC) -> torch.Tensor:
    assert model.log_ent_coef is not None  # SB3 learns it unless told otherwise
    return model.log_ent_coef


def _optimizer(model: SAC, name: str) -> torch.optim.Optimizer:
    owner: Any = model
    for part in name.split("."):
        owner = getattr(owner, part)
    assert isinstance(owner, torch.optim.Optimizer)
    return owner


def _fill_buffer(folder: TrainingFolder, model: SAC, until: int) -> None:
    """Put the transitions of all segments up to `until` into the replay buffer, in order."""
    buffer = model.replay_buffer
    assert buffer is not None
    buffer.reset()
    segment = folder.recipe.sac.segment
    for end in range(segment, until + 1, segment):
        _append(model, folder.read_transitions(end))


def _append(model: SAC, arrays: dict[str, Array]) -> None:
    buffer = model.replay_buffer
    assert buffer is not None
    count = len(arrays["rewards"])
    for name, array in arrays.items():
        getattr(buffer, name)[buffer.pos : buffer.pos + count] = array
    buffer.pos += count


def _replay_segment(model: SAC, arrays: dict[str, Array]) -> bool:
    """Play a segment's recorded actions again; return whether the environments repeat its transitions."""
    assert model.env is not None
    observations: Any = model.env.reset()
    for row, actions in enumerate(arrays["actions"]):
        if not np.array_equal(observations, arrays["observations"][row]):
            return False
        observations, rewards, dones, _ = model.env.step(model.policy.unscale_action(actions))
        if not (np.array_equal(rewards, arrays["rewards"][row]) and np.array_equal(dones, arrays["dones"][row])):
            return False
    _append(model, arrays)
    model._last_obs = observations
    return True


def _restore_generators(model: SAC, generator: torch.Tensor, state: JsonObject) -> None:
    torch.set_rng_state(generator)
    numpy_state = state["numpy"]
    key = np.array(numpy_state["state"]["key"], np.uint32)
    np.random.set_state(numpy_state | {"state": numpy_state["state"] | {"key": key}})
    model.action_space.np_random.bit_generator.state = json.loads(json.dumps(state["action_space"]))
