"""The code of an algorithm, as config.json identifies it: a hash of each file that it is made of.

A hash leaves out comments, docstrings and blank lines, which train nothing. The files are

    of offbench's own algorithms   the algorithm's file
    of a package                   all files of the package, and the version that is installed
    of a file or a class           the file, and the files beside it that it imports
    of a script's or notebook's    the source of the class, its Config and its bases
"""

from __future__ import annotations

import ast
import importlib.metadata
import inspect
import io
import sys
import tokenize
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from offbench.common.files import sha256
from offbench.training.registry import load_algorithm

if TYPE_CHECKING:
    from offbench.algorithm.interface import Algorithm

_codes: dict[type, dict[str, str]] = {}  # of the imported classes: their files may have changed since
LEFT_OUT = {tokenize.COMMENT, tokenize.NL, tokenize.ENCODING, tokenize.ENDMARKER}


def code_of(algorithm: str) -> dict[str, str]:
    """Return {file: hash} of an algorithm's code, and {"version of PACKAGE": version} of a package's.

    It is empty for a class whose source Python does not know, one that was typed at a prompt.
    """
    kind = load_algorithm(algorithm)
    if kind not in _codes:
        _codes[kind] = _code_of(kind)
    return _codes[kind]


def _code_of(kind: type[Algorithm]) -> dict[str, str]:
    from offbench.algorithm.interface import Algorithm  # imports PyTorch, which those who read config.json do without

    hashes: dict[str, str] = {}
    for cls in kind.__mro__[: kind.__mro__.index(Algorithm)]:
        module = sys.modules.get(cls.__module__)
        file = Path(getattr(module, "__file__", None) or "")
        package = cls.__module__.partition(".")[0]
        if cls.__module__ == "__main__" or not file.is_file():
            hashes |= {one.__qualname__: text for one in (cls, kind.Config) if (text := _source_hash(one))}
        elif package == "offbench":
            hashes[file.name] = _hash(file.read_text("utf-8"))
        elif package != cls.__module__ or file.name == "__init__.py":
            root = Path(str(sys.modules[package].__file__)).parent
            hashes |= {
                str(path.relative_to(root.parent)): _hash(path.read_text("utf-8")) for path in root.rglob("*.py")
            }
            hashes |= _version(package)
        else:
            hashes |= {path.name: _hash(path.read_text("utf-8")) for path in _imported(file, {})} | _version(package)
    return dict(sorted(hashes.items()))


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return what differs between two `code_of`, for an error line; "" for nothing, or if either is missing."""
    if not before or not now:
        return ""
    differ = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return ", ".join(f"{name} {_how(before.get(name), now.get(name))}" for name in differ)


def _how(before: str | None, now: str | None) -> str:
    if now is None:
        return "is gone"
    if before is None:
        return "is new"
    return f"was {before}, is {now}" if len(now) < 64 else "has changed"


def _version(package: str) -> dict[str, str]:
    """Return the version of the package that a module was installed with, if it was."""
    names = importlib.metadata.packages_distributions().get(package, [])
    return {f"version of {name}": importlib.metadata.version(name) for name in names}


def _source_hash(cls: type) -> str:
    try:
        return _hash(inspect.cleandoc("\n" + inspect.getsource(cls)))
    except (OSError, TypeError, SyntaxError):
        return ""


def _imported(file: Path, seen: dict[Path, None]) -> dict[Path, None]:
    """Return a file and the files of its folder that it imports, and those that these import."""
    if file in seen or not file.is_file():
        return seen
    seen[file] = None
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        for name in names:
            path = file.parent.joinpath(*name.split("."))
            for candidate in (path.with_suffix(".py"), path / "__init__.py"):
                _imported(candidate, seen)
    return seen


def _hash(source: str) -> str:
    return sha256("\n".join(_tokens(source)).encode())


def _tokens(source: str) -> Iterator[str]:
    """Yield the tokens of a source but for comments, docstrings and blank lines."""
    docstrings = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
            docstrings.add((node.body[0].lineno, node.body[0].col_offset))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LEFT_OUT and token.start not in docstrings:
            yield token.string if token.type != tokenize.NEWLINE else ""
