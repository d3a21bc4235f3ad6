"""A stack: runs that learn as one program.

Program   one update of every run, fed from buffers that stay in place: it is captured once for each kind of update and
          then replayed, on a GPU as a CUDA graph, on a CPU by offbench.algorithm.capture
Stack     the learning state of the runs: train, log, policies, what a checkpoint keeps
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from offbench.algorithm.capture import NotCapturableError, Recording, record
from offbench.algorithm.interface import Algorithm, PolicyParts, check_logs, stack_configs
from offbench.algorithm.networks import Learned, Target
from offbench.common.errors import OffbenchError
from offbench.rollouts.policy import Policy, check_networks
from offbench.training.batches import CHUNK, Member, Store, draw_chunk

Sums = list[tuple[str, float, int]]  # of each logged quantity: its name, its sum, and over how many updates
RECORD_EVERY = 1000  # updates of a kind between two records of it on a CPU
WARM_UP = 3  # updates of a kind before it is captured: libraries allocate their workspaces in the first ones


class Program:
    """One update of every run, over and over.

    A counter on the device picks each update's rows of the chunk, and logs are added up on the device, so nothing
    waits for the host.
    """

    def __init__(self, algorithm: Algorithm, store: Store) -> None:
        self.algorithm, self.store = algorithm, store
        self.device = store.observations.device
        self.position = torch.zeros(1, dtype=torch.int64, device=self.device)
        self.indices, self.noise = torch.empty(0), dict[str, Tensor]()
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}
        self._names: dict[str, list[str]] = {}  # what each kind of update logs
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}
        self._recordings: dict[str, Recording] = {}
        self._done: dict[str, int] = {}
        self.eager = not getattr(algorithm, "capture", True)  # whether every update runs as it is
        self._side: Any = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None  # type: ignore[no-untyped-call]

    def load(self, indices: Tensor, noise: Mapping[str, Tensor], first: int) -> None:
        """Put a chunk's indices and noise in place; the next update takes row `first`."""
        if not len(self.indices):
            self.indices, self.noise = indices, dict(noise)
        self.indices.copy_(indices)
        for name, values in noise.items():
            self.noise[name].copy_(values)
        self.position.fill_(first)

    def run(self, kind: str) -> None:
        """Do the next update."""
        if self._side is not None:
            if kind in self._graphs:
                self._graphs[kind].replay()
            else:
                self._first(kind, self._side)
        elif self.eager:
            self._update(kind)
        else:
            self._captured(kind)
        for name in self._names[kind]:
            self.counts[name] = self.counts.get(name, 0) + 1

    def _captured(self, kind: str) -> None:
        """Do an update on the CPU: the first of a kind as it is, two recorded, the rest replayed.

        Every RECORD_EVERY-th is recorded again, so that an update that changes later on is noticed.
        """
        done = self._done[kind] = self._done.get(kind, 0) + 1
        if done == 1:
            self._update(kind)
        elif done > 3 and done % RECORD_EVERY:
            with torch.inference_mode():
                self._recordings[kind].replay()
        else:
            where = f"{type(self.algorithm).__name__}.update"
            try:
                recording = record(lambda: self._update(kind))
            except NotCapturableError as error:
                self._leave_eager(f"{where} cannot be captured ({error})")
                return
            if done > 2 and not recording.same_as(self._recordings[kind]):
                if done > 3:
                    raise OffbenchError(
                        f"{where} changes with the number of updates; let `kind` tell apart what differs, or set "
                        f"`capture = False` in class {type(self.algorithm).__name__}"
                    )
                self._leave_eager(f"{where} is not the same at every update of kind {kind!r}")
            elif done <= 3:
                self._recordings[kind] = recording

    def _leave_eager(self, reason: str) -> None:
        self.eager = True
        self._recordings = {}
        print(f"offbench: {reason}: every update runs as it is, which is slower", file=sys.stderr)

    def _first(self, kind: str, side: Any) -> None:
        """Do one of the first updates of a kind as it is; after a few, capture the kind for those to come."""
        side.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(side):
            self._update(kind)
        torch.cuda.current_stream(self.device).wait_stream(side)
        self._done[kind] = self._done.get(kind, 0) + 1
        if self._done[kind] == WARM_UP:
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=side):  # recorded, not run
                self._update(kind)
            self._graphs[kind] = graph

    def _update(self, kind: str) -> None:
        batch = self.store.batch(self.indices.index_select(0, self.position)[0])
        noise = {name: values.index_select(0, self.position)[0] for name, values in self.noise.items()}
        logs = self.algorithm.update(batch, noise, kind)
        if kind not in self._names:
            check_logs(logs, len(self.store.sizes), f"{type(self.algorithm).__name__}.update")
            self._names[kind] = list(logs)
        elif self._names[kind] != list(logs):  # a captured graph would go on with those of the first update
            where = f"{type(self.algorithm).__name__}.update"
            raise OffbenchError(f"{where} must log the same names at every update of kind {kind!r}")
        for name, value in logs.items():
            if name not in self.sums:
                self.sums[name] = torch.zeros_like(value)
            self.sums[name] += value
        self.position += 1

    def logged(self) -> dict[str, list[float]]:
        """Return each run's mean of everything logged since the last call: the loop's only synchronisation."""
        means = {name: (self.sums[name] / count).tolist() for name, count in self.counts.items()}
        for total in self.sums.values():
            total.zero_()
        self.counts = {}
        return means

    def unlogged(self, run: int) -> Sums:
        """Return one run's sum and count of what has been logged since `logged` was called."""
        return [(name, float(self.sums[name][run]), count) for name, count in self.counts.items()]

    def go_on_logging(self, run: int, sums: Sums) -> None:
        """Put `unlogged` sums back."""
        for name, total, count in sums:
            self.sums.setdefault(name, torch.zeros(len(self.store.sizes), device=self.device))[run] = total
            self.counts[name] = count


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
        _check_policy(self.algorithm, observation_dim, action_dim)
        _check_learned(self.algorithm)
        self.batch_size: int = config.batch_size
        self.store = Store(members, config.normalize, self.device)
        self.program = Program(self.algorithm, self.store)
        self.step = 0

    def train(self, until: int) -> Iterator[int]:
        """Update up to step `until`; yields the step after every chunk (and at the end)."""
        while self.step < until:
            chunk, first = divmod(self.step, CHUNK)
            drawn = draw_chunk(self.seeds, self.store.sizes, self.batch_size, self.algorithm.draws, chunk, self.device)
            self.program.load(*drawn, first)
            for _ in range(first, min(CHUNK, first + until - self.step)):
                self.program.run(self.algorithm.kind(self.step))
                self.step += 1
            yield self.step

    def logged(self) -> list[dict[str, float]]:
        """Return each run's mean of everything logged since the last call."""
        columns = self.program.logged()
        return [{name: values[run] for name, values in columns.items()} for run in range(len(self.members))]

    def policy(self, run: int) -> Policy:
        """Return one run's policy as it is now, for the NumPy rollouts and the policy file."""
        member, data = self.members[run], self.members[run].data
        parts = self.algorithm.policy(run)
        mean, std = self.store.normalizers[run]
        actor, critic = (tuple((w.numpy(), b.numpy()) for w, b in p) for p in (parts.layers, parts.critic))
        origin = {
            "algorithm": member.algorithm,
            "step": self.step,
            "seed": member.seed,
            "dataset": data.dataset_id,
            "dataset_sha256": data.content,
        }
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

    def tensors(self) -> dict[str, Tensor]:
        """Return everything learned; runs are axis 1 (a step count has none)."""
        return {
            f"{name}.{key}": value
            for name, part in self.algorithm.learned.items()
            for key, value in part.tensors().items()
        }

    def run_tensors(self, run: int) -> dict[str, Tensor]:
        """Return what one run's checkpoint keeps: its slice of everything learned."""
        return slice_of(self.tensors(), run)

    def load(self, run: int, tensors: Mapping[str, Tensor]) -> None:
        """Put one run's checkpoint back. Raises OffbenchError if it does not fit."""
        for name, place in self.run_tensors(run).items():
            found = tensors.get(name)
            if found is None or found.shape != place.shape:
                raise OffbenchError(f"the checkpoint in {self.members[run].run.folder} does not fit; delete the run")
            with torch.no_grad():
                place.copy_(found)

    def diverged(self) -> dict[int, str]:
        """Return the runs that hold NaN or infinity, each with the name of such a tensor."""
        found: dict[int, str] = {}
        for name, tensor in self.tensors().items():
            if tensor.dim():
                bad = (~torch.isfinite(tensor)).flatten(2).any(2).any(0).nonzero()
                found |= {int(run): name for run in bad}
        return found


def _check_learned(algorithm: Algorithm) -> None:
    """Raise OffbenchError if a checkpoint would lack a network: a run that resumes would go on with another one."""
    where, kept = f"{type(algorithm).__name__}.learned", list(algorithm.learned.values())
    if not kept:
        raise OffbenchError(f"{where} is empty: a checkpoint would keep nothing")
    for name, part in vars(algorithm).items():
        if isinstance(part, Learned | Target) and not any(part is one for one in kept):
            raise OffbenchError(f"{where} lacks {name}: a run that resumes would go on with another one")


def _check_policy(algorithm: Algorithm, observation_dim: int, action_dim: int) -> None:
    """Raise OffbenchError now, not at the first evaluation, if no policy file can hold the algorithm's policies."""
    where, parts = f"{type(algorithm).__name__}.policy", algorithm.policy(0)
    if not isinstance(parts, PolicyParts):
        raise OffbenchError(f"{where} must return PolicyParts, not a {type(parts).__name__}")
    try:
        check_networks(parts, observation_dim, action_dim)
        ready = not any(x.requires_grad or x.is_cuda for layer in [*parts.layers, *parts.critic] for x in layer)
    except (ValueError, TypeError, AttributeError) as error:  # the last two: layers that are no pairs of tensors
        raise OffbenchError(f"{where}: {error}") from None
    if not ready:
        raise OffbenchError(f"{where}: layers must be detached and on the CPU, as `Network.layers` returns them")


def slice_of(tensors: Mapping[str, Tensor], run: int) -> dict[str, Tensor]:
    """Return one run's part of a stack's tensors."""
    return {name: value if value.dim() == 0 else value[:, run : run + 1] for name, value in tensors.items()}
