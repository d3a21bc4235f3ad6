"""Hashes of an algorithm's class that was defined in a script, in a notebook or at a prompt (Python's `__main__`).

What else a script does, such as how long it trains, may change between two runs of it. So the hashes are of the class,
of what it uses of `__main__` (functions, classes, numbers, texts, arrays and sets), and of files beside the script
that it uses.
"""

from __future__ import annotations

import dataclasses
import dis
import functools
import inspect
import sys
import types
from collections.abc import Iterator
from pathlib import Path

from offbench.common.code_hash import MAIN, PART_OF, file_hash, imported_files, source_hash
from offbench.common.files import sha256

PLAIN = (bool, int, float, complex, str, bytes, type(None))


def script_code(classes: list[type]) -> dict[str, str]:
    """Return {name: hash} of classes of `__main__`, of what they use there, and of files beside it that they use."""
    hashes = {cls.__qualname__: _hash(cls) for cls in classes}
    used: dict[str, object] = {}  # what is found is looked through in turn
    waiting: list[tuple[str, object]] = [item for cls in classes for item in _used_by_class(cls)]
    while waiting:
        name, value = waiting.pop()
        if name in used or any(value is cls for cls in classes):
            continue
        used[name] = value
        if isinstance(value, types.FunctionType | type) and value.__module__ == "__main__":
            if not any(name.startswith(f"{cls.__qualname__}.") for cls in classes):  # else it is in the class's source
                hashes[MAIN + name] = _hash(value)
            waiting += _used_by_class(value) if isinstance(value, type) else _used_by_function(value)
        elif _is_plain(value):
            hashes[MAIN + name] = sha256(repr(value).encode())
        elif content := _array_or_set_hash(value):
            hashes[f"{MAIN}{name}{PART_OF}content"] = content
        elif file := _file_beside(value):
            for path in imported_files(file, file.parent, {}):
                hashes[f"{MAIN}{path.relative_to(file.parent).as_posix()}"] = file_hash(path)
    return hashes


def closure_code(cls: type) -> dict[str, str]:
    """Return {name: hash} of the values that a class's methods read of the functions around it."""
    hashes = {}
    for _, method in _used_by_class(cls):
        for name, value in closure_of(method) if isinstance(method, types.FunctionType) else ():
            if content := sha256(repr(value).encode()) if _is_plain(value) else _array_or_set_hash(value):
                hashes[name] = content
    return hashes


def _used_by_class(cls: type) -> Iterator[tuple[str, object]]:
    """Yield the functions, classes and values in a class with their names: a value may come from `__main__`."""
    for name, value in vars(cls).items():
        if dataclasses.is_dataclass(cls) and name != "__post_init__":  # made by it, or a setting
            continue
        if isinstance(value, property):
            found: list[object] = [value.fget, value.fset]
        elif isinstance(value, functools.cached_property):
            found = [value.func]
        else:
            found = [getattr(value, "__func__", value)]
        for one in found:
            if isinstance(one, types.FunctionType):
                yield one.__code__.co_qualname, one  # for a decorator, its own name
            elif isinstance(one, type) or not name.startswith("__"):
                yield f"{cls.__qualname__}.{name}", one


def _used_by_function(function: types.FunctionType) -> Iterator[tuple[str, object]]:
    """Yield the globals that a function reads, and what it reads of the functions around it."""
    for name in _global_names(function.__code__):
        if name in function.__globals__:
            yield name, function.__globals__[name]
    yield from closure_of(function)


def closure_of(function: types.FunctionType) -> Iterator[tuple[str, object]]:
    """Yield the variables of the functions around a function that it reads: functions (decorated ones), and values."""
    code = function.__code__
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        if isinstance(content := cell.cell_contents, types.FunctionType):
            yield content.__code__.co_qualname, content
        elif not isinstance(content, type):
            yield f"{code.co_qualname}{PART_OF}{name}", content


def _global_names(code: types.CodeType) -> Iterator[str]:
    """Yield the global names that a function reads, functions within it included."""
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _global_names(constant)


def _is_plain(value: object) -> bool:
    """Return whether a value is a number or a text, or holds nothing else, so that its text tells values apart."""
    if isinstance(value, dict):
        return all(map(_is_plain, (*value.keys(), *value.values())))
    return all(map(_is_plain, value)) if isinstance(value, list | tuple) else isinstance(value, PLAIN)


def _array_or_set_hash(value: object) -> str:
    """Return the hash of an array's numbers or of a set's members, "" for anything else."""
    import numpy as np  # here, because commands that load no algorithm do without NumPy and PyTorch
    import torch

    if isinstance(value, set | frozenset):
        return sha256(repr(sorted(map(repr, value))).encode())
    array = value.detach().cpu().to(torch.float64).numpy() if isinstance(value, torch.Tensor) else value
    if not isinstance(array, np.ndarray) or array.dtype.hasobject:
        return ""
    return sha256(f"{array.dtype}{array.shape}".encode() + array.tobytes())


def _hash(one: type | types.FunctionType) -> str:
    """Return the hash of a class's or function's source; where Python does not know it, that of the compiled code."""
    source = one if isinstance(one, type) else one.__code__  # for a decorated function, that of the decorator
    try:
        return source_hash(inspect.cleandoc("\n" + inspect.getsource(source)))
    except (OSError, TypeError, SyntaxError):
        pass
    if isinstance(one, type):
        functions = [(name, value) for name, value in _used_by_class(one) if isinstance(value, types.FunctionType)]
        parts = [f"{name} {_hash(function)}" for name, function in functions]
        if dataclasses.is_dataclass(one):
            parts += [f"{field.name} {field.default!r}" for field in dataclasses.fields(one)]
        return sha256("\n".join(parts).encode())
    return sha256(repr(_compiled(one.__code__)).encode())


def _compiled(code: types.CodeType) -> tuple[object, ...]:
    """Return what a code object does, without the lines and the file that it comes from."""
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
