"""The files that the XML of a MuJoCo model includes or loads: other XML, meshes, height fields, textures."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from offbench.common.files import sha256_of

FOLDERS = ("assetdir", "meshdir", "texturedir")  # attributes of <compiler>


def loaded_files(model: Path) -> dict[str, str]:
    """Return {path: hash} of the files that a model includes or loads, with paths relative to the model's folder.

    A name in the XML may be relative to the model's folder, to that of the file it is in, or to a folder of FOLDERS
    in one of these. Each such file that exists is hashed.
    """
    files = root = {os.path.normpath(model)}
    while True:
        names, folders = _references(files)
        bases = {os.path.dirname(file) for file in files}
        paths = {os.path.normpath(os.path.join(*parts)) for parts in itertools.product(bases, folders, names)}
        if not (new := {path for path in paths if os.path.isfile(path)} - files):
            return {_relative(path, model): sha256_of(Path(path)) for path in sorted(files - root)}
        files = files | new


def _relative(path: str, model: Path) -> str:
    """Return a path relative to a model's folder, the same text on each operating system."""
    return Path(os.path.relpath(path, model.parent)).as_posix()


def _references(files: Iterable[str]) -> tuple[set[str], set[str]]:
    """Return the names of files in the XML of `files`, and of folders that they may be in."""
    names, folders = set(), {""}
    for file in files:
        try:
            elements = list(ElementTree.parse(file).iter())
        except ElementTree.ParseError:  # a mesh, a texture
            continue
        names |= {name for element in elements if (name := element.get("file"))}
        folders |= {folder for element in elements for attribute in FOLDERS if (folder := element.get(attribute))}
    return names, folders
