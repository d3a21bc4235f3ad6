"""One update of every run of a stack, captured and replayed: a CUDA graph on a GPU, recorded calls on a CPU."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Hashable, Mapping

import numpy as np
import torch
from torch import Tensor

from offbench.algorithm.cpu_capture import NotCapturableError, Trace, attributes, changed_attribute, trace
from offbench.algorithm.interface import Algorithm, check_logs
from offbench.common.errors import OffbenchError
from offbench.common.terminal import inform
from offbench.training.batches import StackData

Sums = list[tuple[str, float, int]]  # (name, sum, number of updates) of each logged quantity
# updates of a phase before a replay is trusted on a CPU: all but the first are recorded and compared
TRACED_UPDATES = 6
WATCHED_UPDATES = range(2, 9)  # updates after which attributes are compared; the first update only tests the code
TRACE_EVERY = 1000  # updates of a phase between two later traces of it
WARM_UP = 3  # updates of a phase before it is captured on a GPU: libraries allocate workspaces in the first ones


class CapturedUpdate:
    """Repeats one update of every run.

    A counter on the device picks each update's rows of the chunk, and logs are added up on the device, so nothing
    waits for the host.
    """

    def __init__(self, algorithm: Algorithm, store: StackData) -> None:
        self.algorithm, self.store = algorithm, store
        self.device = store.observations.device
        self.position = torch.zeros(1, dtype=torch.int64, device=self.device)
        self.indices, self.noise = torch.empty(0), dict[str, Tensor]()
        self.sums: dict[str, Tensor] = {}
        # number of updates in each of `sums`: of this session, and of an earlier one, where runs can differ
        self.counts: Counter[str] = Counter()
        self.earlier: list[Counter[str]] = [Counter() for _ in store.sizes]
        self._names: dict[Hashable, list[str]] = {}  # what each phase logs
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph] = {}
        self._traces: dict[Hashable, Trace] = {}
        self._done: dict[Hashable, int] = {}  # updates of each phase
        self._count = 0  # updates in this session
        self._has_reported = False  # whether an attribute that no checkpoint keeps was reported
        self.eager = not algorithm.capture  # whether every update runs without capture
        self._side_stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None  # type: ignore[no-untyped-call]

    def load(self, indices: Tensor, noise: Mapping[str, Tensor], first: int) -> None:
        """Copy a chunk's indices and noise into the buffers; the next update takes row `first`."""
        if not len(self.indices):
            self.indices, self.noise = indices, dict(noise)
        self.indices.copy_(indices)
        for name, values in noise.items():
            self.noise[name].copy_(values)
        self.position.fill_(first)

    def run(self, phase: Hashable) -> None:
        """Perform the next update."""
        self._count += 1
        before = attributes(self.algorithm, in_place=True) if self._count in WATCHED_UPDATES else None
        if self.eager:
            self._update(phase)
        elif self._side_stream is None:
            self._run_captured(phase)
        elif phase in self._graphs:
            self._graphs[phase].replay()
        else:
            self._warm_up(phase, self._side_stream)
        self.counts.update(self._names[phase])
        if before is not None:
            self._report_lost_attribute(before)

    def _report_lost_attribute(self, before: dict[str, object]) -> None:
        """Print which attribute an update changes that no checkpoint keeps, once."""
        changed = changed_attribute(before, attributes(self.algorithm, in_place=True), first=True)
        if changed and not self._has_reported:
            self._has_reported = True
            name = type(self.algorithm).__name__
            inform(
                f"{name}.update changes the attribute {changed}, which no checkpoint keeps: a resumed run begins with "
                "its first value; keep it in self.parameters, or use phase(step)"
            )

    def _run_captured(self, phase: Hashable) -> None:
        """Perform an update on the CPU: the first of a phase eagerly, the next ones recorded, the rest replayed.

        Every TRACE_EVERY-th is recorded again, so that an update that changes later on is noticed.
        """
        done = self._done[phase] = self._done.get(phase, 0) + 1
        if done > TRACED_UPDATES and done % TRACE_EVERY:
            with torch.inference_mode():
                self._traces[phase].replay()
            return
        before, latest = attributes(self.algorithm), None
        try:
            if done == 1:
                self._update(phase)
            else:
                latest = trace(lambda: self._update(phase))
        except NotCapturableError as error:
            self._run_eagerly(f"cannot be captured ({error})")
            return
        changed = changed_attribute(before, attributes(self.algorithm), first=done == 1)
        reason = f"changes the attribute {changed}" if changed else ""
        if latest is not None:
            if phase in self._traces and not latest.same_as(self._traces[phase]):
                reason = reason or f"is not the same at every update of phase {phase!r}"
            if done <= TRACED_UPDATES:  # later traces are only compared with the one in use
                self._traces[phase] = latest
        if reason and done > TRACED_UPDATES:
            name = type(self.algorithm).__name__
            raise OffbenchError(
                f"{name}.update {reason} after {done:,} updates; return different phases for updates that differ, or "
                f"set `capture = False` in class {name}"
            )
        if reason:
            self._run_eagerly(reason)

    def _run_eagerly(self, reason: str) -> None:
        self.eager = True
        self._traces, self._graphs = {}, {}
        name = type(self.algorithm).__name__
        inform(f"{name}.update {reason}: updates run without capture, which is slower")

    def _warm_up(self, phase: Hashable, side: torch.cuda.Stream) -> None:
        """Perform one of the first updates of a phase eagerly; after a few, capture the phase for the later ones."""
        done = self._done[phase] = self._done.get(phase, 0) + 1
        before = attributes(self.algorithm)
        side.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(side):
            self._update(phase)
        torch.cuda.current_stream(self.device).wait_stream(side)
        if changed := changed_attribute(before, attributes(self.algorithm), first=done == 1):
            self._run_eagerly(f"changes the attribute {changed}")
        elif done == WARM_UP:
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=side):  # recorded, not run
                self._update(phase)
            self._graphs[phase] = graph

    def _update(self, phase: Hashable) -> None:
        batch = self.store.batch(self.indices.index_select(0, self.position)[0])
        noise = {name: values.index_select(0, self.position)[0] for name, values in self.noise.items()}
        where = f"{type(self.algorithm).__name__}.update"
        if phase not in self._names:
            before = random_states(self.device)
            logs = self.algorithm.update(batch, noise, phase)
            if random_states(self.device) != before:
                inform(f"{where} draws random numbers that a resumed run would not repeat; use noise_spec")
            check_logs(logs, len(self.store.sizes), where)
            self._names[phase] = list(logs)
        else:
            logs = self.algorithm.update(batch, noise, phase)
        if self._names[phase] != list(logs):  # a replay would log those of the first update
            raise OffbenchError(f"{where} must log the same names at every update of phase {phase!r}")
        for name, value in logs.items():
            if name not in self.sums:
                self.sums[name] = torch.zeros_like(value, requires_grad=False)
            self.sums[name] += value.detach()
        self.position += 1

    def logged(self) -> list[dict[str, float]]:
        """Return each run's mean of everything logged since the last call: the loop's only synchronization."""
        means: list[dict[str, float]] = [{} for _ in self.earlier]
        for name, total in self.sums.items():
            counts = [self.counts[name] + earlier[name] for earlier in self.earlier]
            for mean, value, count in zip(
                means, (total / torch.tensor(counts).to(total)).tolist(), counts, strict=True
            ):
                if count:
                    mean[name] = value
            total.zero_()
        for counter in (self.counts, *self.earlier):
            counter.clear()
        return means

    def unlogged(self, run: int) -> Sums:
        """Return one run's sum and count of what has been logged since `logged` was called."""
        counts = self.counts + self.earlier[run]
        return [(name, float(self.sums[name][run]), count) for name, count in counts.items()]

    def resume_logging(self, run: int, sums: Sums) -> None:
        """Put `unlogged` sums back."""
        for name, total, count in sums:
            self.sums.setdefault(name, torch.zeros(len(self.store.sizes), device=self.device))[run] = total
            self.earlier[run][name] = count


def random_states(device: torch.device) -> tuple[object, ...]:
    """Return the states of the generators that are shared by all code."""
    shared = [torch.get_rng_state()] + ([torch.cuda.get_rng_state(device)] if device.type == "cuda" else [])
    return [state.numpy().tobytes() for state in shared], random.getstate(), repr(np.random.get_state())
