"""The code of an algorithm, as config.json identifies it: a hash of each file that it is made of.

A hash leaves out comments, docstrings and blank lines, which do not affect training. The files are:

    algorithm of offbench             its file
    algorithm of a package            all files of the package, and the installed version
    algorithm in a user's own file    the file, and the files in its folder that it imports
    class of a script or notebook     the class, its Config, its bases, and what they use (see script_code.py)
"""

from __future__ import annotations

import ast
import functools
import importlib.metadata
import io
import sys
import tokenize
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.common.files import sha256
from offbench.training.registry import load_algorithm, own_algorithm
from offbench.training.script_code import MAIN, script_code

if TYPE_CHECKING:
    from offbench.algorithm.interface import Algorithm

_codes: dict[type, dict[str, str]] = {}  # of the imported classes: their files may have changed since
LEFT_OUT = {tokenize.COMMENT, tokenize.NL, tokenize.ENCODING, tokenize.ENDMARKER}


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
            hashes |= script_code([cls, algorithm_class.Config], _source, _beside)
        elif package == "offbench":
            hashes[file.name] = _hash(file)
        elif folders := getattr(sys.modules[package], "__path__", None):  # several of a namespace package
            for folder in map(Path, folders):
                hashes |= {str(path.relative_to(folder.parent)): _hash(path) for path in folder.rglob("*.py")}
            hashes |= _version(package)
        else:
            files = _installed_with(package, file.parent) or _imported(file, file.parent, {})
            hashes |= {str(path.relative_to(file.parent)): _hash(path) for path in {file: None, **files}}
            hashes |= _version(package)
    return dict(sorted(hashes.items()))


def _beside(file: Path) -> dict[str, str]:
    """Return the hashes of a file beside a script, and of the files that it imports."""
    return {str(path.relative_to(file.parent)): _hash(path) for path in _imported(file, file.parent, {})}


def _classes(algorithm_class: type[Algorithm]) -> Sequence[type]:
    """Return an algorithm's class and its bases below `Algorithm`."""
    from offbench.algorithm.interface import Algorithm  # imports PyTorch, which reading config.json does not need

    return algorithm_class.__mro__[: algorithm_class.__mro__.index(Algorithm)]


def own_modules(algorithm: str) -> list[types.ModuleType]:
    """Return the modules of a user's own algorithm that no package brings: its file's, and those beside it."""
    algorithm_class = own_algorithm(algorithm)
    files: dict[Path, None] = {}
    for cls in _classes(algorithm_class) if algorithm_class else ():
        file = Path(getattr(sys.modules.get(cls.__module__), "__file__", None) or "")
        if "." not in cls.__module__ and file.is_file() and not _version(cls.__module__):
            _imported(file, file.parent, files)
    return [one for one in list(sys.modules.values()) if Path(getattr(one, "__file__", None) or "") in files]


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return what differs between two `code_of`, for an error line; "" for nothing, or if either is missing."""
    if not before or not now:
        return ""
    if not set(before) & set(now):
        return f"{', '.join(before)}, not {', '.join(now)}"
    differ = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if not any(name.startswith(MAIN) for name in before):  # of an earlier version, which did not record them
        differ = [name for name in differ if not name.startswith(MAIN)]
    return ", ".join(f"{name} {_describe_change(before.get(name), now.get(name))}" for name in differ)


def _describe_change(before: str | None, now: str | None) -> str:
    if now is None:
        return "is gone"
    if before is None:
        return "is new"
    return f"was {before}, is {now}" if len(now) < 64 else "has changed"


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Return the names of the installed packages that bring each top-level module."""
    return importlib.metadata.packages_distributions()


def _version(module: str) -> dict[str, str]:
    """Return the version of the package that a top-level module was installed with, if it was."""
    return {f"version of {name}": importlib.metadata.version(name) for name in _distributions().get(module, [])}


def _installed_with(module: str, folder: Path) -> dict[Path, None]:
    """Return the Python files in `folder` of the package that a module without a folder of its own comes from."""
    distributions = [importlib.metadata.distribution(name) for name in _distributions().get(module, [])]
    paths = [Path(str(one.locate_file(file))) for one in distributions for file in one.files or ()]
    return {path: None for path in paths if path.suffix == ".py" and folder in path.parents and path.is_file()}


def _imported(file: Path, root: Path, seen: dict[Path, None]) -> dict[Path, None]:
    """Return a file and the files below `root` that it imports, and those that these import.

    Args:
        root: the folder of the algorithm's file, from which Python imports.
    """
    if file in seen or not file.is_file():
        return seen
    seen[file] = None
    for node in ast.walk(ast.parse(_text(file))):
        modules: list[Path] = []
        if isinstance(node, ast.Import):
            modules = [root.joinpath(*alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = file.parents[node.level - 1] if node.level else root
            module = start.joinpath(*(node.module or "").split("."))
            modules = [module, *(module / alias.name for alias in node.names)]
        for path in modules:
            if root / "offbench" in (path, *path.parents):  # the root is a clone, whose version config.json has
                continue
            _imported(path.with_name(f"{path.name}.py"), root, seen)
            for folder in (path, *path.parents):
                if root in folder.parents:  # a package, whose __init__.py is run too
                    _imported(folder / "__init__.py", root, seen)
    return seen


def _text(file: Path) -> str:
    with tokenize.open(file) as opened:  # in the encoding that the file declares
        return opened.read()


def _hash(file: Path) -> str:
    try:
        return _source(_text(file))
    except (SyntaxError, UnicodeDecodeError):  # such as a template in a package, which is never imported
        return sha256(file.read_bytes())


def _source(text: str) -> str:
    return sha256("\n".join(_tokens(text)).encode())


def _tokens(source: str) -> Iterator[str]:
    """Yield the tokens of a source but for comments, docstrings and blank lines."""
    docstrings = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
            docstrings.add((node.body[0].lineno, node.body[0].col_offset))
    lines = io.StringIO(source).readlines()
    opened: list[tuple[int, int]] = []  # where the f-strings around a token begin
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        kind = tokenize.tok_name[token.type]
        if kind.endswith("STRING_START"):
            opened.append(token.start)
        elif kind.endswith("STRING_END"):
            start = opened.pop()
            if not opened:  # the whole f-string as one token, as Python 3.11 reads it
                yield _between(lines, start, token.end)
        elif not opened and token.type not in LEFT_OUT and token.start not in docstrings:
            yield token.string if token.type != tokenize.NEWLINE else ""


def _between(lines: Sequence[str], start: tuple[int, int], end: tuple[int, int]) -> str:
    """Return the text between two positions (line from 1, column)."""
    part = [*lines[start[0] - 1 : end[0] - 1], lines[end[0] - 1][: end[1]]]
    return "".join([part[0][start[1] :], *part[1:]])
