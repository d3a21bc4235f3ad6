"""Run folders: plain files that a person can read; `normalize` and `report` need nothing else.

runs/<dataset>/<algorithm>/<variant>/seed-<n>/
    config.json           settings, dataset and its references, seed, versions, hardware, command (RunConfig)
    evaluations.csv       step, episode, return, length: every evaluation episode
    losses.csv            step and the mean of each logged quantity since the row before
    policy.safetensors    the policy at the last checkpoint
    checkpoint-*.safetensors   the newest two; the same command resumes from them
    diverged.json         only if the run became NaN or infinite: at which step, in which tensor
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from offbench.common.code_hash import describe_changes
from offbench.common.errors import DamagedError, OffbenchError
from offbench.common.files import (
    csv_bytes,
    delete,
    exclusive_lock,
    open_regular,
    read_errors,
    read_json,
    remove_leftovers,
    write_bytes,
    write_json,
)
from offbench.common.provenance import TrainingPlatform
from offbench.common.scores import MAX_VALUE, Evaluations, check_steps
from offbench.common.settings import read_back
from offbench.training.former_settings import current_settings
from offbench.training.run_config import FORMAT, RunConfig, Session

EVALUATION_COLUMNS = ("step", "episode", "return", "length")
DELETE_TO_REPEAT = "delete the run to repeat it"
TRAIN_ANEW = "delete that run (`train` does with --fresh) or give another --runs"
MUST_MATCH = ("algorithm", "settings", "dataset", "dataset_sha256", "seed", "eval_every", "eval_episodes")


@dataclass(frozen=True)
class Run:
    """One run's directory."""

    folder: Path

    @property
    def config_path(self) -> Path:
        """Settings and provenance."""
        return self.folder / "config.json"

    @property
    def policy_path(self) -> Path:
        """The policy at the last checkpoint."""
        return self.folder / "policy.safetensors"

    @property
    def evaluations_path(self) -> Path:
        """Every evaluation episode."""
        return self.folder / "evaluations.csv"

    @property
    def losses_path(self) -> Path:
        """The mean of each logged quantity."""
        return self.folder / "losses.csv"

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder and delete leftovers. Raises OffbenchError if another process trains the run."""
        with exclusive_lock(self.folder / ".lock", f"{self.folder} is being trained"):
            remove_leftovers(self.folder)
            yield

    def config(self) -> RunConfig:
        """Read config.json. Raises OffbenchError if it is missing or damaged."""
        if not self.config_path.exists():
            raise OffbenchError(
                f"no run in {self.folder} (no config.json); a run is RUNS/DATASET/ALGORITHM/VARIANT/seed-N"
            )
        values = read_json(self.config_path, DELETE_TO_REPEAT)
        later = values.get("sessions")
        for session in [values, *(later if isinstance(later, list) else [])]:
            if isinstance(session, dict):  # earlier versions wrote tf32 (true or false) instead of precision
                session.setdefault("precision", "tf32" if session.get("tf32") else "float32")
        return read_back(RunConfig, values, self.config_path, DELETE_TO_REPEAT)

    def check(self, config: RunConfig) -> None:
        """Check that the folder can be claimed; write nothing.

        Raises:
            OffbenchError: it holds another run with a checkpoint, or a run without its config.json.
        """
        if self._has_results and not self.config_path.exists():
            raise OffbenchError(f"{self.folder} holds a run without its config.json; put it back, or delete the run")
        if self._has_results and (reason := self._mismatch(config)):
            raise OffbenchError(f"{reason}; {TRAIN_ANEW}")

    def check_claimed(self, config: RunConfig) -> None:
        """Check, with the lock held, that this is the run of `config`, of any code. Raises OffbenchError if not."""
        now = self.config()
        if reason := self._mismatch(dataclasses.replace(config, code=now.code, env_code=now.env_code)):
            raise OffbenchError(f"{reason}; run the command again")

    def claim(self, config: RunConfig) -> None:
        """Write config.json; only a new label, if the folder holds this run already.

        A run that stopped before its first checkpoint starts over.

        Raises:
            OffbenchError: as `check`.
        """
        self.check(config)
        if not self.config_path.exists() or self._mismatch(config):
            with self.locked():
                self.check(config)  # another process may have trained the run since
                if self.config_path.exists() and self._mismatch(config):
                    self._delete_contents()
                if not self.config_path.exists():
                    values = dataclasses.asdict(config)
                    write_json(self.config_path, {k: v for k, v in values.items() if k != "sessions" or v})
        self._relabel(config.label)

    def _relabel(self, label: str) -> None:
        """Record another label; an empty one changes nothing."""
        if label not in ("", self.config().label):
            with self.locked():
                write_json(self.config_path, dict(read_json(self.config_path, DELETE_TO_REPEAT), label=label))

    @property
    def has_checkpoint(self) -> bool:
        """Whether the folder has a checkpoint; it is written after all other files."""
        return any(self.folder.glob("checkpoint-*.safetensors"))

    @property
    def _has_results(self) -> bool:
        """Whether the folder has what training writes; a run that stopped before that starts over."""
        return self.has_checkpoint or self.evaluations_path.exists() or self.policy_path.exists()

    def _mismatch(self, config: RunConfig) -> str:
        """Return why the run in this folder is not the one of `config`, "" if it is."""
        existing = self.config()
        for key in MUST_MATCH:
            old, new = getattr(existing, key), getattr(config, key)
            if key == "settings":
                old = current_settings(existing.algorithm, old, str(self.folder))
            if old == new:
                continue
            if key == "dataset_sha256":
                what = f"another content of {config.dataset}, which has been recorded again since"
                return f"{self.folder} was trained on {what}"
            if key == "settings":
                differ = [name for name in {**old, **new} if old.get(name) != new.get(name)]
                was = ", ".join(f"{name} {old.get(name)}" for name in differ)
                return f"{self.folder} was started with {was}, not {', '.join(str(new.get(name)) for name in differ)}"
            if key.startswith("eval"):
                flag = f"--{key.replace('_', '-')}"
                return f"{self.folder} was started with {flag} {old}, not {new} (to continue it, give {flag} {old})"
            return f"{self.folder} was started with {key} {old}, not {new}"
        changed = describe_changes(existing.code, config.code)
        if changed:
            return f"{self.folder} was trained by other code of {config.algorithm}: {changed}"
        changed = describe_changes(existing.env_code, config.env_code)
        return f"{self.folder} was evaluated in other code of its environment: {changed}" if changed else ""

    def check_unlocked(self) -> None:
        """Raise OffbenchError if another process trains the run."""
        if self.config_path.exists():
            with self.locked():
                pass

    def clear(self) -> None:
        """Delete what the folder holds, if it holds a run, so that it is trained again."""
        if self.config_path.exists():
            with self.locked():
                self._delete_contents()

    def _delete_contents(self) -> None:
        """Delete what the folder holds, with the lock held; config.json goes last."""
        # newest checkpoint first: what a killed process leaves must not be taken for a finished run
        early = [self.folder / "similarity.json", *sorted(self.folder.glob("checkpoint-*"), reverse=True)]
        late = {*self.folder.iterdir()} - {*early, self.config_path, self.folder / ".lock"}
        for path in (*early, *late, self.config_path):
            delete(path)

    def begin(self, step: int, steps: int, platform: TrainingPlatform) -> None:
        """Record in config.json that the run trains from `step` to `steps`, and the platform if it has changed.

        Args:
            platform: from offbench.common.provenance.training_platform.
        """
        config, written = self.config(), read_json(self.config_path, DELETE_TO_REPEAT)
        changed = dict(written, steps=max(steps, config.steps))
        if dataclasses.replace(config.history[-1], step=step) != (session := Session(step=step, **platform)):
            changed["sessions"] = [*written.get("sessions", []), dataclasses.asdict(session)]
        if changed != written:
            write_json(self.config_path, changed)

    def mark_diverged(self, step: int, tensor: str) -> None:
        """Record that the run cannot continue: `tensor` held NaN or infinity at `step`."""
        write_json(self.folder / "diverged.json", {"step": step, "tensor": tensor})

    @property
    def diverged(self) -> bool:
        """Whether the run is marked as diverged; it is not trained any further until diverged.json is deleted."""
        return (self.folder / "diverged.json").exists()

    def newest_checkpoint(self) -> int:
        """Return the step of the newest checkpoint, 0 if there is none."""
        from offbench.common import checkpoints  # imports PyTorch, which `normalize` does without

        return max(checkpoints.steps(self.folder), default=0)

    def finished(self, steps: int) -> bool:
        """Return whether the run is done: checkpoint and evaluation of step `steps`, and a policy."""
        from offbench.common import checkpoints  # imports PyTorch, which `normalize` does without

        if (
            steps not in checkpoints.steps(self.folder)
            or not self.config_path.exists()
            or not self.policy_path.exists()
        ):
            return False
        return not self.config().env_spec or steps in self.evaluations()

    def evaluations(self) -> dict[int, list[tuple[float, int]]]:
        """Return {step: [(return, length) of each episode]} in order of steps; {} if there are none yet.

        Raises:
            OffbenchError: the file is damaged: a row is malformed, an episode is missing or duplicated, or the steps
                are not those at which config.json has evaluations.
        """
        if not self.evaluations_path.exists():
            if self.has_checkpoint:  # written after it
                raise DamagedError(f"{self.evaluations_path} is missing; put it back, or delete the run to repeat it")
            return {}
        config = self.config() if self.config_path.exists() else None
        last, count = (config.steps, config.eval_episodes) if config else (MAX_VALUE, 0)
        evaluations: dict[int, list[tuple[float, int]]] = {}
        with read_errors(str(self.evaluations_path), "is damaged", DELETE_TO_REPEAT):
            with open(self.evaluations_path, newline="", encoding="utf-8", opener=open_regular) as file:
                reader = csv.DictReader(file, strict=True)
                if tuple(reader.fieldnames or ()) != EVALUATION_COLUMNS:
                    raise ValueError(f"its columns are {reader.fieldnames}")
                for row in reader:
                    if None in row or None in row.values():
                        raise ValueError(f"line {reader.line_num} does not have {len(EVALUATION_COLUMNS)} cells")
                    value, step = _number(row["return"]), _count(row["step"])
                    if not abs(value) < MAX_VALUE:
                        raise ValueError(f"a return is {value}")
                    if not 0 < step <= last:
                        raise ValueError(f"step {step} of a run of {last} steps")
                    episodes = evaluations.setdefault(step, [])
                    if _count(row["episode"]) != len(episodes):
                        raise ValueError(f"episode {len(episodes)} of step {step} is missing, or one is duplicated")
                    episodes.append((value, _count(row["length"])))
            for step, episodes in evaluations.items():
                if len(episodes) != (count or len(episodes)):
                    raise ValueError(f"step {step} has {len(episodes)} episodes, not {count}")
            evaluations = dict(sorted(evaluations.items()))
            if config and config.eval_every:
                check_steps(list(evaluations), config.eval_every)
        return evaluations

    def write_evaluations(self, evaluations: Evaluations) -> None:
        """Replace evaluations.csv."""
        rows = (
            (step, i, repr(value), length)
            for step, episodes in sorted(evaluations.items())
            for i, (value, length) in enumerate(episodes)
        )
        write_bytes(self.evaluations_path, csv_bytes(EVALUATION_COLUMNS, rows))

    def write_losses(self, rows: list[dict[str, float]]) -> None:
        """Replace losses.csv; a quantity that was not logged in a row stays empty."""
        columns = list(dict.fromkeys(key for row in rows for key in row))
        lines = ([int(row[key]) if key == "step" else _short(row.get(key, "")) for key in columns] for row in rows)
        write_bytes(self.losses_path, csv_bytes(columns, lines))

    def losses(self) -> list[dict[str, float]]:
        """Read losses.csv ([] if there is none)."""
        path = self.losses_path
        if not path.exists():
            return []
        with (
            read_errors(str(path), "is damaged", DELETE_TO_REPEAT),
            open(path, newline="", encoding="utf-8", opener=open_regular) as file,
        ):
            rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file, strict=True)]
            steps = [row.get("step", -1.0) for row in rows]
            if not all(low < high for low, high in itertools.pairwise([-1.0, *steps, MAX_VALUE])):
                raise ValueError("its steps are missing, out of order or out of range")
            return rows


def _number(text: str) -> float:
    """Return a number as offbench writes it; `float` takes `1_000`, spaces and digits of other scripts, too."""
    if "_" in text or not text.isascii() or text != text.strip():
        raise ValueError(f"{text[:40]!r} is not a return")
    return float(text)


def _count(text: str) -> int:
    """Return a whole number from 0 as offbench writes it."""
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise ValueError(f"{text[:40]!r} is not a step, episode or length")
    return int(text)


def _short(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def find_runs(root: Path) -> list[Run]:
    """Return all runs below a folder in the order of their paths, those with an unreadable config.json included.

    Links are followed, and each folder is visited once. A folder that this user may not read counts as a run that
    cannot be read. The config.json files of other programs are ignored.
    """
    unreadable_folders: list[Path] = []

    def unreadable(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            unreadable_folders.append(Path(error.filename))

    visited, paths = set[str](), []
    for folder, subfolders, files in os.walk(root, onerror=unreadable, followlinks=True):
        if (real := os.path.realpath(folder)) in visited:
            subfolders.clear()  # a link to a folder that another path leads to
        elif "config.json" in files:
            paths.append(Path(folder) / "config.json")
        visited.add(real)
    paths.sort()
    return [*(Run(path.parent) for path in paths if _is_run(path)), *map(Run, unreadable_folders)]


def _is_run(path: Path) -> bool:
    try:
        config = read_json(path, DELETE_TO_REPEAT)
    except OffbenchError:
        return path.parent.name.startswith("seed-")
    return config.get("format") == FORMAT or path.parent.name.startswith("seed-")
