"""Minari datasets on disk: their ids, metadata and locks."""

from __future__ import annotations

import contextlib
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from offbench.common.errors import DamagedError, OffbenchError, nearest, unknown
from offbench.common.files import (
    LOCK_TIMEOUT,
    JsonObject,
    delete,
    exclusive_lock,
    home_folder,
    read_errors,
    read_json,
    write_errors,
)
from offbench.common.scores import are_references
from offbench.common.settings import read_back, setting
from offbench.data.levels import parse_level, recipe_and_level
from offbench.envs.margin_rule import MAX_RULE, SUM_RULE
from offbench.envs.recipes import load_recipe

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from minari.dataset.minari_dataset import parse_dataset_id


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What offbench recorded about a dataset; empty for datasets of other programs.

    Attributes:
        env: the recipe's name.
        level: the level as the user gave it, or the name of a policy of the user's own.
        seed: seed of the episodes.
        parts: definition and measured return of each part, as in offbench.data.levels.
        full_size: transitions at the recipe's size.
        references: the episodes behind `ref_min_score` (`random`) and `ref_max_score` (`expert`).
        d4rl: D4RL's reference scores.
        contact_margin: the rule for contact margins, as in offbench.envs.margin_rule.
        env_code: hashes of the environment's code and files, if it is not Gymnasium's.
        versions: of the packages that recorded it.
        content_sha256: hash of all episodes, as in offbench.data.content_hash.
        imported: the D4RL file that the dataset was imported from.
        timeouts: for an import, whether the steps at a timeout are `kept` or `dropped`.
        final_observations: for an import, whether the last observations of terminated episodes are `kept`, or the
            ones before `repeated`.
    """

    env: str | None = None
    level: str | None = None
    seed: int | None = None
    recipe_sha256: str | None = None
    parts: tuple[JsonObject, ...] | None = None
    full_size: int | None = None
    references: JsonObject = field(default_factory=dict)
    d4rl: tuple[float, float] | None = None
    contact_margin: str | None = setting(None, "", choices=(MAX_RULE, SUM_RULE))
    env_code: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    content_sha256: str | None = None
    imported: JsonObject = field(default_factory=dict)
    timeouts: str | None = None
    final_observations: str | None = None


KEY = "offbench"  # key in the metadata for everything that Minari has no field for


def root() -> Path:
    """Return Minari's folder: $MINARI_DATASETS_PATH, else ~/.minari/datasets."""
    path = os.environ.get("MINARI_DATASETS_PATH")
    return Path(path) if path else home_folder("MINARI_DATASETS_PATH") / ".minari" / "datasets"


def check_id(dataset_id: str) -> str:
    """Return `dataset_id` if Minari can parse it: `name-v0` or `namespace/name-v0`."""
    try:
        parse_dataset_id(dataset_id)
        if Path(dataset_id).as_posix() != dataset_id:
            raise ValueError("it has an empty part")
    except (ValueError, TypeError):
        raise OffbenchError(
            f"{dataset_id!r} is not a dataset id: use letters, digits, - and _, and end with a version such as -v0; a "
            "namespace may precede it, as in mine/name-v0"
        ) from None
    return dataset_id


def check_type(dataset_id: object) -> None:
    """Raise OffbenchError if a user of the Python interface gives something other than the text of an id."""
    if not isinstance(dataset_id, str):
        raise OffbenchError(
            "a dataset is named by its id, such as 'hopper-medium-v0' (`dataset.spec.dataset_id` in Minari), not by a "
            f"{type(dataset_id).__name__}"
        )


def path_of(dataset_id: str) -> Path:
    """Return the folder of a dataset id, whether it exists or not."""
    return root() / check_id(dataset_id)


def local_ids(unreadable: Callable[[OSError], None] | None = None) -> list[str]:
    """Return the ids of all local datasets; hidden folders, and folders without a dataset, are left out.

    Args:
        unreadable: is called with the error of each folder that cannot be read.
    """
    base, ids, seen = root(), list[str](), set[str]()
    for folder, folders, _ in os.walk(base, onerror=unreadable, followlinks=True):
        if os.path.isfile(os.path.join(folder, "data", "metadata.json")):
            ids.append(Path(folder).relative_to(base).as_posix())
            folders.clear()
        if (real := os.path.realpath(folder)) in seen:  # links can make a circle
            folders.clear()
        seen.add(real)
        replaced = {match[1] for name in folders if (match := REPLACED.fullmatch(name))} - set(folders)
        folders[:] = [name for name in folders if not name.startswith(".")]
        folders += [name for name in replaced if _restore_replaced(Path(folder, name))]
    return sorted(ids)


def _not_found_error(dataset_id: str) -> OffbenchError:
    """Return the error for a missing dataset: how to record it, or which local id is the most similar."""
    if os.path.isfile(dataset_id):  # unlike Path.is_file, False for a name that no file can have
        what = "a file, not a dataset's id; `offbench import-d4rl` converts D4RL's HDF5 files"
        return OffbenchError(f"{dataset_id} is {what}")
    path = root() / dataset_id
    if _inside(dataset_id) and os.path.lexists(old := hidden_path(path, "old")):
        why = "its replacement was interrupted, and it could not be put back"
        return OffbenchError(f"{dataset_id} is not there: {why}; rename {old} to {path}")
    if os.path.isfile(os.path.join(dataset_id, "data", "metadata.json")):
        path = Path(dataset_id).absolute()
        what = f"a folder, not a dataset's id; set MINARI_DATASETS_PATH={path.parent} and give {path.name}"
        return OffbenchError(f"{dataset_id} is {what}")
    env, level = recipe_and_level(dataset_id)
    with contextlib.suppress(OffbenchError):  # no level
        name = f"{env}-{parse_level(level)[0]}-v{load_recipe(env).version}"
        command = f"`offbench collect {env} --level {level}`"
        if name == dataset_id:
            return OffbenchError(f"{dataset_id} is not recorded yet: {command}")
        if not exists(name):
            return OffbenchError(f"unknown dataset {dataset_id!r}: {command} records {name}")
    with contextlib.suppress(OffbenchError):  # no id
        if "/" in check_id(dataset_id):
            return _not_downloaded_error(dataset_id)
    text = str(unknown("dataset", dataset_id, local_ids()))
    return OffbenchError(
        f"{text}{' Or' if text.endswith('?') else ';'} record one: `offbench collect ENV --level LEVEL`"
    )


def _not_downloaded_error(dataset_id: str) -> OffbenchError:
    """Return the error for an id with a namespace, as Minari's server has them (`mujoco/hopper/medium-v0`)."""
    near = nearest(dataset_id, (name for name in local_ids() if "/" in name))
    hint = f"did you mean {near!r}? Or download it" if near else "download it"
    return OffbenchError(
        f"no local dataset {dataset_id!r}: {hint} with `minari download {dataset_id}`, or `train --download`"
    )


def read_metadata(dataset_id: str) -> JsonObject:
    """Return a local dataset's metadata as Minari wrote it.

    Raises:
        OffbenchError: no such dataset (the nearest id is named), or its metadata is damaged.
    """
    if not exists(dataset_id):
        raise _not_found_error(dataset_id)
    path = root() / dataset_id / "data" / "metadata.json"
    remedy = "record or download the dataset again"
    metadata = read_json(path, remedy)
    check_metadata(metadata, path, remedy)
    return metadata


def check_metadata(metadata: JsonObject, where: str | Path, remedy: str) -> None:
    """Raise DamagedError if a field that offbench reads has the wrong type; each may be missing."""
    try:
        _check_fields(metadata)
    except (ValueError, TypeError, RecursionError) as error:
        raise DamagedError(f"{where} is damaged: {error}; {remedy}") from None
    if metadata.get(KEY) is not None:
        read_back(Provenance, metadata[KEY], where, remedy)


TEXTS = ("env_spec", "eval_env_spec", "observation_space", "action_space", "algorithm_name", "description")
NUMBERS = ("ref_min_score", "ref_max_score", "total_steps", "total_episodes")


def _check_fields(metadata: JsonObject) -> None:
    """Raise ValueError if one of Minari's fields has the wrong type, or holds text that is not valid UTF-8."""
    json.dumps(metadata, ensure_ascii=False, default=list).encode()
    for key in (*TEXTS, *NUMBERS):
        value = metadata.get(key)
        number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15
        if value is not None and not (isinstance(value, str) if key in TEXTS else number):
            raise ValueError(f"{key} is {str(value)[:40]!r}")
    for key in ("env_spec", "eval_env_spec"):
        spec = json.loads(text) if (text := metadata.get(key)) else {"id": ""}
        if not (isinstance(spec, dict) and isinstance(spec.get("id"), str)):
            raise ValueError(f"{key} names no environment")


def exists(dataset_id: str) -> bool:
    """Return whether there is a local dataset of this id, damaged or not; restore it if its replacement was killed.

    Raises:
        OffbenchError: that is unknown.
    """
    check_type(dataset_id)
    path = root() / dataset_id / "data" / "metadata.json"
    with read_errors(str(path), "cannot be looked up", "check the id and the disk"):
        return _inside(dataset_id) and (path.exists() or (_restore_replaced(root() / dataset_id) and path.exists()))


def _inside(dataset_id: str) -> bool:
    """Return whether an id names a folder below the root."""
    parts = Path(dataset_id).parts
    return bool(parts) and ".." not in parts and "\0" not in dataset_id and not dataset_id.startswith((".", "/"))


def read_provenance(metadata: JsonObject) -> Provenance:
    """Return what offbench recorded about a dataset."""
    return read_back(Provenance, metadata.get(KEY) or {}, "the metadata", "record or download the dataset again")


def references(metadata: JsonObject) -> tuple[float, float] | None:
    """Return a dataset's own reference returns (random, expert); None if it has none to normalize by."""
    low, high = metadata.get("ref_min_score"), metadata.get("ref_max_score")
    return (float(low), float(high)) if low is not None and high is not None and are_references(low, high) else None


def check_content(dataset_id: str, metadata: JsonObject, content: str) -> None:
    """Raise OffbenchError if a dataset's content hash is not the one that its metadata record, where they do."""
    if read_provenance(metadata).content_sha256 not in (None, content):
        raise OffbenchError(
            f"{dataset_id} is damaged: its arrays are not those of the content_sha256 in its metadata; "
            "record it again with --overwrite, or download it again"
        )


def hidden_path(path: Path, ending: str) -> Path:
    """Return a hidden path by a dataset: its `lock`, `partial` while it is written, `old` while it is replaced."""
    return path.with_name(f".offbench-{path.name}.{ending}")


REPLACED = re.compile(r"\.offbench-([^.].*)\.old")  # matches the "old" paths of `hidden_path`


def _restore_replaced(path: Path) -> bool:
    """Restore a dataset whose writer was killed between the two renames of `write`; return whether it exists."""
    if os.path.lexists(hidden_path(path, "old")):
        _tidy(path, LOCK_TIMEOUT)
    return path.exists()


@contextlib.contextmanager
def claimed(dataset_id: str, overwrite: bool) -> Iterator[Path]:
    """Lock a dataset id for writing; yields its folder.

    Raises:
        OffbenchError: the id is taken (and `overwrite` is not set), another process is recording it, or the
            folder cannot be written.
    """
    path = path_of(dataset_id)
    if not path.parent.resolve().is_relative_to(root().resolve()):
        raise OffbenchError(f"{dataset_id} leads out of {root()} by a link; choose another id")
    _check_nesting(dataset_id, path)
    with exclusive_lock(hidden_path(path, "lock"), f"{dataset_id} is being recorded"):
        recover(path)
        if path.exists() and not overwrite:
            message = f"{dataset_id} exists already{_size(dataset_id)}"
            raise OffbenchError(f"{message}; use --overwrite to replace it, or --id for another id")
        yield path


def _check_nesting(dataset_id: str, path: Path) -> None:
    """Raise OffbenchError if an id is inside the folder of another dataset, or other datasets are inside its own."""
    metadata = Path("data", "metadata.json")
    above = [folder for folder in path.parents if folder.is_relative_to(root()) and (folder / metadata).is_file()]
    below = [file.parents[1] for file in path.rglob(str(metadata)) if file != path / metadata]
    if others := [*above, *below]:
        raise OffbenchError(
            f"{dataset_id} would share a folder with {others[0].relative_to(root())}; choose another id"
        )


def _size(dataset_id: str) -> str:
    """Return a dataset's transitions in brackets, "" if its metadata does not say."""
    try:
        return f" ({read_metadata(dataset_id)['total_steps']:,} transitions)"
    except (OffbenchError, KeyError, TypeError):
        return ""


def tidy(dataset_id: str) -> None:
    """Delete a killed process's leftovers of a dataset, unless it is being written or the folder is read-only."""
    _tidy(path_of(dataset_id), 0)


def _tidy(path: Path, timeout: float) -> None:
    with (
        contextlib.suppress(OffbenchError),
        exclusive_lock(hidden_path(path, "lock"), path.name, timeout),
    ):
        recover(path)


def recover(path: Path) -> None:
    """Restore a replaced dataset if the new one is incomplete, else delete it; delete incomplete files."""
    old, partial = hidden_path(path, "old"), hidden_path(path, "partial")
    with write_errors(str(partial)):
        delete(partial)
    with write_errors(str(old)):
        if not path.exists() and not old.is_symlink() and (old / "data" / "metadata.json").is_file():
            old.replace(path)
        elif os.path.lexists(old):
            old.replace(partial)  # so that a killed process leaves no half of it to restore
            delete(partial)
