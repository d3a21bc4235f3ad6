"""Hashes of an algorithm's class that was defined in a script, in a notebook or at a prompt.

What else a script does, such as how long it trains, may change between two runs of it. So the hashes are of the class,
of what it uses of the script (functions, classes, numbers and texts), and of files beside the script that it uses.
"""

from __future__ import annotations

import dataclasses
import dis
import functools
import inspect
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path

from offbench.common.files import sha256

GLOBAL = "global "  # begins the names of what a class uses of its script
PLAIN = (bool, int, float, complex, str, bytes, type(None))


def script_code(
    classes: list[type], source_hash: Callable[[str], str], file_hashes: Callable[[Path], dict[str, str]]
) -> dict[str, str]:
    """Return {name: hash} of classes of `__main__`, of what they use there, and of imported files beside it.

    Args:
        source_hash: of source text.
        file_hashes: of a file and the files that it imports.
    """
    hashes = {cls.__qualname__: _hash(cls, source_hash) for cls in classes}
    waiting, seen = [function for cls in classes for function in _functions(cls)], set[str]()
    for cls in classes:
        for name, value in vars(cls).items():
            if not name.startswith("__") and _is_plain(value):  # it may come from a name in the script
                hashes[f"{GLOBAL}{cls.__qualname__}.{name}"] = sha256(repr(value).encode())
    while waiting:
        function = waiting.pop()
        for name in _globals(function.__code__):
            value = function.__globals__.get(name)
            if name in seen or name not in function.__globals__ or any(value is cls for cls in classes):
                continue
            seen.add(name)
            if isinstance(value, types.FunctionType | type) and value.__module__ == "__main__":
                hashes[GLOBAL + name] = _hash(value, source_hash)
                waiting += _functions(value) if isinstance(value, type) else [inspect.unwrap(value)]
            elif _is_plain(value):
                hashes[GLOBAL + name] = sha256(repr(value).encode())
            elif file := _file_beside(value):
                hashes |= file_hashes(file)
    return hashes


def _functions(cls: type) -> Iterator[types.FunctionType]:
    """Yield the functions of a class, those of properties and of classes within it included."""
    for name, value in vars(cls).items():
        if name.startswith("__") and name != "__post_init__" and dataclasses.is_dataclass(cls):  # written by it
            continue
        if isinstance(value, property):
            found: list[object] = [value.fget, value.fset]
        elif isinstance(value, functools.cached_property):
            found = [value.func]
        else:
            found = [getattr(value, "__func__", value)]
        for one in found:
            if isinstance(one, type) and one.__module__ == "__main__" and one.__qualname__ != cls.__qualname__:
                yield from _functions(one)
            elif callable(one) and isinstance(function := inspect.unwrap(one), types.FunctionType):
                yield function


def _globals(code: types.CodeType) -> Iterator[str]:
    """Yield the global names that a function reads, functions within it included."""
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _globals(constant)


def _is_plain(value: object) -> bool:
    """Return whether a value is a number or a text, or holds nothing else, so that its text tells values apart."""
    if isinstance(value, dict):
        return all(map(_is_plain, (*value.keys(), *value.values())))
    return all(map(_is_plain, value)) if isinstance(value, list | tuple) else isinstance(value, PLAIN)


def _hash(one: type | types.FunctionType, source_hash: Callable[[str], str]) -> str:
    """Return the hash of a class's or function's source; where Python does not know it, that of the compiled code."""
    try:
        return source_hash(inspect.cleandoc("\n" + inspect.getsource(one)))
    except (OSError, TypeError, SyntaxError):
        pass
    if isinstance(one, type):
        parts = [f"{function.__name__} {_hash(function, source_hash)}" for function in _functions(one)]
        if dataclasses.is_dataclass(one):
            parts += [f"{field.name} {field.default!r}" for field in dataclasses.fields(one)]
        return sha256("\n".join(parts).encode())
    return sha256(repr(_compiled(one.__code__)).encode())


def _compiled(code: types.CodeType) -> tuple[object, ...]:
    constants: list[object] = []
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            constants.append(_compiled(one))
        else:
            constants.append(sorted(map(repr, one)) if isinstance(one, frozenset) else one)
    return code.co_code, constants, code.co_names, code.co_varnames


def _file_beside(value: object) -> Path | None:
    """Return the file that a module, function or class comes from, if it is in the script's folder or below it."""
    module = (
        value if isinstance(value, types.ModuleType) else sys.modules.get(getattr(value, "__module__", None) or "")
    )
    if getattr(module, "__name__", "offbench").partition(".")[0] == "offbench":  # config.json has its version
        return None
    file = Path(getattr(module, "__file__", None) or "").absolute()
    script = getattr(sys.modules["__main__"], "__file__", None)
    folder = Path(script).absolute().parent if script else Path.cwd()
    beside = folder in file.parents and not {"site-packages", "dist-packages"} & set(file.parts)
    return file if file.suffix == ".py" and beside else None
