"""`train --download`: datasets of Minari's server, whole or not at all."""

from __future__ import annotations

import contextlib
import shutil
import sys
from pathlib import Path

from offbench.common.errors import LockedError, OffbenchError
from offbench.common.files import exclusive_lock, write_errors
from offbench.common.processes import environment
from offbench.common.terminal import inform
from offbench.common.text import printable
from offbench.data import minari_store

MAX_WAIT = 3600.0  # seconds to wait for the download of another process


def download(dataset_id: str) -> None:
    """Download a dataset with Minari, and those that it is combined from, unless it is here already.

    Minari's `download_dataset` writes to a hidden folder, and the complete dataset is then renamed.

    Raises:
        OffbenchError: not an id, no such dataset on the server, no connection, or Minari's client is not installed.
    """
    if minari_store.exists(dataset_id):
        return
    target = minari_store.path_of(dataset_id)
    root = minari_store.root()
    with contextlib.ExitStack() as held:
        lock, what = root / ".offbench-download.lock", "another dataset is being downloaded"
        try:
            held.enter_context(exclusive_lock(lock, what))
        except LockedError as error:
            inform(error.waiting)
            held.enter_context(exclusive_lock(lock, what, MAX_WAIT))
        if minari_store.exists(dataset_id):  # another process was faster
            return
        temporary = root / ".offbench-download"
        shutil.rmtree(temporary, ignore_errors=True)  # left by a download that was killed
        try:
            with environment({"MINARI_DATASETS_PATH": str(temporary)}):
                _fetch(dataset_id)
            with write_errors(str(root)):
                _move(temporary, root)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    if not target.exists():
        raise OffbenchError(f"Minari's server sent no dataset {dataset_id}")


def _fetch(dataset_id: str) -> None:
    import minari

    try:
        with contextlib.redirect_stdout(sys.stderr):  # stdout is for the runs' folders
            minari.download_dataset(dataset_id)
    except ImportError as error:
        raise OffbenchError(f"cannot download {dataset_id}: {error}") from None
    except Exception as error:  # Minari, its clients and the network raise many types
        reason = " ".join(printable(str(error) or type(error).__name__).split())
        remedy = "check the id (`minari list remote`) and the connection"
        raise OffbenchError(f"cannot download {dataset_id}: {reason}; {remedy}") from error


def _move(temporary: Path, root: Path) -> None:
    """Move datasets and the descriptions of their namespaces to Minari's folder; nothing there is replaced."""
    datasets = [path.parent.parent for path in temporary.glob("**/data/metadata.json")]
    for path in [*temporary.glob("**/namespace_metadata.json"), *datasets]:
        inside = path.relative_to(temporary)
        if not any(part.startswith(".") for part in inside.parts) and not (root / inside).exists():
            (root / inside).parent.mkdir(parents=True, exist_ok=True)
            path.replace(root / inside)
