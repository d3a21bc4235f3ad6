"""The training loop: a stack of runs as one program, from transitions to checkpoints.

    chunk of CHUNK updates:  per run, from (run seed, chunk):  batch indices [CHUNK, runs, batch], noise
    update:                  gather the batch, let the algorithm update, add up what it logs
    every eval_every steps:  checkpoint, then evaluate a snapshot on worker processes while training goes on

A run's random numbers depend on its own seed and the chunk alone: it is the same run alone or in a stack, and a
resume needs no generator state.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbench import checkpoints, seeds
from offbench.algorithm import Algorithm, Batch, Draw, stack_configs
from offbench.errors import OffbenchError
from offbench.files import disk_errors, sole
from offbench.policy import Policy
from offbench.progress import Progress
from offbench.rollout import Outcome, Rollouts, result
from offbench.runs import Run
from offbench.scores import normalize
from offbench.seeds import Purpose
from offbench.transitions import Transitions

CHUNK = 100  # updates whose random numbers are drawn together; part of what a seed means, never change
LOG_EVERY = 1000  # updates behind a row of losses.csv


@dataclass(frozen=True)
class Member:
    """One run of a stack."""

    run: Run
    seed: int
    config: Any
    data: Transitions
    references: tuple[float, float] | None


@dataclass(frozen=True)
class Schedule:
    """How long a stack trains, and when it is evaluated."""

    steps: int
    eval_every: int
    eval_episodes: int
    device: str
    workers: int


class Store:
    """The transitions of all runs' datasets on the device, end to end, and where each run's begin."""

    def __init__(self, members: Sequence[Member], normalize_observations: bool, device: torch.device) -> None:
        distinct = {member.data.dataset_id: member.data for member in members}
        starts, count, row = {}, 0, 0
        parts: dict[str, list[Tensor]] = {k: [] for k in ("observations", "rows", "actions", "rewards", "masks")}
        for name, data in distinct.items():
            starts[name] = count
            for key, tensors in parts.items():
                array = getattr(data, key)
                tensors.append(_tensor(array + row if key == "rows" and row else array))
            count, row = count + len(data), row + len(data.observations)
        whole = {key: (t[0] if len(t) == 1 else torch.cat(t)).to(device) for key, t in parts.items()}
        self.observations, self.rows = whole["observations"], whole["rows"]
        self.actions, self.rewards, self.masks = whole["actions"], whole["rewards"], whole["masks"]
        self.sizes = [len(member.data) for member in members]
        first = [starts[member.data.dataset_id] for member in members]
        self.chosen: Tensor | None = None  # where runs train on a part: the transitions of each, end to end
        if any(getattr(member.config, "top", 1.0) < 1 for member in members):
            chosen = [m.data.best(getattr(m.config, "top", 1.0)) + f for m, f in zip(members, first, strict=True)]
            self.sizes = [len(part) for part in chosen]
            first = [sum(self.sizes[:i]) for i in range(len(members))]
            self.chosen = torch.from_numpy(np.concatenate(chosen)).to(device)
        self.first = torch.tensor(first, device=device).view(-1, 1)
        known = {name: data.normalizer() for name, data in distinct.items()} if normalize_observations else {}
        dim = self.observations.shape[1]
        identity = (np.zeros(dim, np.float32), np.ones(dim, np.float32))
        self.normalizers = [known.get(member.data.dataset_id, identity) for member in members]
        self.mean = torch.from_numpy(np.stack([mean for mean, _ in self.normalizers])).to(device).unsqueeze(1)
        self.std = torch.from_numpy(np.stack([std for _, std in self.normalizers])).to(device).unsqueeze(1)
        self.normalize = normalize_observations

    def batch(self, indices: Tensor) -> Batch:
        """Return the transitions at `indices` [runs, batch], each run's counted from its own first."""
        flat = (indices + self.first).flatten()
        if self.chosen is not None:
            flat = self.chosen[flat]
        rows = self.rows[flat]
        shape = (*indices.shape, -1)
        observations = self.observations[rows].view(shape)
        next_observations = self.observations[rows + 1].view(shape)
        if self.normalize:
            observations = (observations - self.mean) / self.std
            next_observations = (next_observations - self.mean) / self.std
        return Batch(
            observations,
            self.actions[flat].view(shape),
            self.rewards[flat].view(indices.shape),
            next_observations,
            self.masks[flat].view(indices.shape),
        )


def _tensor(array: Any) -> Tensor:
    with warnings.catch_warnings():
        # PyTorch warns that the cache is mapped read-only; nothing here writes to it
        warnings.simplefilter("ignore", UserWarning)
        return torch.from_numpy(array)


def draw_chunk(
    run_seeds: Sequence[int],
    sizes: Sequence[int],
    batch_size: int,
    draws: Mapping[str, Draw],
    chunk: int,
    device: torch.device,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return a chunk's batch indices [CHUNK, runs, batch] and noise {name: [CHUNK, runs, *shape]}."""
    indices, noise = [], {name: [] for name in draws}  # type: tuple[list[Tensor], dict[str, list[Tensor]]]
    for seed, size in zip(run_seeds, sizes, strict=True):
        generator = torch.Generator(device).manual_seed(seeds.integer(seed, Purpose.CHUNK, chunk))
        indices.append(torch.randint(size, (CHUNK, batch_size), generator=generator, device=device))
        for name, draw in draws.items():
            shape = (CHUNK, *draw.shape)
            if draw.distribution == "normal":
                noise[name].append(torch.randn(shape, generator=generator, device=device))
            else:
                noise[name].append(torch.rand(shape, generator=generator, device=device) * 2 - 1)
    return torch.stack(indices, 1), {name: torch.stack(parts, 1) for name, parts in noise.items()}


class Stack:
    """The learning state of a stack of runs: everything but files and evaluations."""

    def __init__(self, kind: type[Algorithm], members: Sequence[Member], device: str) -> None:
        self.members, self.device = list(members), torch.device(device)
        self.seeds = [member.seed for member in members]
        config = stack_configs([member.config for member in members], self.device)
        dims = {(m.data.observations.shape[1], m.data.actions.shape[1]) for m in members}
        if len(dims) != 1:
            raise OffbenchError(f"datasets of one stack must have the same shapes, not {sorted(dims)}")
        observation_dim, action_dim = dims.pop()
        self.algorithm = kind(config, observation_dim, action_dim, self.seeds, self.device)
        self.batch_size: int = config.batch_size
        self.store = Store(members, config.normalize, self.device)
        self.step = 0
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}

    def train(self, until: int) -> Iterator[int]:
        """Update up to step `until`; yields the step after every chunk (and at the end)."""
        while self.step < until:
            chunk, first = divmod(self.step, CHUNK)
            indices, noise = draw_chunk(
                self.seeds, self.store.sizes, self.batch_size, self.algorithm.draws, chunk, self.device
            )
            for i in range(first, min(CHUNK, first + until - self.step)):
                batch = self.store.batch(indices[i])
                draws = {name: values[i] for name, values in noise.items()}
                logs = self.algorithm.update(batch, draws, self.algorithm.kind(self.step))
                self._add(logs)
                self.step += 1
            yield self.step

    def _add(self, logs: Mapping[str, Tensor]) -> None:
        for name, value in logs.items():
            if name in self._sums:
                self._sums[name] += value
                self._counts[name] += 1
            else:
                self._sums[name], self._counts[name] = value.clone(), 1

    def logged(self) -> list[dict[str, float]]:
        """Return each run's mean of everything logged since the last call: the loop's only synchronisation."""
        columns = {name: (total / self._counts[name]).tolist() for name, total in self._sums.items()}
        self._sums, self._counts = {}, {}
        return [{name: values[run] for name, values in columns.items()} for run in range(len(self.members))]

    def policy(self, run: int) -> Policy:
        """Return one run's policy as it is now, for the NumPy rollouts and the policy file."""
        member = self.members[run]
        parts = self.algorithm.policy(run)
        mean, std = self.store.normalizers[run]
        origin = {"algorithm": type(self.algorithm).__name__, "step": self.step, "seed": member.seed}
        actor, critic = (tuple((w.numpy(), b.numpy()) for w, b in p) for p in (parts.layers, parts.critic))
        data = member.data
        origin |= {"dataset": data.dataset_id, "dataset_sha256": data.content}
        return Policy(
            parts.kind,
            actor,
            mean,
            std,
            data.low,
            data.high,
            data.env_id,
            origin,
            critic=critic,
            samples=parts.samples,
            activation=parts.activation,
        )

    def run_tensors(self, run: int) -> dict[str, Tensor]:
        """Return what one run's checkpoint keeps: its slice of everything learned."""
        return {
            f"{name}.{key}": value if value.dim() == 0 else value[:, run : run + 1]
            for name, part in self.algorithm.learned.items()
            for key, value in part.tensors().items()
        }

    def load(self, run: int, tensors: Mapping[str, Tensor]) -> None:
        """Put one run's checkpoint back. Raises OffbenchError if it does not fit."""
        for name, place in self.run_tensors(run).items():
            found = tensors.get(name)
            if found is None or found.shape != place.shape:
                raise OffbenchError(f"the checkpoint in {self.members[run].run.folder} does not fit; delete the run")
            with torch.no_grad():
                place.copy_(found)

    def check_finite(self) -> None:
        """Raise OffbenchError if a run has diverged to NaN or infinity."""
        for run, member in enumerate(self.members):
            bad = [n for n, t in self.run_tensors(run).items() if not bool(torch.isfinite(t).all())]
            if bad:
                raise OffbenchError(
                    f"{member.run.folder}: {bad[0]} became NaN or infinite by step {self.step}; its last checkpoint "
                    f"is kept; try a smaller learning rate, or train the others without seed {member.seed}"
                )


class Trainer:
    """A stack with its files: checkpoints, losses, evaluations beside the training."""

    def __init__(self, kind: type[Algorithm], members: Sequence[Member], schedule: Schedule, title: str) -> None:
        self.members, self.schedule, self.title = list(members), schedule, title
        self.stack = Stack(kind, members, schedule.device)
        self.evaluations: list[dict[int, list[tuple[float, int]]]] = [{} for _ in members]
        self.losses: list[list[dict[str, float]]] = [[] for _ in members]
        self.pending: list[tuple[int, int, Future[list[Outcome]]]] = []  # (run, step, outcomes)
        self.rollouts: Rollouts | None = None
        self.note = ""

    def train(self) -> None:
        """Go on from the newest step that all runs have, to the schedule's end."""
        with contextlib.ExitStack() as resources:
            for member in self.members:
                resources.enter_context(held(member.run))
            self._resume()
            spec = self.members[0].data.env_spec  # datasets of one stack are of one environment
            if spec:
                self.rollouts = resources.enter_context(Rollouts(spec, self.schedule.workers))
            progress = resources.enter_context(Progress(self.schedule.steps, self.title, start=self.stack.step))
            if self._evaluates_at(self.stack.step) and self.stack.step:
                self._evaluate()
            while self.stack.step < self.schedule.steps:
                self._train_to(self._next_stop(), progress)
                self._checkpoint()
                if self._evaluates_at(self.stack.step):
                    self._evaluate()
            self._collect()
            progress.to(self.stack.step, self.note)

    def _train_to(self, stop: int, progress: Progress) -> None:
        for step in self.stack.train(stop):
            if step % LOG_EVERY == 0 or step == stop:
                for rows, row in zip(self.losses, self.stack.logged(), strict=True):
                    rows.append({"step": step, **row})
            self._arrived()
            progress.to(step, self.note)

    def _next_stop(self) -> int:
        """Return the next step with a checkpoint: every evaluation, and the end."""
        every = self.schedule.eval_every
        return min(self.schedule.steps, (self.stack.step // every + 1) * every)

    def _evaluates_at(self, step: int) -> bool:
        return step % self.schedule.eval_every == 0 or step == self.schedule.steps

    def _resume(self) -> None:
        """Load the newest step that all runs have a whole checkpoint of; forget what came after it."""
        common = set.intersection(*(set(checkpoints.steps(m.run.folder)) for m in self.members))
        for step in sorted((s for s in common if s <= self.schedule.steps), reverse=True):
            found = [checkpoints.load_checkpoint(m.run.folder, step) for m in self.members]
            if all(found):
                for run, (tensors, _) in enumerate(f for f in found if f):
                    self.stack.load(run, tensors)
                self.stack.step = step
                break
        for run, member in enumerate(self.members):
            known, rows = member.run.evaluations(), member.run.losses()
            # an evaluation at the end of a shorter schedule may lie off this one's grid
            self.evaluations[run] = {s: e for s, e in known.items() if s <= self.stack.step and self._evaluates_at(s)}
            self.losses[run] = [row for row in rows if row["step"] <= self.stack.step]

    def _checkpoint(self) -> None:
        """Write everything up to now; evaluations of earlier steps land first, so a resume misses none."""
        self.stack.check_finite()
        self._collect()
        for run, member in enumerate(self.members):
            folder, step = member.run.folder, self.stack.step
            with disk_errors(str(folder)):
                member.run.write_evaluations(self.evaluations[run])
                member.run.write_losses(self.losses[run])
                self.stack.policy(run).save(member.run.policy_path)
                checkpoints.save_checkpoint(folder, step, self.stack.run_tensors(run), {"step": step})
                checkpoints.keep_newest(folder)

    def _evaluate(self) -> None:
        """Start the evaluation of every run's policy as it is now, unless it is known already."""
        step = self.stack.step
        if self.rollouts is None:
            return
        for run, member in enumerate(self.members):
            if step not in self.evaluations[run]:
                stream = (int(Purpose.EVALUATION), step)
                count = self.schedule.eval_episodes
                policy = self.stack.policy(run)
                self.pending.append((run, step, self.rollouts.outcomes(policy, member.seed, stream, count, True)))

    def _arrived(self) -> None:
        """Take in evaluations that are done, without waiting."""
        if self.pending and all(future.done() for _, _, future in self.pending):
            self._collect()

    def _collect(self) -> None:
        """Wait for all evaluations under way and write them down."""
        for run, step, future in self.pending:
            outcomes = result(future)
            self.evaluations[run][step] = [(o.ret, o.length) for o in outcomes]
            self.members[run].run.write_evaluations(self.evaluations[run])
        if self.pending:
            self.note = self._score_note(self.pending[0][1])
        self.pending = []

    def _score_note(self, step: int) -> str:
        """Return the mean score of the runs at `step`, normalised if there is a reference."""
        means = [float(np.mean([ret for ret, _ in e[step]])) for e in self.evaluations if step in e]
        references = self.members[0].references
        if references is None:
            return f"return {np.mean(means):.0f}"
        return f"score {np.mean([normalize(mean, *references) for mean in means]):.1f}"


@contextlib.contextmanager
def held(run: Run) -> Iterator[None]:
    """Hold a run's directory for this process. Raises OffbenchError if another one trains it."""
    with sole(run.folder / ".lock", f"{run.folder} is being trained"):
        yield
