"""The code and files of an environment that is not Gymnasium's own: what its datasets and runs depend on."""

from __future__ import annotations

import functools
import importlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from offbench.common.code_hash import PART_OF, module_code, package_versions
from offbench.common.files import sha256_of
from offbench.envs.environments import make_env
from offbench.envs.model_files import loaded_files

LEFT_OUT = ("gymnasium", "offbench", "builtins", "abc", "typing")  # a version is recorded of these, or Python has them


def environment_code(env_spec: str) -> dict[str, str]:
    """Return {file: hash} of what an environment (EnvSpec JSON) is made of, {} for one of Gymnasium.

    It covers the modules of its class, base classes and wrappers, files that its arguments name, its MuJoCo model, and
    the files that these models include or load.
    """
    fields, hashes, models = json.loads(env_spec), dict[str, str](), dict[str, str]()
    for part in (fields, *(fields.get("additional_wrappers") or ())):
        module, _, name = str(part["entry_point"]).partition(":")
        if module.partition(".")[0] not in LEFT_OUT:
            hashes |= _code(getattr(importlib.import_module(module), name))
        for argument, path in _files("", part.get("kwargs") or {}):
            name = os.path.basename(path)
            name = f"{name} ({argument})" if name in hashes else name
            hashes[name] = sha256_of(Path(path))
            models[path] = name
    has_own_code = any(name.endswith(".py") for name in hashes)
    if has_own_code and (model := _model(env_spec)) and model not in models:
        hashes[f"model{PART_OF}{os.path.basename(model)}"] = sha256_of(Path(model))
        models[model] = "model"
    for path, name in models.items():
        hashes |= {f"{name}{PART_OF}{file}": found for file, found in loaded_files(Path(path)).items()}
    return dict(sorted(hashes.items()))


def _files(name: str, value: object) -> Iterator[tuple[str, str]]:
    """Yield the files that an argument names, each with the argument's name: `scene`, `assets.0`.

    A word without a folder and an ending (`float32`) names no file, whatever the current folder holds.
    """
    if isinstance(value, str) and os.path.isfile(path := os.path.expanduser(value)):
        if os.path.basename(path) != path or os.path.splitext(path)[1]:
            yield name, path
    elif isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _files(f"{name}.{key}".lstrip("."), item)


def _model(env_spec: str) -> str | None:
    """Return the file of the MuJoCo model of an environment, None if it has none or an installed package's."""
    env = make_env(env_spec)
    env.close()
    path = getattr(env.unwrapped, "fullpath", None)  # of Gymnasium's MujocoEnv
    return path if isinstance(path, str) and os.path.isfile(path) and not _is_installed(path) else None


@functools.cache  # cached at import: its files may change later
def _code(factory: type | Callable[..., object]) -> dict[str, str]:
    classes = factory.__mro__ if isinstance(factory, type) else (factory,)
    hashes: dict[str, str] = {}
    for module in {cls.__module__ for cls in classes}:
        package, file = module.partition(".")[0], getattr(sys.modules[module], "__file__", None)
        if file is None or package in LEFT_OUT:
            continue
        hashes |= (_is_installed(file) and package_versions(package)) or module_code(module)
    return hashes


def _is_installed(file: str) -> bool:
    """Return whether a file is an installed package's, whose version identifies it."""
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
