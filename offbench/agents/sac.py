"""Behaviour agents: Stable-Baselines3's SAC, trained in segments that each end with a rung of the ladder.

    segment k:  fresh episodes, generators seeded by (seed, SAC, k)  -->  rung (policy + screening returns)
                                                                     -->  policies within the segment, where the
                                                                          return changed much
                                                                     -->  the segment's transitions
                                                                     -->  checkpoint (weights, optimizers)

A segment depends only on the checkpoint before it and on k, so a training that was killed and resumed ends
with the same bits as one that was not. In return, episodes that are running at a segment's end are truncated.
Ctrl-C and SIGTERM save a checkpoint at once; a resume from it ends with the same bits, too.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from offbench.agents.sac_checkpoint import restore, save_segment_end, save_within_segment, transitions_since
from offbench.agents.sb3_zip import sac_layers
from offbench.agents.training_folder import RUNG_COLUMNS, TrainingFolder, read_rungs
from offbench.common import checkpoints, seeds
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, csv_bytes, write_bytes, write_errors, write_json
from offbench.common.interrupts import collect_stop_signals
from offbench.common.progress import Progress, duration
from offbench.common.provenance import hardware, versions
from offbench.common.seeds import Purpose
from offbench.common.terminal import warn
from offbench.envs.environment_code import environment_code
from offbench.envs.environments import Env, make_env
from offbench.envs.margin_rule import MAX_RULE
from offbench.envs.recipes import Recipe, SACSettings
from offbench.rollouts.policy import Policy
from offbench.rollouts.rollouts import ErrorReporting, Rollouts, summary

MAX_POLICIES = 100  # saved policies of a segment, including its rung
MAX_POLICY_BYTES = 6_000_000  # bytes of a segment's policies: 20 of hopper's
LARGE_CHANGE = 0.05  # share of the range of returns; after a smaller change, policies within a segment are deleted
STEP_WORK = 0.02  # time of an environment step in units of gradient steps, to estimate the time left
MAX_PROBE_SECONDS = 1.0  # time spent on estimating the training's time
PROBE_CYCLES, WARM_UP = 50, 4


def train(folder: TrainingFolder, steps: int) -> None:
    """Train the behaviour agent up to `steps` environment steps, resuming from its newest checkpoint.

    Raises:
        OffbenchError: the folder belongs to another recipe or seed, is in use, or the disk refuses.
        KeyboardInterrupt: after Ctrl-C (or whatever SIGTERM raises), once a checkpoint is written.
    """
    with folder.locked():
        _check_identity(folder)
        if max(checkpoints.steps(folder.path), default=0) < steps:
            _train(folder, steps)


def _check_identity(folder: TrainingFolder) -> None:
    """Write what is trained in this folder, or check that it is the same as when it was started."""
    recipe = dataclasses.asdict(folder.recipe)
    identity = {"seed": folder.seed, "env_id": recipe["env_id"], "env_kwargs": dict(recipe["env_kwargs"])}
    identity["contact_margin"] = recipe["contact_margin"]
    identity["sac"] = recipe["sac"] | {"hidden": list(recipe["sac"]["hidden"])}
    path, code = folder.path / "training.json", environment_code(folder.recipe.env_spec())
    if not path.exists():
        origin = {"recipe_sha256": folder.recipe.sha256(), "versions": versions(), "hardware": hardware()}
        write_json(path, identity | {"env_code": code} | origin)
        return
    recorded = folder.read_description()
    if edited := describe_changes(recorded["env_code"], code):
        raise OffbenchError(
            f"the training in {folder.path} began in other code of its environment: {edited}; delete it to train again"
        )
    recorded = {"contact_margin": MAX_RULE} | recorded  # the only rule of earlier versions
    started = _flattened({key: value for key, value in recorded.items() if key in identity})
    wanted = _flattened(json.loads(json.dumps(identity)))
    changed = [key for key in started | wanted if started.get(key) != wanted.get(key)]
    if changed:
        old, new = (table.get(changed[0], "none") for table in (started, wanted))
        raise OffbenchError(
            f"{folder.path} holds another training, with {changed[0]} {old}, not {new}; delete it to train again "
            "(to train for longer, keep the recipe: `offbench behaviour ENV --steps N`)"
        )


def _warn_other_versions(folder: TrainingFolder) -> None:
    """Warn if this training was started with other versions of the packages that it depends on."""
    before = folder.read_description()["versions"]
    if changed := [f"{name} {old}, not {now}" for name, now in versions().items() if (old := before.get(name)) != now]:
        warn(
            f"the training in {folder.path} was started with {', '.join(changed)}; its results may differ from here on"
        )


def _flattened(table: JsonObject) -> JsonObject:
    """Return {"sac.steps": ...} of {"sac": {"steps": ...}}."""
    inner = {
        f"{key}.{name}": v for key, value in table.items() if isinstance(value, dict) for name, v in value.items()
    }
    return inner | {key: value for key, value in table.items() if not isinstance(value, dict)}


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _train(folder: TrainingFolder, steps: int) -> None:
    """Train segment after segment, until `steps`, Ctrl-C or SIGTERM."""
    recipe, settings = folder.recipe, folder.recipe.sac
    title, spec = f"SAC on {recipe.name}", recipe.env_spec()
    with _one_thread(), collect_stop_signals(second_at_once=True) as stops, Rollouts(spec) as rollouts:
        step_seconds = _measure_gradient_step(recipe, spec)  # draws from the generators that a checkpoint restores
        model = _make_sac(recipe, spec, steps + settings.segment)
        seconds = _start_or_resume(folder, model)
        rows = [row for row in read_rungs(folder.rungs) if row["step"] <= model.num_timesteps]
        with Progress(steps, title, work=_work(settings, steps)) as progress:
            progress.skip(model.num_timesteps, _work(settings, model.num_timesteps))
            if model.num_timesteps:
                _warn_other_versions(folder)
            progress.print_line(_plan(recipe, step_seconds, model.num_timesteps, steps))
            while model.num_timesteps < steps and not stops:
                start = time.process_time()  # CPU time, which other programs do not affect
                finished = _train_segment(folder, model, progress, stops)
                seconds += time.process_time() - start
                if finished:
                    rows.append(_end_segment(folder, model, rollouts, rows, seconds))
                    progress.to(
                        model.num_timesteps,
                        f"return {rows[-1]['stochastic_return']:.0f}",
                        _work(settings, model.num_timesteps),
                    )
                elif model.num_timesteps % settings.segment:
                    save_within_segment(folder, model, seconds)
            if stops and model.num_timesteps:
                progress.print_line(f"{title}: stopped at step {model.num_timesteps:,}, checkpoint saved")


def _work(settings: SACSettings, step: int) -> float:
    """Return the time that `step` environment steps take, in units of gradient steps."""
    return STEP_WORK * step + settings.gradient_steps * max(step - settings.learning_starts, 0)


def _plan(recipe: Recipe, step_seconds: float, first: int, steps: int) -> str:
    """Return a line that says what is trained, and how long it will take on this machine."""
    updates = round(recipe.sac.gradient_steps * max(steps - max(first, recipe.sac.learning_starts), 0))
    start = f"resuming from step {first:,} of" if first else "training for"
    seconds = step_seconds * (_work(recipe.sac, steps) - _work(recipe.sac, first))
    return (
        f"SAC on {recipe.name}: {start} {steps:,} environment steps, {updates:,} gradient steps to go: "
        f"about {duration(seconds)} on one core; Ctrl-C saves a checkpoint, and the same command resumes"
    )


def _measure_gradient_step(recipe: Recipe, env_spec: str) -> float:
    """Return the seconds of a gradient step of this recipe, measured on a new model with its environment steps."""
    settings = dataclasses.replace(recipe.sac, learning_starts=0)
    cycle = settings.cycle()[0] * settings.envs
    model = _make_sac(dataclasses.replace(recipe, sac=settings), env_spec, (WARM_UP + PROBE_CYCLES) * cycle)
    model.learn(WARM_UP * cycle, log_interval=sys.maxsize)
    start, first = time.monotonic(), model.num_timesteps
    while time.monotonic() - start < MAX_PROBE_SECONDS and model.num_timesteps < (WARM_UP + PROBE_CYCLES) * cycle:
        model.learn(cycle, reset_num_timesteps=False, log_interval=sys.maxsize)
    done = _work(settings, model.num_timesteps) - _work(settings, first)
    assert model.env is not None
    model.env.close()
    return (time.monotonic() - start) / done


def _make_sac(recipe: Recipe, env_spec: str, buffer_size: int) -> SAC:
    settings = recipe.sac
    cycle, gradient_steps = settings.cycle()

    def make_single_env() -> Env:
        # float32 halves the replay buffer; the medium-replay level keeps exactly what SAC saw
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Gymnasium's remark on the bounds' precision
            return gym.wrappers.DtypeObservation(ErrorReporting(make_env(env_spec)), np.float32)

    model = SAC(
        "MlpPolicy",
        DummyVecEnv([make_single_env] * settings.envs),
        learning_rate=settings.learning_rate,
        buffer_size=buffer_size,
        learning_starts=settings.learning_starts,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.discount,
        train_freq=cycle,
        gradient_steps=gradient_steps,
        policy_kwargs={"net_arch": list(settings.hidden), "optimizer_kwargs": {"fused": True}},
        seed=0,  # replaced: every segment seeds its own generators
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # SB3's own makes a folder in /tmp
    return model


def _start_or_resume(folder: TrainingFolder, model: SAC) -> float:
    """Load the newest checkpoint, or new weights of the training's seed; return the seconds trained so far."""
    seconds = restore(folder, model, lambda step: _start_segment(folder, model, step))
    if not model.num_timesteps:
        set_random_seed(seeds.integer(folder.seed, Purpose.WEIGHTS, 0) % 2**32)
        policy_class: Any = model.policy_class
        model.policy = policy_class(
            model.observation_space, model.action_space, model.lr_schedule, **model.policy_kwargs
        ).to(model.device)
        model._create_aliases()
    return seconds


def _start_segment(folder: TrainingFolder, model: SAC, step: int) -> None:
    """Seed everything for the segment that holds `step`; the next `learn` starts on fresh episodes."""
    index = step // folder.recipe.sac.segment
    # SB3 draws from the global generators of NumPy and PyTorch: seed them for this segment
    set_random_seed(seeds.integer(folder.seed, Purpose.SAC, index) % 2**32)
    model.action_space.seed(seeds.integer(folder.seed, Purpose.SAC, index, 1) % 2**32)
    assert model.env is not None
    model.env.seed(seeds.integer(folder.seed, Purpose.SAC, index, 2) % 2**31)
    model._last_obs = None  # makes learn() reset the environments


def _train_segment(folder: TrainingFolder, model: SAC, progress: Progress, stops: Sequence[int]) -> bool:
    """Train to the end of the segment; return False if Ctrl-C or SIGTERM came before."""
    settings = folder.recipe.sac
    start = model.num_timesteps // settings.segment * settings.segment
    end, cycle = start + settings.segment, settings.cycle()[0] * settings.envs
    keep_every = cycle * math.ceil(
        settings.segment / cycle / min(MAX_POLICIES, max(MAX_POLICY_BYTES // _actor_bytes(model), 1))
    )
    if model.num_timesteps == start:
        _start_segment(folder, model, start)
    fraction = min(start / settings.steps, 1.0)
    rate = settings.learning_rate + fraction * (settings.final_learning_rate - settings.learning_rate)
    model.lr_schedule = lambda _: rate
    while model.num_timesteps < end:
        if stops:
            return False
        model.learn(cycle, reset_num_timesteps=False, log_interval=sys.maxsize)
        step = model.num_timesteps
        if settings.learning_starts < step < end and (step - start) % keep_every == 0:
            _export(folder, model).save(folder.policy(step))
        progress.to(step, work=_work(settings, step))
    return True


def _actor_bytes(model: SAC) -> int:
    return sum(parameter.nbytes for parameter in model.policy.actor.parameters())


def _end_segment(
    folder: TrainingFolder, model: SAC, rollouts: Rollouts, rows: Sequence[dict[str, float]], seconds: float
) -> dict[str, float]:
    """Screen the rung at the end of a segment and write the segment's files; return its row of rungs.csv.

    The checkpoint is written last: only then is the segment complete.
    """
    step, segment = model.num_timesteps, folder.recipe.sac.segment
    policy = _export(folder, model)
    row = {"step": step, "hours": round(seconds / 3600, 4)} | _screen(folder, rollouts, policy, step)
    returns = [before["stochastic_return"] for before in (*rows, row)]
    with write_errors(str(folder.path)):
        policy.save(folder.policy(step))
        if len(returns) > 1 and abs(returns[-1] - returns[-2]) < LARGE_CHANGE * (max(returns) - min(returns)):
            for other in folder.policy_steps():
                if step - segment < other < step:
                    folder.policy(other).unlink()
        arrays: dict[str, Any] = transitions_since(model, step - segment)
        np.savez(transitions := io.BytesIO(), **arrays)
        write_bytes(folder.transitions(step), transitions.getvalue())
        write_bytes(
            folder.rungs, csv_bytes(RUNG_COLUMNS, ([values[key] for key in RUNG_COLUMNS] for values in (*rows, row)))
        )
        save_segment_end(folder, model, seconds)
    return row


def _screen(folder: TrainingFolder, rollouts: Rollouts, policy: Policy, step: int) -> dict[str, float]:
    """Measure a rung over a few episodes: enough to choose candidates, not to publish."""
    episodes = folder.recipe.sac.rung_episodes
    row: dict[str, float] = {"episodes": episodes}
    for how, deterministic in (("stochastic", False), ("deterministic", True)):
        stream = (int(Purpose.RUNG), step, int(deterministic))
        episode_stats = rollouts.evaluate(policy, folder.seed, stream, episodes, deterministic)
        row |= summary(episode_stats, f"{how}_")
    return row


def _export(folder: TrainingFolder, model: SAC) -> Policy:
    origin = {"algorithm": "SAC", "step": model.num_timesteps, "seed": folder.seed}
    return export_actor(model, folder.recipe.env_id, origin)


def export_actor(model: SAC, env_id: str, origin: JsonObject) -> Policy:
    """Return SB3's SAC actor as a policy that needs neither SB3 nor PyTorch."""
    layers = sac_layers({name: tensor.numpy().copy() for name, tensor in model.policy.state_dict().items()})
    dim, space = layers[0][0].shape[0], cast(gym.spaces.Box, model.action_space)
    zeros, ones = np.zeros(dim, np.float32), np.ones(dim, np.float32)
    return Policy("squashed_gaussian", layers, zeros, ones, space.low, space.high, env_id, origin)
