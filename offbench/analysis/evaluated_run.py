"""EvaluatedRun: a run as its tables and figures show it, read from its folder alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from offbench.common.scores import Evaluations, normalize, run_return, window
from offbench.common.text import from_to, plural
from offbench.training.run import Run
from offbench.training.run_config import RunConfig

Key = TypeVar("Key")


@dataclass(frozen=True)
class EvaluatedRun:
    """One run with its evaluations and losses.

    Attributes:
        files: the run's folder.
        losses: the rows of its losses.csv.
    """

    files: Run
    config: RunConfig
    evaluations: Evaluations
    losses: Sequence[Mapping[str, float]] = ()

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self.config.seed

    @property
    def window(self) -> tuple[int, ...]:
        """The steps of the evaluations behind the run's score."""
        return window(self.evaluations)

    @property
    def reached(self) -> int:
        """The newest evaluated step."""
        return max(self.evaluations)

    @property
    def steps(self) -> int:
        """The run's last step."""
        return self.config.steps

    @property
    def state(self) -> str:
        """`finished`, `unfinished` or `diverged`."""
        if self.reached >= self.steps:
            return "finished"
        return "diverged" if self.files.diverged else "unfinished"

    def up_to(self, step: int) -> EvaluatedRun:
        """Return the run as it was at its last evaluation within `step` updates; a shorter one as it is."""
        every = self.config.eval_every or 1
        config = replace(
            self.config,
            steps=self.config.steps if step >= self.config.steps else step // every * every,
            sessions=tuple(session for session in self.config.sessions if session.step < step),
        )
        evaluations = {at: episodes for at, episodes in self.evaluations.items() if at <= step}
        return EvaluatedRun(self.files, config, evaluations, [row for row in self.losses if row["step"] <= step])

    def score(self, reference: str | None) -> float:
        """Return the run's score by a reference that it has (None: its return)."""
        return self._normalized(run_return(self.evaluations), reference)

    def curve(self, reference: str | None) -> dict[int, float]:
        """Return the score of each evaluation."""
        means = {step: float(np.mean([ret for ret, _ in rows])) for step, rows in self.evaluations.items()}
        return {step: self._normalized(mean, reference) for step, mean in means.items()}

    def _normalized(self, value: float, reference: str | None) -> float:
        references = self.config.references.get(reference) if reference else None
        return normalize(value, *references) if references else value


def keys_with_mixed_code(runs: Iterable[tuple[Key, EvaluatedRun]]) -> list[Key]:
    """Return the keys whose runs were trained by different code of the algorithm, as far as their config.json says."""
    codes: dict[Key, set[tuple[tuple[str, str], ...]]] = {}
    for key, run in runs:
        if run.config.code:
            codes.setdefault(key, set()).add(tuple(run.config.code.items()))
    return [key for key, found in codes.items() if len(found) > 1]


def window_text(runs: Iterable[EvaluatedRun]) -> str:
    """Return which evaluations are behind the scores of runs: `10 evaluations, steps 5,000 to 50,000`."""
    windows = [run.window for run in runs]
    counts, ends = {len(steps) for steps in windows}, {end for steps in windows for end in (steps[0], steps[-1])}
    return f"{from_to(counts)} {plural(max(counts), 'evaluation')}, {plural(len(ends), 'step')} {from_to(ends)}"
