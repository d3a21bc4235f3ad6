"""The code and files of an environment that is not Gymnasium's own: what its datasets and runs depend on."""

from __future__ import annotations

import functools
import importlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from offbench.common.code_hash import module_code, package_versions
from offbench.common.files import sha256

LEFT_OUT = ("gymnasium", "offbench", "builtins", "abc", "typing")  # a version is recorded of these, or Python has them


def environment_code(env_spec: str) -> dict[str, str]:
    """Return {file: hash} of what an environment (EnvSpec JSON) is made of, {} for one of Gymnasium.

    It covers the modules of its class, base classes and wrappers, and files that its arguments name, such as MuJoCo
    models.
    """
    fields, hashes = json.loads(env_spec), dict[str, str]()
    for part in (fields, *(fields.get("additional_wrappers") or ())):
        module, _, name = str(part["entry_point"]).partition(":")
        if module.partition(".")[0] not in LEFT_OUT:
            hashes |= _code(getattr(importlib.import_module(module), name))
        for argument, path in _files("", part.get("kwargs") or {}):
            name = os.path.basename(path)
            name = f"{name} ({argument})" if name in hashes else name
            hashes[name] = sha256(Path(path).read_bytes())
    return dict(sorted(hashes.items()))


def _files(name: str, value: object) -> Iterator[tuple[str, str]]:
    """Yield the files that an argument names, each with the argument's name: `scene`, `assets.0`."""
    if isinstance(value, str) and os.path.isfile(value):
        yield name, value
    elif isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _files(f"{name}.{key}".lstrip("."), item)


@functools.cache  # cached at import: its files may change later
def _code(factory: type | Callable[..., object]) -> dict[str, str]:
    classes = factory.__mro__ if isinstance(factory, type) else (factory,)
    hashes: dict[str, str] = {}
    for module in {cls.__module__ for cls in classes}:
        package, file = module.partition(".")[0], getattr(sys.modules[module], "__file__", None)
        if file is None or package in LEFT_OUT:
            continue
        installed = {"site-packages", "dist-packages"} & set(Path(file).parts)  # its version identifies it
        hashes |= (installed and package_versions(package)) or module_code(module)
    return hashes
