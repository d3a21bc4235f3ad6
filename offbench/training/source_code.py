"""The code of an algorithm, as config.json identifies it: a hash of each file that it is made of.

A hash leaves out comments, docstrings and blank lines, which do not affect training. The files are:

    algorithm of offbench             its file
    algorithm of a package            all files of the package, and the installed version
    algorithm in a user's own file    the file, and the files in its folder that it imports
    class made by a function          also the values that its methods read of that function
    class of a script or notebook     the class, its Config, its bases, and what they use (see script_code.py)
"""

from __future__ import annotations

import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.common.code_hash import file_hash, imported_files, module_code, package_versions
from offbench.training.registry import load_algorithm, user_algorithm
from offbench.training.script_code import closure_code, script_code

if TYPE_CHECKING:
    from offbench.algorithm.interface import Algorithm

_codes: dict[type, dict[str, str]] = {}  # of classes as imported: their files may have changed since


def code_of(algorithm: str) -> dict[str, str]:
    """Return {file: hash} of an algorithm's code, and {"version of PACKAGE": version} of a package's."""
    algorithm_class = load_algorithm(algorithm)
    if algorithm_class.__module__ == "__main__":  # what it uses may have been changed since
        return _code_of(algorithm_class)
    if algorithm_class not in _codes:
        _codes[algorithm_class] = _code_of(algorithm_class)
    return _codes[algorithm_class]


def _code_of(algorithm_class: type[Algorithm]) -> dict[str, str]:
    hashes: dict[str, str] = {}
    for cls in _classes(algorithm_class):
        module = sys.modules.get(cls.__module__)
        file = Path(getattr(module, "__file__", None) or "")
        package = cls.__module__.partition(".")[0]
        if cls.__module__ == "__main__" or not file.is_file():
            hashes |= script_code([cls, algorithm_class.Config])
        elif package == "offbench":
            hashes[file.name] = file_hash(file)
        else:
            hashes |= module_code(cls.__module__) | closure_code(cls)
    return dict(sorted(hashes.items()))


def _classes(algorithm_class: type[Algorithm]) -> Sequence[type]:
    """Return an algorithm's class and its bases below `Algorithm`."""
    from offbench.algorithm.interface import Algorithm  # imports PyTorch, which reading config.json does not need

    return algorithm_class.__mro__[: algorithm_class.__mro__.index(Algorithm)]


def own_modules(algorithm: str) -> list[types.ModuleType]:
    """Return the modules of a user's own algorithm that no package brings: its file's, and those beside it."""
    algorithm_class = user_algorithm(algorithm)
    files: dict[Path, None] = {}
    for cls in _classes(algorithm_class) if algorithm_class else ():
        file = Path(getattr(sys.modules.get(cls.__module__), "__file__", None) or "")
        if "." not in cls.__module__ and file.is_file() and not package_versions(cls.__module__):
            imported_files(file, file.parent, files)
    return [one for one in list(sys.modules.values()) if Path(getattr(one, "__file__", None) or "") in files]
