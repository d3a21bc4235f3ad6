"""`doctor`: what a bug report needs to know about a machine, and whether something on it is broken.

Each finding is `ok`, `note` (worth knowing, nothing is broken) or `broken` with what to do about it.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.common.errors import OffbenchError
from offbench.common.files import read_json
from offbench.common.processes import cores
from offbench.common.provenance import hardware, versions

if TYPE_CHECKING:  # each check imports what it needs, which may be broken
    from offbench.common.arrays import Array
    from offbench.rollouts.rollouts import Episode

OK, NOTE, BROKEN = "ok", "note", "broken"
REPLAYED = 64  # transitions of the physics check
TOLERANCE = 1e-6  # largest accepted error; other contact margins give 0.2 or more
ROOM = 1e9  # bytes; a level of a million transitions takes 0.2 to 0.5 GB
EXTRAS = {  # module: what it is for
    "ray": "offbench benchmark --executor ray",
    "tensorboard": "offbench train --tensorboard",
    "wandb": "offbench train --wandb",
    "imageio_ffmpeg": "offbench video to .mp4",
    "onnx": "offbench export-policy to .onnx",
    "huggingface_hub": "offbench train --download",
}


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        state: `ok`, `note` or `broken`.
    """

    name: str
    state: str
    text: str


def doctor() -> list[Finding]:
    """Look at this installation and machine; nothing is changed and nothing raises."""
    checks: dict[str, Callable[[], Iterator[tuple[str, str]]]] = {
        "versions": _versions,
        "machine": _machine,
        "gpu": _gpu,
        "physics": _physics,
        "algorithms": _algorithms,
        "datasets": _datasets,
        "cache": _cache,
        "runs": lambda: _writable(Path.cwd(), ""),
        "renderer": _renderer,
        "extras": _extras,
    }
    return [Finding(name, state, text) for name, check in checks.items() for state, text in _safely(check)]


def _safely(check: Callable[[], Iterator[tuple[str, str]]]) -> list[tuple[str, str]]:
    try:
        return list(check())
    except Exception as error:  # doctor must not fail on a broken machine
        return [(BROKEN, f"{type(error).__name__}: {' '.join(str(error).split())}")]


def _versions() -> Iterator[tuple[str, str]]:
    packages = versions() | {"h5py": _version("h5py")}
    missing = [name for name, version in packages.items() if version == "not installed"]
    yield BROKEN if missing else OK, ", ".join(f"{name} {version}" for name, version in packages.items())


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _machine() -> Iterator[tuple[str, str]]:
    machine = hardware()
    processor = f"{machine['processor']} ({machine['vectors']})"
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9 if hasattr(os, "sysconf") else 0
    yield OK, f"{platform.platform()}, {processor}, {cores()} of {os.cpu_count()} cores, {memory:.0f} GB memory"


def _gpu() -> Iterator[tuple[str, str]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a driver that is too old: the result says so
        import torch

        if torch.cuda.is_available():
            for i in range(torch.cuda.device_count()):
                device = torch.cuda.get_device_properties(i)
                yield OK, f"cuda:{i} {device.name}, {device.total_memory / 1e9:.0f} GB"
            return
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for the CPU alone"
    yield NOTE, f"none seen by PyTorch, which is {built}; trainings run on the CPU"


def _physics() -> Iterator[tuple[str, str]]:
    error = replay_error(REPLAYED)
    text = f"{REPLAYED} shipped Hopper transitions replayed, largest error {error:.0e} (at most {TOLERANCE:.0e})"
    if error <= TOLERANCE:
        yield OK, text
    else:
        yield BROKEN, f"{text}: the physics are not those of the shipped data; reinstall mujoco and gymnasium"


def replay_error(count: int) -> float:
    """Return the largest error of observations when shipped Hopper transitions are stepped once more.

    Hopper's observation is its state without the position along the track, which the motion does not depend on.
    Velocities are clipped at 10: such transitions are skipped.

    Raises:
        OffbenchError: the shipped data are missing or damaged.
    """
    import numpy as np

    from offbench.agents.medium_replay import load_replay
    from offbench.envs.environments import make_env, spaces_of
    from offbench.envs.recipes import load_recipe

    recipe = load_recipe("hopper")
    env, folder = make_env(recipe.env_spec()).unwrapped, recipe.folder
    assert folder is not None
    ladder = folder / "behaviour"
    digest = read_json(ladder / "ladder.json")["medium_replay"]["sha256"]
    observations, actions = spaces_of(env, "hopper")
    episodes = load_replay(ladder / "medium-replay.hdf5", digest, observations, actions.low, actions.high)
    env.reset(seed=0)
    errors: list[float] = []
    for before, action, after in _sample_transitions(episodes, count):
        env.set_state(np.concatenate([[0.0], before[:5]]), before[5:])  # type: ignore[attr-defined]
        errors.append(float(np.abs(env.step(action)[0] - after).max()))
    env.close()
    return max(errors)


def _sample_transitions(episodes: Iterator[Episode], count: int) -> Iterator[tuple[Array, Array, Array]]:
    """Yield (observation, action, next observation), one from the middle of every eighth episode."""
    import numpy as np

    yielded = 0
    for number, episode in enumerate(episodes):
        step = len(episode) // 2
        if number % 8 or np.abs(episode.observations[step, 5:]).max() >= 10:
            continue
        yield episode.observations[step], episode.actions[step], episode.observations[step + 1]
        yielded += 1
        if yielded == count:
            return
    raise OffbenchError(f"the shipped data hold {yielded} of {count} transitions")


def _algorithms() -> Iterator[tuple[str, str]]:
    from offbench.training.registry import algorithm_names, load_algorithm

    names, loaded = algorithm_names(), []
    for name in names:
        try:
            load_algorithm(name)
            loaded.append(name)
        except OffbenchError as error:
            yield BROKEN, str(error)
    if loaded:
        yield OK, ", ".join(loaded)
    elif not names:
        yield BROKEN, "none is registered; install the package: pip install ."


def _datasets() -> Iterator[tuple[str, str]]:
    from offbench.data import minari_store

    return _writable(minari_store.root(), "MINARI_DATASETS_PATH")


def _cache() -> Iterator[tuple[str, str]]:
    from offbench.data import transitions

    return _writable(transitions.cache(), "OFFBENCH_CACHE")


def _writable(folder: Path, variable: str) -> Iterator[tuple[str, str]]:
    """Try to write where `folder` is, or will be."""
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    remedy = f"; set {variable} to another folder" if variable else "; go to another folder"
    try:
        with tempfile.NamedTemporaryFile(dir=there) as file:
            file.write(b"offbench")
            file.flush()
    except OSError as error:
        yield BROKEN, f"{folder} cannot be written: {error.strerror}{remedy}"
        return
    free = shutil.disk_usage(there).free
    state, hint = (OK, "") if free >= ROOM else (NOTE, f", little{remedy}")
    yield state, f"{folder}, {free / 1e9:.1f} GB free{hint}"


def _renderer() -> Iterator[tuple[str, str]]:
    from offbench.evaluation.renderer import NO_RENDERER, working_backend

    backend = working_backend()
    yield (OK, f"MUJOCO_GL={backend} draws off-screen") if backend else (NOTE, NO_RENDERER)


def _extras() -> Iterator[tuple[str, str]]:
    for module, purpose in EXTRAS.items():
        version = _version(module)
        if version == "not installed":
            yield NOTE, f"{module} is {version} ({purpose})"
        else:
            yield OK, f"{module} {version}"
