"""Checkpoints of a behaviour agent's SAC, at the end of a segment or within one.

    at the end    networks, temperature, optimizers; the replay buffer lies in transitions/<step>.npz
    within        the same, and the segment so far: its transitions and the states of the random generators

Environments have no state that could be saved for all of them. They are deterministic, so a resume within a segment
resets them with the segment's seeds and plays the recorded actions again, which must lead to the recorded transitions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

from offbench.agents.training_folder import TRANSITIONS, TrainingFolder
from offbench.common import checkpoints
from offbench.common.arrays import Array
from offbench.common.files import JsonObject, write_errors
from offbench.common.terminal import warn

OPTIMIZERS = ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")


def transitions_since(model: SAC, step: int) -> dict[str, Array]:
    """Return the transitions recorded after `step`, each [steps, envs, ...]; actions in [-1, 1]."""
    buffer = _buffer(model)
    rows = slice(step // buffer.n_envs, buffer.pos)
    return {name: getattr(buffer, name)[rows] for name in TRANSITIONS}


def save_segment_end(folder: TrainingFolder, model: SAC, seconds: float) -> None:
    """Write the checkpoint at the end of a segment, whose transitions are written already."""
    checkpoints.save_checkpoint(folder.path, model.num_timesteps, _tensors(model), _state(model, seconds))
    _keep_newest(folder, model.num_timesteps)


def save_within_segment(folder: TrainingFolder, model: SAC, seconds: float) -> None:
    """Write a checkpoint within a segment; it replaces an earlier one of the same segment."""
    step, segment = model.num_timesteps, folder.recipe.sac.segment
    arrays = transitions_since(model, step - step % segment)
    tensors = {f"transitions.{name}": torch.from_numpy(array) for name, array in arrays.items()}
    tensors["generator"] = torch.get_rng_state()
    numpy_state: Any = np.random.get_state(legacy=False)
    numpy_state["state"]["key"] = numpy_state["state"]["key"].tolist()
    generators = {"numpy": numpy_state, "action_space": model.action_space.np_random.bit_generator.state}
    state = _state(model, seconds) | {"generators": generators}
    with write_errors(str(folder.path)):
        checkpoints.save_checkpoint(folder.path, step, _tensors(model) | tensors, state)
        _keep_newest(folder, step)


def _keep_newest(folder: TrainingFolder, newest: int) -> None:
    """Delete old checkpoints, but not the last one at a segment's end, which does not depend on a replay."""
    for step in checkpoints.steps(folder.path):
        if step % folder.recipe.sac.segment and step != newest:
            checkpoints.path_of(folder.path, step).unlink(missing_ok=True)
    checkpoints.keep_newest(folder.path, newest)


def restore(folder: TrainingFolder, model: SAC, start_segment: Callable[[int], None]) -> float:
    """Load the newest usable checkpoint into `model`.

    Args:
        folder: the training's folder.
        model: newly made; left as it is if there is no checkpoint.
        start_segment: seeds the generators and resets the environments as at the start of the segment of that step.

    Returns:
        The seconds trained so far; `model.num_timesteps` is the checkpoint's step.

    Raises:
        OffbenchError: the transitions of an earlier segment are missing or damaged.
    """
    segment = folder.recipe.sac.segment
    for step in checkpoints.steps(folder.path):
        loaded = checkpoints.load_checkpoint(folder.path, step)
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
            torch.set_rng_state(tensors["generator"])
            np.random.set_state(state["generators"]["numpy"])
            model.action_space.np_random.bit_generator.state = state["generators"]["action_space"]
        _load_tensors(model, tensors)
        model.num_timesteps, model._n_updates = step, int(state["n_updates"])
        return float(state["seconds"])
    _buffer(model).reset()
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


def _buffer(model: SAC) -> ReplayBuffer:
    assert model.replay_buffer is not None  # SB3 makes it with the model
    return model.replay_buffer


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
    _buffer(model).reset()
    segment = folder.recipe.sac.segment
    for end in range(segment, until + 1, segment):
        _append(model, folder.read_transitions(end))


def _append(model: SAC, arrays: dict[str, Array]) -> None:
    buffer, count = _buffer(model), len(arrays["rewards"])
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
