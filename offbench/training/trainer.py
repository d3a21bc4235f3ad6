"""The training loop of a job: from the newest common checkpoint to its runs' last step.

every eval_every steps:  checkpoint (less often if writing one takes long), then evaluate a snapshot on worker
                         processes while training continues
a deadline or Ctrl-C:    stops at the next chunk with a checkpoint; the same command resumes from it
a run that diverges:     is marked and left out from there on; the other runs continue, as they share nothing with it
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future

import numpy as np

from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.common.files import JsonObject, check_ownership, read_bytes, write_errors
from offbench.common.interrupts import collect_stop_signals
from offbench.common.provenance import training_platform
from offbench.common.scores import normalize
from offbench.common.seeds import Purpose
from offbench.common.terminal import inform
from offbench.data.transitions import Transitions
from offbench.rollouts.rollouts import EpisodeStats, Rollouts, gather
from offbench.training.claim import by_common_step, new_run_config
from offbench.training.loggers import Loggers
from offbench.training.registry import load_algorithm
from offbench.training.run import Run
from offbench.training.spec import Job
from offbench.training.stack import Stack, slice_of

LOG_EVERY = 1000  # updates per row of losses.csv
QUICK_SAVE = 1.0  # seconds; a checkpoint that takes longer is not written at every evaluation
SLOW_SAVE_SHARE = 0.05  # largest share of the time spent on slow checkpoints

STOPPED = "stopped with a checkpoint"  # the last note of a training that was interrupted

OnProgress = Callable[[int, str], None]  # takes the step and a note such as the last score


class Trainer:
    """The state of a job while it trains: the stack, its evaluations and losses, and the runs' files.

    Args:
        datasets: by the names that the job's specs give them.
    """

    def __init__(self, job: Job, datasets: Mapping[str, Transitions]) -> None:
        self.job = job
        self.runs: list[Run] = [spec.run for spec in job.specs]
        self.platform = training_platform(job.device, job.first.precision)
        self.stack = Stack(load_algorithm(job.first.algorithm), job.specs, datasets, job.device)
        self.loggers = Loggers(self.runs, job.loggers)
        self.evaluations: list[dict[int, list[tuple[float, int]]]] = [{} for _ in self.runs]
        self.losses: list[list[dict[str, float]]] = [[] for _ in self.runs]
        # (run, step, episodes) of evaluations that are being played
        self.pending: list[tuple[int, int, list[Future[list[EpisodeStats]]]]] = []
        self.rollouts: Rollouts | None = None
        self.note = ""
        self.diverged: dict[int, str] = {}  # runs that have diverged, and the message for the user
        self.configs: list[bytes] = []  # each run's config.json
        self.stops: list[int] = []  # signals received: Ctrl-C and SIGTERM
        self._saved, self._save_seconds = time.monotonic(), 0.0  # when the last checkpoint was written, and how fast

    def train(self, on_progress: OnProgress) -> list[str]:
        """Train from the newest step that all runs have a checkpoint of, to the last one or the deadline.

        Returns:
            A line for each run that has diverged.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM, once a checkpoint is written.
        """
        steps = self.job.first.steps
        with contextlib.ExitStack() as resources:
            self.stops = resources.enter_context(collect_stop_signals(second_at_once=True))
            for run in self.runs:
                resources.enter_context(run.locked())
            for run, spec, data in zip(self.runs, self.job.specs, self.stack.data, strict=True):
                run.check_claimed(new_run_config(spec, data, self.job.device, ""))
            if not (groups := by_common_step(self.job.specs)):
                return []  # another process has finished all runs since they were claimed
            if groups != [list(self.job.specs)] or any(run.diverged for run in self.runs):
                raise OffbenchError(
                    f"{self.job.title}: another process has trained some of these runs since this command began; run "
                    "it again"
                )
            self._resume()
            for run in self.runs:
                if self.stack.step:
                    checkpoints.keep_newest(run.folder, self.stack.step)  # a killed process may have left one more
                run.begin(self.stack.step, steps, self.platform)
            self.configs = [read_bytes(run.config_path) for run in self.runs]
            resources.enter_context(self.loggers)
            env_spec = self.stack.data[0].env_spec  # datasets of one stack are of one environment
            if env_spec:
                self.rollouts = resources.enter_context(Rollouts(env_spec, self.job.workers))
            on_progress(self.stack.step, "")
            if self._evaluates_at(self.stack.step) and self.stack.step:
                self._start_evaluations()
            while self.stack.step < steps and len(self.diverged) < len(self.runs):
                reached = self._train_to(self._next_evaluation(), on_progress)
                self._mark_diverged()
                self._finish_evaluations()  # evaluations of earlier steps are written first, so a resume misses none
                if self.stack.step and (not reached or self.stack.step == steps or self._checkpoint_is_due()):
                    self._checkpoint()
                if not reached:
                    break
                if self._evaluates_at(self.stack.step):
                    self._start_evaluations()
            self._finish_evaluations()
            self._write_loggers()
            saved = self.stops and self.stack.step and any(self._active())
            on_progress(self.stack.step, STOPPED if saved else self.note)
        return list(self.diverged.values())

    def _train_to(self, stop: int, on_progress: OnProgress) -> bool:
        """Train up to `stop`; return whether it was reached, False if the deadline, Ctrl-C or SIGTERM came first."""
        if self.stops:
            return False
        for step in self.stack.train_in_chunks(stop):
            late = self.job.deadline_passed and step < stop
            if step % LOG_EVERY == 0 or step == stop:
                for rows, row in zip(self.losses, self.stack.captured_update.logged(), strict=True):
                    rows.append({"step": step, **row})
            if self.pending and all(future.done() for *_, futures in self.pending for future in futures):
                self._finish_evaluations()
            on_progress(step, self.note)
            if late or self.stops:
                return False
        return True

    def _checkpoint_is_due(self) -> bool:
        """Return whether to write a checkpoint: always if that is quick, else for a small share of the time."""
        return self._save_seconds < QUICK_SAVE or time.monotonic() - self._saved > self._save_seconds / SLOW_SAVE_SHARE

    def _mark_diverged(self) -> None:
        """Leave out the runs that contain NaN or infinity; their files stay as of their last checkpoint."""
        for i, tensor in self.stack.diverged().items():
            if i not in self.diverged:
                run, step = self.runs[i], self.stack.step
                self.diverged[i] = f"{run.folder}: {tensor} became NaN or infinite by step {step}" + (
                    "; its last checkpoint is kept" if run.has_checkpoint else ""
                )
                run.mark_diverged(step, tensor)

    def _active(self) -> Iterator[tuple[int, Run]]:
        """Yield the runs that have not diverged, with their index."""
        return ((i, run) for i, run in enumerate(self.runs) if i not in self.diverged)

    def _next_evaluation(self) -> int:
        """Return the next step at which an evaluation is due, at most the last step."""
        every = self.job.first.eval_every
        return min(self.job.first.steps, (self.stack.step // every + 1) * every)

    def _evaluates_at(self, step: int) -> bool:
        return step % self.job.first.eval_every == 0 or step == self.job.first.steps

    def _resume(self) -> None:
        """Load the newest step that all runs have an intact checkpoint of, and drop what came after it.

        Raises:
            OffbenchError: there are checkpoints, but no intact ones of the same step.
        """
        common = set.intersection(*(set(checkpoints.steps(run.folder)) for run in self.runs))
        usable = sorted((step for step in common if step <= self.job.first.steps), reverse=True)
        for step in usable:
            loaded = [checkpoints.load_checkpoint(run.folder, step) for run in self.runs]
            if all(loaded):
                for i, (tensors, state) in enumerate(checkpoint for checkpoint in loaded if checkpoint):
                    self.stack.load(i, tensors, state)
                    self.stack.captured_update.resume_logging(i, state.get("unlogged", []))
                self.stack.step = step
                break
        if usable and not self.stack.step:
            raise OffbenchError(
                f"{self.job.title}: no step is left of which every run has an intact checkpoint; delete the runs "
                "whose checkpoints are damaged (see above), and rerun the command"
            )
        for i, run in enumerate(self.runs):
            if self.stack.step and not run.policy_path.exists():  # deleted by the user; the checkpoint has it
                self.stack.policy(i).save(run.policy_path)
            if self.stack.step and not run.losses_path.exists():
                inform(f"{run.losses_path} is missing; it starts again at this step")
            # an evaluation at the end of a shorter training may lie between this one's
            self.evaluations[i] = {
                step: episodes
                for step, episodes in run.evaluations().items()
                if step <= self.stack.step and self._evaluates_at(step)
            }
            self.losses[i] = [row for row in run.losses() if row["step"] <= self.stack.step]

    def _checkpoint(self) -> None:
        """Write everything up to now."""
        began = time.monotonic()
        step = self.stack.step
        tensors = {name: tensor.detach().cpu() for name, tensor in self.stack.tensors().items()}
        for i, run in self._active():
            self._check_config(i)
            with write_errors(str(run.folder)):
                run.write_evaluations(self.evaluations[i])
                run.write_losses(self.losses[i])
                self.stack.policy(i).save(run.policy_path)
                state: JsonObject = {"step": step, "origin": self.stack.checkpoint_origin(i)}
                unlogged = self.stack.captured_update.unlogged(i)
                if unlogged:  # stopped between two rows of losses.csv
                    state["unlogged"] = unlogged
                checkpoints.save_checkpoint(run.folder, step, slice_of(tensors, i), state)
                checkpoints.keep_newest(run.folder, step)
        self._write_loggers()
        self._saved = time.monotonic()
        self._save_seconds = self._saved - began

    def _check_config(self, i: int) -> None:
        """Check that a run's config.json is still there and the same, as its results mean nothing without it."""
        path = self.runs[i].config_path
        check_ownership(path)
        with contextlib.suppress(OSError):
            if read_bytes(path) == self.configs[i]:
                return
        raise OffbenchError(
            f"{path} was deleted or changed during the training; put it back and rerun the command to resume from the "
            "last checkpoint"
        )

    def _write_loggers(self) -> None:
        """Send what the last checkpoint keeps to the loggers."""
        for i, _ in self._active():
            self.loggers.write(i, self.losses[i], self.evaluations[i])

    def _start_evaluations(self) -> None:
        """Start the evaluation of every run's policy at this step, unless there is one already."""
        step = self.stack.step
        if self.rollouts is None:
            return
        for i, spec in enumerate(self.job.specs):
            if self.stops:
                return  # resuming evaluates what is missing at its first step
            if i not in self.diverged and step not in self.evaluations[i]:
                stream = (int(Purpose.EVALUATION), step)
                policy = self.stack.policy(i)
                self.pending.append(
                    (i, step, self.rollouts.start_evaluation(policy, spec.seed, stream, spec.eval_episodes, True))
                )

    def _finish_evaluations(self) -> None:
        """Wait for all evaluations that are running, and write them to the runs' files."""
        for i, step, futures in self.pending:
            self.evaluations[i][step] = [(episode.ret, episode.length) for episode in gather(futures)]
            self.runs[i].write_evaluations(self.evaluations[i])
        if self.pending:
            self.note = self._score_note(self.pending[0][1])
        self.pending = []

    def _score_note(self, step: int) -> str:
        """Return the mean score of the runs at `step`, or the mean return if the dataset has no references."""
        evaluations = [self.evaluations[i] for i, _ in self._active()]
        means = [float(np.mean([ret for ret, _ in e[step]])) for e in evaluations if step in e]
        if not means:
            return ""
        references = self.stack.data[0].references
        if references is None:
            return f"return {np.mean(means):.0f} at step {step:,}"
        return f"score {np.mean([normalize(mean, *references) for mean in means]):z.1f} at step {step:,}"
