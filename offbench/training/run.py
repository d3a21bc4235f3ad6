"""Run directories: plain files that a person can read, and that `normalize` and `report` need nothing beside.

runs/<dataset>/<algorithm>/<variant>/seed-<n>/
    config.json           settings, dataset and its references, seed, versions, hardware, command; `sessions`: what
                          trained it later, where that was something else
    evaluations.csv       step, episode, return, length: every evaluation episode
    losses.csv            step and the mean of each logged quantity since the row before
    policy.safetensors    the policy at the last checkpoint
    checkpoint-*.safetensors   the newest two; the same command goes on from there
    diverged.json         only where a run became NaN or infinite: at which step, in which tensor
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from offbench.common.errors import OffbenchError
from offbench.common.files import (
    csv_bytes,
    damage,
    read_json,
    regular,
    remove_leftovers,
    sha256,
    sole,
    write_bytes,
    write_json,
)
from offbench.training.registry import current_settings

EVALUATION_COLUMNS = ("step", "episode", "return", "length")
FORMAT = "offbench-run-1"
LONGEST = 255  # bytes of a file's name, on the usual file systems
DIGITS = 8  # of a content hash, where a table must tell two contents of one dataset id apart
REQUIRED = {  # what a config.json must hold, and of which kind
    **dict.fromkeys(("algorithm", "variant", "dataset", "dataset_sha256"), str),
    **dict.fromkeys(("seed", "steps"), int),
    **dict.fromkeys(("settings", "references"), dict),
}
LARGEST = 1e15  # what no step, return or reference reaches: scores and their squares stay finite
SMALLEST_GAP = 1e-12  # between the references of a score
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
        """Hold the directory for this process, rid of leftovers. Raises OffbenchError if another one trains it."""
        with sole(self.folder / ".lock", f"{self.folder} is being trained"):
            remove_leftovers(self.folder)
            yield

    def config(self) -> dict[str, Any]:
        """Read config.json. Raises OffbenchError if it is missing or damaged."""
        if not self.config_path.exists():
            raise OffbenchError(
                f"no run in {self.folder} (no config.json); a run is RUNS/DATASET/ALGORITHM/VARIANT/seed-N"
            )
        config = read_json(self.config_path)
        for key, kind in REQUIRED.items():
            if not isinstance(config, dict) or not _is(config.get(key), kind):
                raise OffbenchError(
                    f"{self.config_path} is damaged: it lacks {key}, or has an odd one; delete the run to repeat it"
                )
        parts = config.get("sessions", [])
        if not (isinstance(parts, list) and all(isinstance(part, dict) for part in parts)):
            raise OffbenchError(f"{self.config_path} is damaged: odd sessions; delete the run to repeat it")
        config["references"] = {name: config["references"].get(name) for name in ("dataset", "d4rl")}
        for pair in config["references"].values():
            sound = isinstance(pair, list) and len(pair) == 2 and all(_is(value, float) for value in pair)
            if pair is not None and not (sound and pair[1] - pair[0] >= SMALLEST_GAP):
                raise OffbenchError(f"{self.config_path} is damaged: odd references; delete the run to repeat it")
        return dict(config)

    def claim(self, config: Mapping[str, Any]) -> None:
        """Write config.json, or check that the run in this directory is the same one.

        Raises:
            OffbenchError: another run lives here, or one whose config.json is gone.
        """
        if self.config_path.exists():
            known = self.config()
            for key in MUST_MATCH:
                before = known.get(key)
                if key == "settings":
                    before = current_settings(known["algorithm"], known["settings"], str(self.folder))
                if before == config[key]:
                    continue
                if key == "dataset_sha256":
                    raise OffbenchError(
                        f"{self.folder} was trained on another content of {config['dataset']}, which has been "
                        "recorded again since; delete that run or give another --runs"
                    )
                raise OffbenchError(
                    f"{self.folder} holds a run with {key} {before!r}, not {config[key]!r}; "
                    "delete it or give another --runs"
                )
        elif any(self.folder.glob("checkpoint-*.safetensors")):
            raise OffbenchError(f"{self.folder} holds a run without its config.json; put it back, or delete the run")
        else:
            with self.locked():
                if not self.config_path.exists():
                    write_json(self.config_path, config)
                    return
            self.claim(config)  # another process was faster

    def begin(self, step: int, steps: int, made: Mapping[str, Any]) -> None:
        """Note in config.json that the run is trained from `step` to `steps`, and with what, if that has changed.

        Args:
            made: device, versions and so on (offbench.common.provenance.made_with).
        """
        config = self.config()
        changed = dict(config, steps=max(steps, config["steps"]))
        if {key: sessions(config)[-1].get(key) for key in made} != made:
            changed["sessions"] = [*config.get("sessions", []), {"step": step, **made}]
        if changed != config:
            write_json(self.config_path, changed)

    def mark_diverged(self, step: int, tensor: str) -> None:
        """Note that the run cannot go on: `tensor` held NaN or infinity at `step`."""
        write_json(self.folder / "diverged.json", {"step": step, "tensor": tensor})

    @property
    def diverged(self) -> bool:
        """Whether the run is marked so; it is not trained on until that file is deleted."""
        return (self.folder / "diverged.json").exists()

    def evaluations(self) -> dict[int, list[tuple[float, int]]]:
        """Return {step: [(return, length) of each episode]} in order of steps; {} if there are none yet.

        Raises:
            OffbenchError: the file is damaged: a row is odd, an episode is missing or there twice, or the steps are
                not those of config.json.
        """
        if not self.evaluations_path.exists():
            return {}
        config = self.config() if self.config_path.exists() else {}
        last, episodes = config.get("steps", LARGEST), config.get("eval_episodes")
        found: dict[int, list[tuple[float, int]]] = {}
        with damage(f"{self.evaluations_path} is damaged", "delete the run to repeat it"):
            with open(self.evaluations_path, newline="", encoding="utf-8", opener=regular) as file:
                reader = csv.DictReader(file, strict=True)
                if tuple(reader.fieldnames or ()) != EVALUATION_COLUMNS:
                    raise ValueError(f"its columns are {reader.fieldnames}")
                for row in reader:
                    if None in row or None in row.values():
                        raise ValueError(f"line {reader.line_num} has not {len(EVALUATION_COLUMNS)} cells")
                    value, step = float(row["return"]), _count(row["step"])
                    if not abs(value) < LARGEST:
                        raise ValueError(f"a return is {value}")
                    if step > last:
                        raise ValueError(f"step {step} of a run of {last} steps")
                    rows = found.setdefault(step, [])
                    if _count(row["episode"]) != len(rows):
                        raise ValueError(f"episode {len(rows)} of step {step} is missing, or one is there twice")
                    rows.append((value, _count(row["length"])))
            for step, rows in found.items():
                if len(rows) != (episodes or len(rows)):
                    raise ValueError(f"step {step} has {len(rows)} episodes, not {episodes}")
        return dict(sorted(found.items()))

    def write_evaluations(self, evaluations: Mapping[int, list[tuple[float, int]]]) -> None:
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
        lines = ([_short(row.get(key, "")) for key in columns] for row in rows)
        write_bytes(self.losses_path, csv_bytes(columns, lines))

    def losses(self) -> list[dict[str, float]]:
        """Read losses.csv ([] if there is none)."""
        path = self.losses_path
        if not path.exists():
            return []
        with (
            damage(f"{path} is damaged", "delete the run to repeat it"),
            open(path, newline="", encoding="utf-8", opener=regular) as file,
        ):
            return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file, strict=True)]


def _count(text: str) -> int:
    """Return a whole number from 0 as offbench writes it."""
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise ValueError(f"{text[:40]!r} is no step, episode or length")
    return int(text)


def _is(value: Any, kind: type) -> bool:
    """Return whether a JSON value is of a kind; numbers must be finite, and true is no number."""
    if kind in (int, float):
        kinds = int if kind is int else int | float
        return isinstance(value, kinds) and not isinstance(value, bool) and abs(value) < LARGEST
    return isinstance(value, kind)


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def sessions(config: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return what has trained a run, one after the other: each has device, versions, hardware and so on."""
    return [config, *config.get("sessions", [])]


def find_runs(root: Path) -> list[Run]:
    """Return all runs below a folder, in order of their paths; other programs' config.json are passed over.

    A run whose config.json cannot be read is among them.
    """
    return [Run(path.parent) for path in sorted(root.rglob("config.json")) if _is_run(path)]


def _is_run(path: Path) -> bool:
    try:
        config = read_json(path)
    except OffbenchError:
        return path.parent.name.startswith("seed-")
    return isinstance(config, dict) and config.get("format") == FORMAT


def run_folder(root: Path, dataset_id: str, algorithm: str, variant: str, seed: int) -> Path:
    """Return runs/<dataset>/<algorithm>/<variant>/seed-<n>; a long variant is cut short and ends in its hash."""
    return root / dataset_id / algorithm / folder_name(variant) / f"seed-{seed}"


def folder_name(variant: str) -> str:
    """Return the name of a variant's folder: the variant itself, if a file system takes a name that long."""
    if len(variant.encode()) <= LONGEST:
        return variant
    ending = f"...{sha256(variant.encode())[:16]}"
    return variant.encode()[: LONGEST - len(ending)].decode(errors="ignore") + ending


def variant(config: Any, precision: str = "float32") -> str:
    """Name a config by the settings that differ from their defaults: `default` or `alpha=1,beta=0.5`.

    A precision other than float32 is the last of them: `beta=0.5,precision=bfloat16`.
    """
    parts = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            parts.append(f"{field.name}={_word(value)}")
    if precision != "float32":
        parts.append(f"precision={precision}")
    return ",".join(parts) or "default"


def _word(value: Any) -> str:
    if isinstance(value, tuple):
        return "x".join(str(item) for item in value)
    if isinstance(value, float):
        return short if float(short := f"{value:g}") == value else repr(value)
    return quote(value, safe="") if isinstance(value, str) else str(value).lower()


def settings_dict(config: Any) -> dict[str, Any]:
    """Return a config as JSON has it (tuples become lists)."""
    values: Iterable[tuple[str, Any]] = dataclasses.asdict(config).items()
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values}
