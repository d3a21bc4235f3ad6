"""Behaviour agents: Stable-Baselines3's SAC, trained in segments that each leave a rung of the ladder.

    segment k:  fresh episodes, generators seeded by (seed, SAC, k)  -->  rung (policy + screening returns)
                                                                     -->  the segment's transitions
                                                                     -->  checkpoint (weights, optimisers)

A segment depends only on the checkpoint before it and on k, so a training that was killed and resumed ends
with the same bits as one that was not. The price is that episodes running at a segment's end are truncated.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from offbench.common import checkpoints, seeds
from offbench.common.arrays import Array
from offbench.common.checkpoints import keep_newest, load_newest, save_checkpoint
from offbench.common.errors import OffbenchError
from offbench.common.files import csv_bytes, disk_errors, read_json, remove_leftovers, sole, write_bytes, write_json
from offbench.common.progress import Progress
from offbench.common.provenance import hardware, versions
from offbench.common.seeds import Purpose
from offbench.envs.environments import make_env
from offbench.envs.recipes import Recipe
from offbench.rollouts.policy import Policy
from offbench.rollouts.rollouts import MEASURES, Rollouts, summary

SCREENED = ("step", "hours", *(f"{how}_{m}" for how in ("stochastic", "deterministic") for m in MEASURES), "episodes")
OPTIMISERS = ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")


@dataclass(frozen=True)
class Training:
    """Where one behaviour agent's training lives: a folder of plain files."""

    recipe: Recipe
    seed: int
    folder: Path

    @property
    def rungs(self) -> Path:
        """The screening returns of every rung."""
        return self.folder / "rungs.csv"

    def policy(self, step: int) -> Path:
        """The policy file of the rung at `step`."""
        return self.folder / "policies" / f"{step:09d}.safetensors"

    def transitions(self, step: int) -> Path:
        """The transitions of the segment that ended at `step`."""
        return self.folder / "transitions" / f"{step:09d}.npz"


def train(training: Training, steps: int) -> None:
    """Train the behaviour agent up to `steps` environment steps, going on from its newest checkpoint.

    Raises:
        OffbenchError: the folder belongs to another recipe or seed, is in use, or the disk refuses.
    """
    with sole(training.folder / ".lock", f"{training.folder} is being trained"):
        remove_leftovers(training.folder)
        _claim(training)
        if max(checkpoints.steps(training.folder), default=0) < steps:
            _train(training, steps)


def _claim(training: Training) -> None:
    """Write what this folder is, or check that it is the same as when it was begun."""
    recipe = dataclasses.asdict(training.recipe)
    identity = {"seed": training.seed, "env_id": recipe["env_id"], "env_kwargs": dict(recipe["env_kwargs"])}
    identity["sac"] = recipe["sac"] | {"hidden": list(recipe["sac"]["hidden"])}
    path = training.folder / "training.json"
    if path.exists():
        begun = {key: value for key, value in read_json(path).items() if key in identity}
        known, wanted = _flat(begun), _flat(json.loads(json.dumps(identity)))
        other = [key for key in known | wanted if known.get(key) != wanted.get(key)]
        if other:
            was, is_ = (table.get(other[0], "none") for table in (known, wanted))
            raise OffbenchError(
                f"{training.folder} holds another training, with {other[0]} {was}, not {is_}; delete it to train anew "
                "(to train on, keep the recipe: `offbench behaviour ENV --steps N`)"
            )
        return
    write_json(path, identity | {"recipe_sha256": training.recipe.sha256(), "versions": versions()} | hardware())


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"sac.steps": ...} of {"sac": {"steps": ...}}."""
    inner = {
        f"{key}.{name}": v for key, value in table.items() if isinstance(value, dict) for name, v in value.items()
    }
    return inner | {key: value for key, value in table.items() if not isinstance(value, dict)}


def _train(training: Training, steps: int) -> None:
    settings, seed = training.recipe.sac, training.seed
    torch.set_num_threads(1)
    spec = training.recipe.env_spec()
    model = _make_sac(training.recipe, spec, steps)
    step, seconds = _resume(training, model)
    rows = [row for row in read_rungs(training.rungs) if row["step"] <= step]
    title = f"SAC on {training.recipe.name}"
    with Rollouts(spec) as rollouts, Progress(steps, title, start=step) as progress:
        while step < steps:
            began = time.monotonic()
            _learn_segment(model, settings, seed, step)
            step += settings.segment
            seconds += time.monotonic() - began
            policy = export_actor(model, training.recipe.env_id, {"algorithm": "SAC", "step": step, "seed": seed})
            row = {"step": step, "hours": round(seconds / 3600, 4)} | _screen(
                rollouts, policy, seed, step, settings.rung_episodes
            )
            rows.append(row)
            _save_segment(training, model, policy, rows, seconds)
            progress.to(step, f"return {row['stochastic_return']:.0f}")


def _make_sac(recipe: Recipe, spec: str, steps: int) -> SAC:
    settings = recipe.sac
    turn, gradient_steps = settings.cycle()

    def single() -> gym.Env[Any, Any]:
        # float32 halves the replay buffer; the medium-replay level keeps exactly what SAC saw
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Gymnasium's remark on the bounds' precision
            return gym.wrappers.DtypeObservation(make_env(spec), np.float32)

    return SAC(
        "MlpPolicy",
        DummyVecEnv([single] * settings.envs),
        learning_rate=settings.learning_rate,
        buffer_size=steps + settings.segment,
        learning_starts=settings.learning_starts,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.discount,
        train_freq=turn,
        gradient_steps=gradient_steps,
        policy_kwargs={"net_arch": list(settings.hidden), "optimizer_kwargs": {"fused": True}},
        seed=0,  # replaced below: every segment seeds its own generators
        device="cpu",
    )


def _learn_segment(model: SAC, settings: Any, seed: int, step: int) -> None:
    """Train from `step` to the next rung, on fresh episodes and from generators of this segment's own."""
    index = step // settings.segment
    # SB3 draws from the global generators of NumPy and PyTorch: seed them for this segment
    set_random_seed(seeds.integer(seed, Purpose.SAC, index) % 2**32)
    model.action_space.seed(seeds.integer(seed, Purpose.SAC, index, 1) % 2**32)
    assert model.env is not None
    model.env.seed(seeds.integer(seed, Purpose.SAC, index, 2) % 2**31)
    model._last_obs = None  # makes learn() reset the environments
    fraction = min(step / settings.steps, 1.0)
    rate = settings.learning_rate + fraction * (settings.final_learning_rate - settings.learning_rate)
    model.lr_schedule = lambda _: rate
    model.learn(settings.segment, reset_num_timesteps=False, log_interval=sys.maxsize)  # no log lines


def export_actor(model: SAC, env_id: str, origin: dict[str, Any]) -> Policy:
    """Return SB3's SAC actor as a policy that needs neither SB3 nor PyTorch."""
    actor: Any = model.policy.actor
    linear = [layer for layer in actor.latent_pi if isinstance(layer, torch.nn.Linear)]
    layers = [(_array(layer.weight).T, _array(layer.bias)) for layer in linear]
    head = np.concatenate([_array(actor.mu.weight).T, _array(actor.log_std.weight).T], axis=1)
    layers.append((head, np.concatenate([_array(actor.mu.bias), _array(actor.log_std.bias)])))
    layers = [(np.ascontiguousarray(w), b) for w, b in layers]
    dim, space = layers[0][0].shape[0], cast(gym.spaces.Box, model.action_space)
    zeros, ones = np.zeros(dim, np.float32), np.ones(dim, np.float32)
    return Policy("squashed_gaussian", tuple(layers), zeros, ones, space.low, space.high, env_id, origin)


def _array(tensor: torch.Tensor) -> Array:
    return tensor.detach().cpu().numpy().copy()


def _screen(rollouts: Rollouts, policy: Policy, seed: int, step: int, episodes: int) -> dict[str, float]:
    """Measure a rung over a few episodes: enough to choose candidates, not to publish."""
    row: dict[str, float] = {}
    for how, deterministic in (("stochastic", False), ("deterministic", True)):
        stream = (int(Purpose.RUNG), step, int(deterministic))
        outcomes = rollouts.outcomes(policy, seed, stream, episodes, deterministic).result()
        row |= summary(outcomes, f"{how}_")
    return row | {"episodes": episodes}


def _save_segment(
    training: Training, model: SAC, policy: Policy, rows: list[dict[str, float]], seconds: float
) -> None:
    """Write what a segment made; the checkpoint comes last, and with it the segment counts."""
    step = int(rows[-1]["step"])
    with disk_errors(str(training.folder)):
        policy.save(training.policy(step))
        path = training.transitions(step)
        path.parent.mkdir(exist_ok=True)
        aside = path.with_name("." + path.name)
        arrays: dict[str, Any] = _segment_arrays(model, training.recipe.sac.segment)
        np.savez(aside, **arrays)
        aside.replace(path)
        write_bytes(training.rungs, csv_bytes(SCREENED, ([row[key] for key in SCREENED] for row in rows)))
        state = {"step": step, "n_updates": model._n_updates, "seconds": seconds}
        save_checkpoint(training.folder, step, _sac_tensors(model), state)
        keep_newest(training.folder)


def _segment_arrays(model: SAC, segment: int) -> dict[str, Array]:
    """Return the newest `segment` transitions of the replay buffer, [steps, envs, ...]; actions in [-1, 1]."""
    buffer = model.replay_buffer
    assert buffer is not None
    rows = slice(buffer.pos - segment // buffer.n_envs, buffer.pos)
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    return {name: getattr(buffer, name)[rows] for name in names}


def _sac_tensors(model: SAC) -> dict[str, torch.Tensor]:
    """Return weights, temperature and optimiser moments by name."""
    tensors = {f"policy.{name}": value for name, value in model.policy.state_dict().items()}
    tensors["log_ent_coef"] = _temperature(model).detach()
    for name in OPTIMISERS:
        state = _optimiser(model, name).state_dict()["state"]
        tensors |= {f"{name}.{i}.{key}": value for i, part in state.items() for key, value in part.items()}
    return tensors


def _temperature(model: SAC) -> torch.Tensor:
    assert model.log_ent_coef is not None  # SB3 learns it unless told otherwise
    return model.log_ent_coef


def _optimiser(model: SAC, name: str) -> torch.optim.Optimizer:
    owner: Any = model
    for part in name.split("."):
        owner = getattr(owner, part)
    assert isinstance(owner, torch.optim.Optimizer)
    return owner


def _resume(training: Training, model: SAC) -> tuple[int, float]:
    """Put the newest checkpoint and the replay buffer back into `model`; return its step and seconds."""
    found = load_newest(training.folder)
    model._setup_learn(0, None)  # gives the model its logger and callbacks before the first segment
    if found is None:
        set_random_seed(seeds.integer(training.seed, Purpose.WEIGHTS, 0) % 2**32)
        _reset_weights(model)
        return 0, 0.0
    tensors, state = found
    weights = {k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")}
    model.policy.load_state_dict(weights)
    _temperature(model).data.copy_(tensors["log_ent_coef"])
    for name in OPTIMISERS:
        _load_optimiser(_optimiser(model, name), name, tensors)
    _refill(training, model, int(state["step"]))
    model.num_timesteps, model._n_updates = int(state["step"]), int(state["n_updates"])
    return model.num_timesteps, float(state["seconds"])


def _reset_weights(model: SAC) -> None:
    """Build the networks anew, from the generator seeded just before."""
    made: Any = model.policy_class
    model.policy = made(model.observation_space, model.action_space, model.lr_schedule, **model.policy_kwargs)
    model.policy = model.policy.to(model.device)
    model._create_aliases()


def _load_optimiser(optimiser: torch.optim.Optimizer, name: str, tensors: dict[str, torch.Tensor]) -> None:
    whole = optimiser.state_dict()
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith(name + "."):
            index, moment = key.removeprefix(name + ".").split(".")
            moments.setdefault(int(index), {})[moment] = value
    optimiser.load_state_dict({"state": moments, "param_groups": whole["param_groups"]})


def _refill(training: Training, model: SAC, step: int) -> None:
    """Put every recorded transition back into the replay buffer, in its old order."""
    buffer = model.replay_buffer
    assert buffer is not None
    segment = training.recipe.sac.segment
    position = 0
    for end in range(segment, step + 1, segment):
        path = training.transitions(end)
        try:
            with np.load(path, allow_pickle=False) as arrays:
                count = len(arrays["rewards"])
                for name in arrays.files:
                    getattr(buffer, name)[position : position + count] = arrays[name]
        except (OSError, ValueError, KeyError) as error:
            raise OffbenchError(
                f"{path} is missing or damaged ({error}); delete {training.folder} to train anew"
            ) from None
        position += count
    buffer.pos = position


def read_rungs(path: Path) -> list[dict[str, float]]:
    """Read rungs.csv (an empty list if there is none yet)."""
    if not path.exists():
        return []
    lines = path.read_text().splitlines()
    header = lines[0].split(",")
    rows = [dict(zip(header, map(float, line.split(",")), strict=True)) for line in lines[1:]]
    return [row | {"step": int(row["step"]), "episodes": int(row["episodes"])} for row in rows]
