"""Live views of a training, on request: TensorBoard event files beside each run, Weights & Biases.

Both get what losses.csv and evaluations.csv hold, whenever a checkpoint is written: nothing that a kill could take
back, so a resumed run shows every step once. TensorBoard's files are written anew when a training goes on; what
W&B has got is noted in the run's wandb.json. Neither is needed for anything else.
"""

from __future__ import annotations

import contextlib
import importlib.util
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from offbench.common.errors import OffbenchError
from offbench.common.files import disk_errors, read_json, write_json
from offbench.common.scores import normalize
from offbench.training.run import Run

Losses = Sequence[Mapping[str, float]]
Evaluations = Mapping[int, Sequence[tuple[float, int]]]


@dataclass(frozen=True)
class Destinations:
    """Where a training is to be shown.

    Attributes:
        tensorboard: write event files into each run's folder `tensorboard`.
        wandb: a project of Weights & Biases.
    """

    tensorboard: bool = False
    wandb: str | None = None

    def check(self) -> None:
        """Raise OffbenchError if a package is missing, before anything is trained."""
        wanted = {"tensorboard": self.tensorboard, "wandb": self.wandb is not None}
        for package, asked in wanted.items():
            if asked and importlib.util.find_spec(package) is None:
                raise OffbenchError(f"--{package} needs the package {package}: pip install 'offbench[{package}]'")


NOWHERE = Destinations()


class Sink(Protocol):
    """One run's view in one place."""

    def write(self, losses: Losses, evaluations: Evaluations) -> None:
        """Take in all that is known of the run; send what is new."""

    def close(self) -> None:
        """End it."""


class Loggers(contextlib.AbstractContextManager["Loggers"]):
    """The views of a stack's runs, open for as long as it trains."""

    def __init__(self, runs: Sequence[Run], to: Destinations) -> None:
        self.runs, self.to = list(runs), to
        self.sinks: list[list[Sink]] = [[] for _ in runs]

    def __enter__(self) -> Loggers:
        for run, sinks in zip(self.runs, self.sinks, strict=True):
            if self.to.tensorboard:
                sinks.append(TensorBoard(run))
            if self.to.wandb is not None:
                sinks.append(WandB(run, self.to.wandb))
        return self

    def __exit__(self, kind: type[BaseException] | None, _: object, __: TracebackType | None) -> None:
        for sink in (sink for sinks in self.sinks for sink in sinks):
            sink.close()

    def write(self, place: int, losses: Losses, evaluations: Evaluations) -> None:
        """Show all that is known of the run at `place`."""
        for sink in self.sinks[place]:
            sink.write(losses, evaluations)


class TensorBoard:
    """Event files in `<run>/tensorboard`, always equal to what losses.csv and evaluations.csv held when written."""

    def __init__(self, run: Run) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder = run.folder / "tensorboard"
        with disk_errors(str(folder)):
            # those of an earlier process may hold steps after the checkpoint that it goes on from
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self.writer = SummaryWriter(str(folder))
        self.reference, self.sent = _reference(run), (-1, -1)

    def write(self, losses: Losses, evaluations: Evaluations) -> None:
        """Append the steps that are not in the file yet."""
        rows, self.sent = _news(losses, evaluations, self.sent, self.reference)
        for step, values in rows:
            for name, value in values.items():
                self.writer.add_scalar(name, value, step)
        self.writer.flush()

    def close(self) -> None:
        """Close the file."""
        self.writer.close()


class WandB:
    """A run of Weights & Biases. `wandb.json` notes its id and what it has got."""

    def __init__(self, run: Run, project: str) -> None:
        import wandb

        config = run.config()
        self.path, self.reference = run.folder / "wandb.json", _reference(run)
        known = read_json(self.path) if self.path.exists() else {}
        if known.get("project") != project:
            known = {"project": project, "id": secrets.token_hex(6), "losses": -1, "evaluations": -1}
            write_json(self.path, known)
        self.known: dict[str, Any] = known
        shown = ("algorithm", "variant", "dataset", "dataset_sha256", "seed", "settings", "versions", "command")
        try:
            self.run = wandb.init(
                project=project,
                id=known["id"],
                name="/".join(run.folder.parts[-4:]),
                config={key: getattr(config, key) for key in shown},
                dir=str(run.folder),
                resume="allow",
                reinit="create_new",  # a stack's runs are open side by side
                settings=wandb.Settings(silent=True, console="off"),
            )
        except Exception as error:  # its own errors are many: no key, no network, no such team
            raise OffbenchError(
                f"Weights & Biases: {error}; log in with `wandb login`, set WANDB_MODE=offline, or leave out --wandb"
            ) from None
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")  # evaluations arrive after later losses

    def write(self, losses: Losses, evaluations: Evaluations) -> None:
        """Send the steps that were never sent."""
        rows, sent = _news(losses, evaluations, (self.known["losses"], self.known["evaluations"]), self.reference)
        if not rows:
            return
        self.known |= {"losses": sent[0], "evaluations": sent[1]}
        write_json(self.path, self.known)  # first: a kill in between must not send them twice
        for step, values in rows:
            self.run.log({"step": step, **values})

    def close(self) -> None:
        """Finish it."""
        self.run.finish()


def _news(
    losses: Losses, evaluations: Evaluations, sent: tuple[int, int], reference: tuple[float, float] | None
) -> tuple[list[tuple[int, dict[str, float]]], tuple[int, int]]:
    """Return (step, values) of what comes after the steps sent, in order, and the new last steps."""
    rows = [
        (int(row["step"]), {f"losses/{name}": value for name, value in row.items() if name != "step"})
        for row in losses
        if row["step"] > sent[0]
    ]
    last = (max([sent[0], *(step for step, _ in rows)]), max([sent[1], *evaluations]))
    for step, episodes in evaluations.items():
        if step > sent[1]:
            returns, lengths = zip(*episodes, strict=True)
            values = {"evaluation/return": float(np.mean(returns)), "evaluation/length": float(np.mean(lengths))}
            if reference:
                values["evaluation/score"] = normalize(values["evaluation/return"], *reference)
            rows.append((step, values))
    return sorted(rows, key=lambda row: row[0]), last


def _reference(run: Run) -> tuple[float, float] | None:
    """Return the run's own reference, if its dataset has one."""
    return run.config().references.get("dataset")
