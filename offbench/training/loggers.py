"""Optional loggers: TensorBoard event files in each run's folder, and Weights & Biases.

Both are sent what losses.csv and evaluations.csv hold, and only when a checkpoint is written, so a run that is killed
and resumed shows every step once. TensorBoard's files are written again when training resumes; the last steps sent to
W&B are kept in the run's wandb.json.
"""

from __future__ import annotations

import contextlib
import importlib.util
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType

import numpy as np

from offbench.common.errors import OffbenchError
from offbench.common.files import read_json, write_errors, write_json
from offbench.common.scores import Evaluations, normalize
from offbench.common.settings import read_back
from offbench.training.run import Run

Losses = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class LoggerOptions:
    """Which loggers to use.

    Attributes:
        tensorboard: event files in each run's folder `tensorboard`.
        wandb: a Weights & Biases project, or None.
    """

    tensorboard: bool = False
    wandb: str | None = None

    def check(self) -> None:
        """Raise OffbenchError if a package is missing, before anything is trained."""
        requested = {"tensorboard": self.tensorboard, "wandb": self.wandb is not None}
        for package, is_requested in requested.items():
            spec = importlib.util.find_spec(package)
            if is_requested and (spec is None or spec.origin is None):  # no origin: a folder, such as W&B writes
                raise OffbenchError(f"--{package} needs the package {package}: pip install 'offbench[{package}]'")


NO_LOGGERS = LoggerOptions()


class Loggers(contextlib.AbstractContextManager["Loggers"]):
    """The loggers of a job's runs, open while it trains."""

    def __init__(self, runs: Sequence[Run], options: LoggerOptions) -> None:
        self.runs, self.options = list(runs), options
        self.of_runs: list[list[TensorBoard | WandB]] = [[] for _ in runs]
        self._closing = contextlib.ExitStack()  # closes all of them, also if one fails

    def __enter__(self) -> Loggers:
        with contextlib.ExitStack() as opened:
            for run, loggers in zip(self.runs, self.of_runs, strict=True):
                if self.options.tensorboard:
                    loggers.append(opened.enter_context(contextlib.closing(TensorBoard(run))))
                if self.options.wandb is not None:
                    loggers.append(opened.enter_context(contextlib.closing(WandB(run, self.options.wandb))))
            self._closing = opened.pop_all()
        return self

    def __exit__(self, exception_type: type[BaseException] | None, _: object, __: TracebackType | None) -> None:
        self._closing.close()

    def write(self, index: int, losses: Losses, evaluations: Evaluations) -> None:
        """Send all rows of the run at `index`."""
        for logger in self.of_runs[index]:
            logger.write(losses, evaluations)


class TensorBoard:
    """Event files in `<run>/tensorboard` with the rows of losses.csv and evaluations.csv."""

    def __init__(self, run: Run) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder = _folder(run, "tensorboard")
        with write_errors(str(folder)):
            # those of an earlier session may hold steps after the checkpoint that this one resumes from
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
            self.writer = SummaryWriter(str(folder))
        self.reference, self.sent = _reference(run), (-1, -1)

    def write(self, losses: Losses, evaluations: Evaluations) -> None:
        """Append the steps that are not in the file yet."""
        rows, self.sent = _unsent(losses, evaluations, self.sent, self.reference)
        for step, values in rows:
            for name, value in values.items():
                self.writer.add_scalar(name, value, step)
        self.writer.flush()

    def close(self) -> None:
        """Close the file."""
        self.writer.close()


@dataclass(frozen=True)
class WandBState:
    """A run's wandb.json: its W&B project and id, and the last steps sent of losses and evaluations."""

    project: str
    id: str
    losses: int = -1
    evaluations: int = -1


class WandB:
    """A run of Weights & Biases."""

    def __init__(self, run: Run, project: str) -> None:
        import wandb

        config = run.config()
        _folder(run, "wandb")
        self.path, self.reference = run.folder / "wandb.json", _reference(run)
        self.state = WandBState(project, secrets.token_hex(6))
        if self.path.exists():
            remedy = "delete it to send everything to a new W&B run"
            earlier = read_back(WandBState, read_json(self.path, remedy), self.path, remedy)
            self.state = earlier if earlier.project == project else self.state
        write_json(self.path, asdict(self.state))
        shown = ("algorithm", "variant", "dataset", "dataset_sha256", "seed", "settings", "versions", "command")
        try:
            self.run = wandb.init(
                project=project,
                id=self.state.id,
                name="/".join(run.folder.parts[-4:]),
                config={key: getattr(config, key) for key in shown},
                dir=str(run.folder),
                resume="allow",
                reinit="create_new",  # a stack's runs are open side by side
                settings=wandb.Settings(silent=True, console="off"),
            )
        except Exception as error:  # W&B raises many kinds: no key, no network, no such team
            raise OffbenchError(
                f"Weights & Biases: {error}; log in with `wandb login`, set WANDB_MODE=offline, or leave out --wandb"
            ) from None
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")  # evaluations arrive after later losses

    def write(self, losses: Losses, evaluations: Evaluations) -> None:
        """Send the steps that no session has sent."""
        rows, sent = _unsent(losses, evaluations, (self.state.losses, self.state.evaluations), self.reference)
        if not rows:
            return
        self.state = replace(self.state, losses=sent[0], evaluations=sent[1])
        write_json(self.path, asdict(self.state))  # before sending: a kill in between must not send rows twice
        for step, values in rows:
            self.run.log({"step": step, **values})

    def close(self) -> None:
        """Finish the W&B run."""
        self.run.finish()


def _folder(run: Run, name: str) -> Path:
    """Return a logger's folder. A link is refused: its files would be written, and deleted, elsewhere."""
    folder = run.folder / name
    if folder.is_symlink():
        raise OffbenchError(f"{folder} is a link; delete it, so that {name} writes into the run's own folder")
    return folder


def _unsent(
    losses: Losses, evaluations: Evaluations, sent: tuple[int, int], reference: tuple[float, float] | None
) -> tuple[list[tuple[int, dict[str, float]]], tuple[int, int]]:
    """Return the (step, values) after `sent`, the last steps of losses and evaluations, and the new last steps."""
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
