"""Algorithms by name: those of installed packages, by the entry-point group `offbench.algos`, and a user's own.

A user's own algorithm is a class or a file `./my_algo.py:ReBRAC`; `register` gives it the name of its class. Processes
started later find it by that name in $OFFBENCH_OWN_ALGORITHMS, if its module can be imported there.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import json
import operator
import os
import re
import sys
import traceback
import typing
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.common.errors import SHOW_TRACEBACK, OffbenchError, unknown
from offbench.common.files import is_exhausted
from offbench.common.settings import check_declarations, fields
from offbench.common.terminal import warn

if TYPE_CHECKING:
    from offbench.algorithm.interface import Algorithm

GROUP = "offbench.algos"
# {name: "module:class"} as JSON, for the processes that this one starts
USER_ALGORITHMS_VARIABLE = "OFFBENCH_OWN_ALGORITHMS"
_user_algorithms: dict[str, type[Algorithm]] = {}  # the user's own, registered in this process


# names of the arguments of `train` and of the keys of a grid's entry, which no setting may have
RESERVED_SETTINGS = {
    *("algorithm", "command", "dataset", "datasets", "device", "download", "env", "eval_episodes", "eval_every"),
    *("fresh", "help", "label", "name", "precision", "runs", "seeds", "stack", "steps", "tensorboard", "wandb"),
    "workers",
}
REQUIRED_SETTINGS = {"batch_size": int, "normalize": bool}  # settings that the training itself reads
TRAINING_SETTINGS = {**REQUIRED_SETTINGS, "top": float}  # and those that it reads if an algorithm has them


@functools.cache
def _entry_points() -> dict[str, list[importlib.metadata.EntryPoint]]:
    by_name: dict[str, list[importlib.metadata.EntryPoint]] = {}
    for package in importlib.metadata.distributions():
        try:
            points = package.entry_points.select(group=GROUP)
        except Exception as error:  # a package whose metadata is damaged must not stop the others
            where = getattr(package, "_path", package)  # its name may be unreadable too
            warn(f"{where} has unreadable entry points ({error}); reinstall or remove this package")
            continue
        for point in points:
            if point not in (same := by_name.setdefault(point.name, [])):
                same.append(point)
    return by_name


def algorithm_names() -> list[str]:
    """Return the names of all installed algorithms, ours and third parties'."""
    return sorted(_entry_points())


def algorithm_packages() -> set[str]:
    """Return the top-level packages and modules of all algorithms."""
    packages = {point.module.partition(".")[0] for points in _entry_points().values() for point in points}
    return packages | {cls.__module__.partition(".")[0] for cls in _user_algorithms.values()} - {"__main__"}


def load_algorithm(name: str) -> type[Algorithm]:
    """Return an algorithm's class by its name, that of a package or one that `register` has returned.

    A name may come from another person's run folder, so no file is imported here.

    Raises:
        OffbenchError: it is unknown, two packages have one of that name, it does not import, or has no valid Config.
    """
    if name in _user_algorithms:
        return _user_algorithms[name]
    points = _entry_points()
    if name not in points:
        own = json.loads(os.environ.get(USER_ALGORITHMS_VARIABLE, "{}"))
        if name not in own:
            raise unknown("algorithm", name, points)
        module, _, qualname = own[name].partition(":")
        try:
            cls = operator.attrgetter(qualname)(importlib.import_module(module))
        except (ImportError, AttributeError):  # a command of a script that registered it, in another folder
            raise unknown("algorithm", name, points) from None
        return _user_algorithms.setdefault(name, cls)
    point, *others = points[name]
    if others:
        raise OffbenchError(f"two algorithms are named {name!r}: {point.value} and {others[0].value}; rename yours")
    try:
        cls = point.load()
    except (Exception, SystemExit) as error:  # whatever its code raises
        if is_exhausted(error):
            raise
        why = f"{type(error).__name__}: {error}"
        raise OffbenchError(f"algorithm {name!r} ({point.value}) does not import: {why} ({SHOW_TRACEBACK})") from error
    return _check_algorithm(cls, f"algorithm {name!r} ({point.value})")


def register(algorithm: str | Path | type) -> str:
    """Make a user's own algorithm known by name; return the name for folders, tables and `load_algorithm`.

    Args:
        algorithm: a registered name, a file `./my_algo.py:ReBRAC` (the class may be left out if it is the only
            algorithm there), or a class.

    Raises:
        OffbenchError: no such file or class, no valid algorithm, or a name that another algorithm has.
    """
    if isinstance(algorithm, Path):
        algorithm = str(algorithm)
    if isinstance(algorithm, str) and not re.search(r"\.py(:|$)", algorithm):
        return algorithm
    cls = _from_file(algorithm) if isinstance(algorithm, str) else algorithm
    if not isinstance(cls, type):
        raise OffbenchError(f"an algorithm is a name, a file ./my_algo.py:ReBRAC or a class, not {cls!r:.60}")
    name, value = cls.__name__, f"{cls.__module__}:{cls.__qualname__}"
    for points in _entry_points().values():
        for point in points:
            if point.value == value:
                return point.name
    where = algorithm if isinstance(algorithm, str) else f"class {name}"
    if name in _entry_points():
        raise OffbenchError(f"{where}: an algorithm of a package is named {name!r} too; rename the class")
    other = _user_algorithms.get(name)
    if other is not None and f"{other.__module__}:{other.__qualname__}" != value:
        raise OffbenchError(
            f"two algorithms are named {name!r}, in {other.__module__} and {cls.__module__}; rename one"
        )
    _user_algorithms[name] = _check_algorithm(cls, where)
    if not only_in_this_process(name):
        os.environ[USER_ALGORITHMS_VARIABLE] = json.dumps(
            json.loads(os.environ.get(USER_ALGORITHMS_VARIABLE, "{}")) | {name: value}
        )
    return name


def user_algorithm(name: str) -> type[Algorithm] | None:
    """Return the class of a user's own algorithm, None for a package's."""
    return load_algorithm(name) if name not in _entry_points() else None


def only_in_this_process(name: str) -> bool:
    """Return whether an algorithm is a class that other processes cannot import: of a notebook, script or function."""
    cls = _user_algorithms.get(name)
    return cls is not None and (cls.__module__ == "__main__" or "<locals>" in cls.__qualname__)


def _from_file(reference: str) -> type[Algorithm]:
    """Return the class that `path/my_algo.py:ReBRAC` names, importing the file as the module `my_algo`."""
    from offbench.algorithm.interface import Algorithm

    text, _, name = reference.rpartition(":") if reference.rpartition(":")[0].endswith(".py") else (reference, "", "")
    if not os.path.isfile(os.path.expanduser(text)):  # unlike Path's, False for a name that no file can have
        raise OffbenchError(f"no algorithm file {text}")
    path = Path(os.path.expanduser(text)).resolve()
    if not path.stem.isidentifier():
        raise OffbenchError(f"{text}: rename the file to what Python can import, such as my_algorithm.py")
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # as Python does for a script, so that the file can import its neighbors
    try:
        module = importlib.import_module(path.stem)
    except (Exception, SystemExit) as error:  # whatever its code raises
        traceback.print_exception(error)
        raise OffbenchError(
            f"{text} does not import: {type(error).__name__}: {error}; see the traceback above"
        ) from None
    if Path(getattr(module, "__file__", None) or "").resolve() != path:
        raise OffbenchError(f"{text}: Python has another module {path.stem!r}; rename the file")
    classes = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Algorithm) and value.__module__ == module.__name__
    }
    if not name and len(classes) == 1:
        (name,) = classes
    if name not in classes:
        what = f"no algorithm {name!r}" if name else "several algorithms" if classes else "no algorithm"
        what += "" if classes else ", a subclass of offbench.algorithm.Algorithm"
        hint = f"; name one: {text}:{' or :'.join(classes)}" if classes else ""
        raise OffbenchError(f"{text} has {what}{hint}")
    config = vars(module).get("Config")
    if isinstance(config, type) and config.__module__ == module.__name__:
        used = any(issubclass(getattr(cls, "Config", object), config) for cls in classes.values())
        bases = ", ".join(base.__name__ for base in classes[name].__bases__)
        if not used:
            raise OffbenchError(
                f"{text}: {name} does not use the file's Config; write class {name}({bases}, Algorithm[Config]), or "
                "rename that Config"
            )
    return classes[name]


def _check_algorithm(cls: type, what: str) -> type[Algorithm]:
    """Return `cls` if it is an Algorithm with a valid Config, else raise an OffbenchError that begins with `what`."""
    from offbench.algorithm.interface import Algorithm  # imports PyTorch, which listing the names does not need

    if not (isinstance(cls, type) and issubclass(cls, Algorithm)):
        raise OffbenchError(f"{what} must be a subclass of offbench.algorithm.Algorithm; see docs/extending.md")
    config = getattr(cls, "Config", None)
    if not (isinstance(config, type) and dataclasses.is_dataclass(config)):
        raise OffbenchError(f"{what}: Config must be a dataclass of settings")
    for needed in REQUIRED_SETTINGS:
        if needed not in {field.name for field in dataclasses.fields(config)}:
            raise OffbenchError(f"{what}: its Config lacks the setting {needed}")
    for field in dataclasses.fields(config):
        if field.name in RESERVED_SETTINGS:
            raise OffbenchError(f"{what}: the setting {field.name} has the name of an option of training; rename it")
        if field.init and field.default is dataclasses.MISSING:
            raise OffbenchError(f"{what}: the setting {field.name} needs a default (default=, not default_factory=)")
    check_declarations(config, what)
    hints, declared = typing.get_type_hints(config), fields(config)
    for name, kind in TRAINING_SETTINGS.items():
        required = name in REQUIRED_SETTINGS
        if name in declared and (hints[name] is not kind or (required and declared[name].metadata.get("per_run"))):
            also = ", and not per_run" if required else ""
            raise OffbenchError(f"{what}: the setting {name} must be declared as {kind.__name__}{also}")
    if config.__hash__ is None:
        raise OffbenchError(f"{what}: Config must be frozen: @dataclass(frozen=True)")
    return cls
