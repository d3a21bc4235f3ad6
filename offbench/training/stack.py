"""A stack: runs that learn as one program.

Program   one update of every run, fed from fixed buffers: it is captured once for each phase and then replayed,
          on a GPU as a CUDA graph, on a CPU by offbench.algorithm.cpu_capture
Stack     the learning state of the runs: train, log, policies, what a checkpoint keeps
"""

from __future__ import annotations

import sys
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from offbench.algorithm.cpu_capture import NotCapturableError, Recording, attributes, changed_attribute, record
from offbench.algorithm.interface import Algorithm, PolicyParts, check_logs, stack_configs
from offbench.common.errors import OffbenchError
from offbench.data.transitions import Transitions
from offbench.rollouts.policy import Policy, check_networks
from offbench.training.batches import CHUNK, Store, draw_chunk
from offbench.training.spec import RunSpec

Sums = list[tuple[str, float, int]]  # of each logged quantity: its name, its sum, and over how many updates
RECORDED = 6  # updates of a phase before a replay is trusted on a CPU: all but the first are recorded and compared
RECORD_EVERY = 1000  # updates of a phase between two later records of it
WARM_UP = 3  # updates of a phase before it is captured on a GPU: libraries allocate workspaces in the first ones


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
        self._names: dict[Hashable, list[str]] = {}  # what each phase logs
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph] = {}
        self._recordings: dict[Hashable, Recording] = {}
        self._done: dict[Hashable, int] = {}  # updates of each phase
        self.eager = not algorithm.capture  # whether every update runs without capture
        self._side: Any = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None  # type: ignore[no-untyped-call]

    def load(self, indices: Tensor, noise: Mapping[str, Tensor], first: int) -> None:
        """Copy a chunk's indices and noise into the buffers; the next update takes row `first`."""
        if not len(self.indices):
            self.indices, self.noise = indices, dict(noise)
        self.indices.copy_(indices)
        for name, values in noise.items():
            self.noise[name].copy_(values)
        self.position.fill_(first)

    def run(self, phase: Hashable) -> None:
        """Do the next update."""
        if self.eager:
            self._update(phase)
        elif self._side is None:
            self._captured(phase)
        elif phase in self._graphs:
            self._graphs[phase].replay()
        else:
            self._warm_up(phase, self._side)
        for name in self._names[phase]:
            self.counts[name] = self.counts.get(name, 0) + 1

    def _captured(self, phase: Hashable) -> None:
        """Do an update on the CPU: the first of a phase as it is, the next ones recorded, the rest replayed.

        Every RECORD_EVERY-th is recorded again, so that an update that changes later on is noticed.
        """
        done = self._done[phase] = self._done.get(phase, 0) + 1
        if done > RECORDED and done % RECORD_EVERY:
            with torch.inference_mode():
                self._recordings[phase].replay()
            return
        before, recording = attributes(self.algorithm), None
        try:
            if done == 1:
                self._update(phase)
            else:
                recording = record(lambda: self._update(phase))
        except NotCapturableError as error:
            self._leave_eager(f"cannot be captured ({error})")
            return
        changed = changed_attribute(before, attributes(self.algorithm), first=done == 1)
        reason = f"changes the attribute {changed}" if changed else ""
        if recording is not None:
            if phase in self._recordings and not recording.same_as(self._recordings[phase]):
                reason = reason or f"is not the same at every update of phase {phase!r}"
            if done <= RECORDED:  # a later one is only compared: copying it into other buffers would gain nothing
                self._recordings[phase] = recording
        if reason and done > RECORDED:
            name = type(self.algorithm).__name__
            raise OffbenchError(
                f"{name}.update {reason} after {done:,} updates; let `phase` tell apart what differs, or set "
                f"`capture = False` in class {name}"
            )
        if reason:
            self._leave_eager(reason)

    def _leave_eager(self, reason: str) -> None:
        self.eager = True
        self._recordings, self._graphs = {}, {}
        name = type(self.algorithm).__name__
        print(f"offbench: {name}.update {reason}: updates run without capture, which is slower", file=sys.stderr)

    def _warm_up(self, phase: Hashable, side: Any) -> None:
        """Do one of the first updates of a phase as it is; after a few, capture the phase for those to come."""
        done = self._done[phase] = self._done.get(phase, 0) + 1
        before = attributes(self.algorithm)
        side.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(side):
            self._update(phase)
        torch.cuda.current_stream(self.device).wait_stream(side)
        if changed := changed_attribute(before, attributes(self.algorithm), first=done == 1):
            self._leave_eager(f"changes the attribute {changed}")
        elif done == WARM_UP:
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=side):  # recorded, not run
                self._update(phase)
            self._graphs[phase] = graph

    def _update(self, phase: Hashable) -> None:
        batch = self.store.batch(self.indices.index_select(0, self.position)[0])
        noise = {name: values.index_select(0, self.position)[0] for name, values in self.noise.items()}
        logs = self.algorithm.update(batch, noise, phase)
        where = f"{type(self.algorithm).__name__}.update"
        if phase not in self._names:
            check_logs(logs, len(self.store.sizes), where)
            self._names[phase] = list(logs)
        elif self._names[phase] != list(logs):  # a replay would log those of the first update
            raise OffbenchError(f"{where} must log the same names at every update of phase {phase!r}")
        for name, value in logs.items():
            if name not in self.sums:
                self.sums[name] = torch.zeros_like(value, requires_grad=False)
            self.sums[name] += value.detach()
        self.position += 1

    def logged(self) -> dict[str, list[float]]:
        """Return each run's mean of everything logged since the last call: the loop's only synchronization."""
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

    def __init__(
        self, kind: type[Algorithm], specs: Sequence[RunSpec], datasets: Mapping[str, Transitions], device: str
    ) -> None:
        self.specs, self.device = list(specs), torch.device(device)
        self.data = [datasets[spec.dataset] for spec in specs]
        self.seeds = [spec.seed for spec in specs]
        config = stack_configs([spec.config for spec in specs], self.device)
        dims = {(data.observations.shape[1], data.actions.shape[1]) for data in self.data}
        if len(dims) != 1:
            raise OffbenchError(f"datasets of one stack must have the same shapes, not {sorted(dims)}")
        observation_dim, action_dim = dims.pop()
        self.algorithm = kind(config, observation_dim, action_dim, self.seeds, self.device)
        _check_policy(self.algorithm, observation_dim, action_dim)
        if not self.algorithm.learned:
            raise OffbenchError(f"{kind.__name__} has no networks among its attributes: a checkpoint would be empty")
        self.batch_size: int = config.batch_size
        self.store = Store(specs, datasets, config.normalize, self.device, self.algorithm.uses_next_actions)
        self.noise_spec = self.algorithm.noise_spec(self.algorithm.config)
        self.program = Program(self.algorithm, self.store)
        self.step = 0

    def train(self, until: int) -> Iterator[int]:
        """Update up to step `until`; yields the step after every chunk (and at the end)."""
        while self.step < until:
            chunk, first = divmod(self.step, CHUNK)
            drawn = draw_chunk(self.seeds, self.store.sizes, self.batch_size, self.noise_spec, chunk, self.device)
            self.program.load(*drawn, first)
            for _ in range(first, min(CHUNK, first + until - self.step)):
                self.program.run(self.algorithm.phase(self.step))
                self.step += 1
            yield self.step

    def logged(self) -> list[dict[str, float]]:
        """Return each run's mean of everything logged since the last call."""
        columns = self.program.logged()
        return [{name: values[run] for name, values in columns.items()} for run in range(len(self.specs))]

    def policy(self, run: int) -> Policy:
        """Return one run's policy as it is now, for the NumPy rollouts and the policy file."""
        spec, data = self.specs[run], self.data[run]
        parts = self.algorithm.policy(run)
        mean, std = self.store.normalizers[run]
        actor, critic = (tuple((w.numpy(), b.numpy()) for w, b in p) for p in (parts.layers, parts.critic))
        origin = {
            "algorithm": spec.algorithm,
            "step": self.step,
            "seed": spec.seed,
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
        for name, tensor in self.run_tensors(run).items():
            saved = tensors.get(name)
            if saved is None or saved.shape != tensor.shape:
                raise OffbenchError(f"the checkpoint in {self.specs[run].folder} does not fit; delete the run")
            with torch.no_grad():
                tensor.copy_(saved)

    def diverged(self) -> dict[int, str]:
        """Return the runs that hold NaN or infinity, each with the name of such a tensor."""
        names: dict[int, str] = {}
        for name, tensor in self.tensors().items():
            if tensor.dim():
                bad = (~torch.isfinite(tensor)).flatten(2).any(2).any(0).nonzero()
                names |= {int(run): name for run in bad}
        return names


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
