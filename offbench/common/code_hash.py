"""Hashes of Python code that results depend on: an algorithm's, an environment's.

A hash leaves out comments, docstrings and blank lines, which change no result.
"""

from __future__ import annotations

import ast
import functools
import importlib.metadata
import io
import sys
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from offbench.common.files import sha256

LEFT_OUT = {tokenize.COMMENT, tokenize.NL, tokenize.ENCODING, tokenize.ENDMARKER}
# `WHOLE: PART` names what a class of a script, or a MuJoCo model, uses; earlier versions recorded the wholes only
PART_OF = ": "
MAIN = f"__main__{PART_OF}"


def describe_changes(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return how two {file: hash} differ, for a message; "" if they are equal or one is empty."""
    if not before or not now:
        return ""
    if not set(before) & set(now):
        return f"{', '.join(before)}, not {', '.join(now)}"
    recorded = {"", *map(_whole, before)}  # parts count if `before` has parts of the same whole
    differ = [name for name in {**before, **now} if before.get(name) != now.get(name) and _whole(name) in recorded]
    return ", ".join(f"{name} {_describe_change(before.get(name), now.get(name))}" for name in differ)


def _whole(name: str) -> str:
    """Return what `name` names a part of, "" if it names no part."""
    return name.rpartition(PART_OF)[0]


def _describe_change(before: str | None, now: str | None) -> str:
    if now is None:
        return "is gone"
    if before is None:
        return "is new"
    is_version = len(now) < 64
    return f"was {before}, is {now}" if is_version else "has changed"


def module_code(name: str) -> dict[str, str]:
    """Return {file: hash} of an imported module, and {"version of PACKAGE": version} of a package's.

    The files are those of its package; without one, its own file and those beside it that it imports, or that were
    installed with it.
    """
    package, file = name.partition(".")[0], Path(getattr(sys.modules[name], "__file__", None) or "")
    if folders := getattr(sys.modules[package], "__path__", None):  # several of a namespace package
        found = [(path, Path(folder).parent) for folder in folders for path in Path(folder).rglob("*.py")]
    else:
        files = _installed_with(package, file.parent) or imported_files(file, file.parent, {})
        found = [(path, file.parent) for path in {file: None, **files}]
    return {path.relative_to(root).as_posix(): file_hash(path) for path, root in found} | package_versions(package)


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Return the names of the installed packages that bring each top-level module."""
    return importlib.metadata.packages_distributions()


def package_versions(module: str) -> dict[str, str]:
    """Return the version of the package that a top-level module was installed with, if it was."""
    return {f"version of {name}": importlib.metadata.version(name) for name in _distributions().get(module, [])}


def _installed_with(module: str, folder: Path) -> dict[Path, None]:
    """Return the Python files in `folder` of the package that a module without a folder of its own comes from."""
    distributions = [importlib.metadata.distribution(name) for name in _distributions().get(module, [])]
    paths = [Path(str(one.locate_file(file))) for one in distributions for file in one.files or ()]
    return {path: None for path in paths if path.suffix == ".py" and folder in path.parents and path.is_file()}


def imported_files(file: Path, root: Path, seen: dict[Path, None]) -> dict[Path, None]:
    """Return a file and the files below `root` that it imports, and those that these import.

    Args:
        root: the folder of the first file, from which Python imports.
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
            imported_files(path.with_name(f"{path.name}.py"), root, seen)
            for folder in (path, *path.parents):
                if root in folder.parents:  # a package, whose __init__.py is run too
                    imported_files(folder / "__init__.py", root, seen)
    return seen


def _text(file: Path) -> str:
    with tokenize.open(file) as opened:  # uses the encoding that the file declares
        return opened.read()


def file_hash(file: Path) -> str:
    """Return the hash of a file's source, or of its bytes if they are no Python of this version."""
    try:
        return source_hash(_text(file))
    except (SyntaxError, UnicodeDecodeError):  # such as a template in a package, which is never imported
        return sha256(file.read_bytes())


def source_hash(text: str) -> str:
    """Return the hash of source text."""
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
