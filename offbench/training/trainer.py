"""The training loop: a stack of runs, from its members to their checkpoints and evaluations.

every eval_every steps:  checkpoint, then evaluate a snapshot on worker processes while training goes on
a deadline, or Ctrl-C:   stops at the next chunk with a checkpoint; the same command goes on from there
a run that diverges:     is left out from there on and marked; the others go on, they share nothing with it
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from offbench.algorithm.interface import Algorithm
from offbench.common import checkpoints
from offbench.common.files import disk_errors
from offbench.common.processes import stops_noted
from offbench.common.provenance import made_with
from offbench.common.scores import normalize
from offbench.common.seeds import Purpose
from offbench.rollouts.rollouts import Outcome, Rollouts, result
from offbench.training.batches import Member
from offbench.training.loggers import NOWHERE, Destinations, Loggers
from offbench.training.stack import Stack, slice_of

LOG_EVERY = 1000  # updates behind a row of losses.csv
QUICK = 1.0  # seconds; checkpoints that take longer are not written at every evaluation
SHARE = 0.05  # of the time that slow checkpoints may take

STOPPED = "stopped with a checkpoint"  # the last note of a training that was interrupted

Report = Callable[[int, str], None]  # takes the step and a note such as the last score


@dataclass(frozen=True)
class Schedule:
    """How long a stack trains, and when it is evaluated.

    Attributes:
        steps: updates of each run.
        eval_every, eval_episodes: every so many updates, so many episodes.
        device: PyTorch's name of it.
        workers: evaluation processes; 0 evaluates in this process.
        deadline: time.time() after which the stack stops at its next chunk, None for never.
        show: live views of the training, none by default.
    """

    steps: int
    eval_every: int
    eval_episodes: int
    device: str
    workers: int
    deadline: float | None = None
    show: Destinations = NOWHERE
    precision: str = "float32"


class Trainer:
    """A stack with its files: checkpoints, losses, evaluations beside the training."""

    def __init__(self, kind: type[Algorithm], members: Sequence[Member], schedule: Schedule) -> None:
        self.members, self.schedule = list(members), schedule
        self.made = made_with(schedule.device, schedule.precision)
        self.stack = Stack(kind, members, schedule.device)
        self.loggers = Loggers([member.run for member in members], schedule.show)
        self.evaluations: list[dict[int, list[tuple[float, int]]]] = [{} for _ in members]
        self.losses: list[list[dict[str, float]]] = [[] for _ in members]
        self.pending: list[tuple[int, int, Future[list[Outcome]]]] = []  # (run, step, outcomes)
        self.rollouts: Rollouts | None = None
        self.note = ""
        self.lost: dict[int, str] = {}  # runs that have diverged, and how
        self.stops: list[int] = []  # Ctrl-C and SIGTERM, as they came
        self._saved, self._took = time.monotonic(), 0.0  # when the last checkpoint was written, and how long it took

    def train(self, report: Report) -> list[str]:
        """Go on from the newest step that all runs have, to the schedule's end or its deadline.

        Returns:
            A line for each run that has diverged.

        Raises:
            KeyboardInterrupt: Ctrl-C came, or whatever SIGTERM does, once a checkpoint is written.
        """
        with contextlib.ExitStack() as resources:
            self.stops = resources.enter_context(stops_noted(second_at_once=True))
            for member in self.members:
                resources.enter_context(member.run.locked())
            self._resume()
            for member in self.members:
                member.run.begin(self.stack.step, self.schedule.steps, self.made)
            resources.enter_context(self.loggers)
            spec = self.members[0].data.env_spec  # datasets of one stack are of one environment
            if spec:
                self.rollouts = resources.enter_context(Rollouts(spec, self.schedule.workers))
            report(self.stack.step, "")
            if self._evaluates_at(self.stack.step) and self.stack.step:
                self._evaluate()
            while self.stack.step < self.schedule.steps and len(self.lost) < len(self.members):
                in_time = self._train_to(self._next_stop(), report)
                self._mark_diverged()
                self._collect()  # evaluations of earlier steps land first, so a resume misses none
                if self.stack.step and (not in_time or self.stack.step == self.schedule.steps or self._has_time()):
                    self._checkpoint()
                if not in_time:
                    break
                if self._evaluates_at(self.stack.step):
                    self._evaluate()
            self._collect()
            self._show()
            saved = self.stops and self.stack.step and any(self._going())
            report(self.stack.step, STOPPED if saved else self.note)
        return list(self.lost.values())

    def _train_to(self, stop: int, report: Report) -> bool:
        """Train up to `stop`; return False if the deadline, Ctrl-C or SIGTERM came first."""
        if self.stops:
            return False
        for step in self.stack.train(stop):
            late = self.schedule.deadline is not None and time.time() > self.schedule.deadline and step < stop
            if step % LOG_EVERY == 0 or step == stop:
                for rows, row in zip(self.losses, self.stack.logged(), strict=True):
                    rows.append({"step": step, **row})
            self._arrived()
            report(step, self.note)
            if late or self.stops:
                return False
        return True

    def _has_time(self) -> bool:
        """Whether a checkpoint is due: always if they are quick, else when they take a small share of the time."""
        return self._took < QUICK or time.monotonic() - self._saved > self._took / SHARE

    def _mark_diverged(self) -> None:
        """Leave out the runs that hold NaN or infinity: their files stay as their last checkpoint left them."""
        for run, tensor in self.stack.diverged().items():
            if run not in self.lost:
                folder = self.members[run].run.folder
                self.lost[run] = (
                    f"{folder}: {tensor} became NaN or infinite by step {self.stack.step}; its last checkpoint is kept"
                )
                self.members[run].run.mark_diverged(self.stack.step, tensor)

    def _going(self) -> Iterator[tuple[int, Member]]:
        return ((run, member) for run, member in enumerate(self.members) if run not in self.lost)

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
                for run, (tensors, state) in enumerate(f for f in found if f):
                    self.stack.load(run, tensors)
                    self.stack.program.go_on_logging(run, state.get("unlogged", []))
                self.stack.step = step
                break
        for run, member in enumerate(self.members):
            if self.stack.step and not member.run.policy_path.exists():  # somebody deleted it: the checkpoint has it
                self.stack.policy(run).save(member.run.policy_path)
            if self.stack.step and not member.run.losses_path.exists():
                print(f"offbench: {member.run.losses_path} is gone: its rows begin again here", file=sys.stderr)
            known, rows = member.run.evaluations(), member.run.losses()
            # an evaluation at the end of a shorter schedule may lie off this one's grid
            self.evaluations[run] = {s: e for s, e in known.items() if s <= self.stack.step and self._evaluates_at(s)}
            self.losses[run] = [row for row in rows if row.get("step", math.inf) <= self.stack.step]

    def _checkpoint(self) -> None:
        """Write everything up to now."""
        began = time.monotonic()
        step = self.stack.step
        tensors = {name: tensor.detach().cpu() for name, tensor in self.stack.tensors().items()}
        for run, member in self._going():
            folder = member.run.folder
            with disk_errors(str(folder)):
                member.run.write_evaluations(self.evaluations[run])
                member.run.write_losses(self.losses[run])
                self.stack.policy(run).save(member.run.policy_path)
                state: dict[str, Any] = {"step": step}
                unlogged = self.stack.program.unlogged(run)
                if unlogged:  # stopped by the clock, between two rows of losses.csv
                    state["unlogged"] = unlogged
                checkpoints.save_checkpoint(folder, step, slice_of(tensors, run), state)
                checkpoints.keep_newest(folder)
        self._show()
        self._saved = time.monotonic()
        self._took = self._saved - began

    def _show(self) -> None:
        """Send what the last checkpoint keeps to the live views."""
        for run, _ in self._going():
            self.loggers.write(run, self.losses[run], self.evaluations[run])

    def _evaluate(self) -> None:
        """Start the evaluation of every run's policy as it is now, unless it is known already."""
        step = self.stack.step
        if self.rollouts is None:
            return
        for run, member in self._going():
            if self.stops:
                return  # resuming evaluates what is missing at its first step
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
        found = [self.evaluations[run] for run, _ in self._going()]
        means = [float(np.mean([ret for ret, _ in e[step]])) for e in found if step in e]
        if not means:
            return ""
        references = self.members[0].data.references
        if references is None:
            return f"return {np.mean(means):.0f}"
        return f"score {np.mean([normalize(mean, *references) for mean in means]):.1f}"
