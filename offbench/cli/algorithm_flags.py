"""The command-line flags of an algorithm, made from its Config."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator, Mapping

from offbench.cli.arguments import Parser, complete_with
from offbench.common.settings import Field, fields

OPTIMIZATION = ("batch_size", "discount", "tau", "policy_freq", "normalize")  # settings that every method has


def add_settings(parser: Parser, algorithm: str) -> type:
    """Add an algorithm's own settings, in groups. Returns its Config."""
    from offbench.training.registry import load_algorithm, register

    config = load_algorithm(register(algorithm)).Config
    titles = {
        "method": f"settings of {algorithm}",
        "optimization": f"optimization of {algorithm}",
        "ours": "extensions that are not in the paper",
    }
    groups = {}
    members = fields(config)
    for group, title in titles.items():
        for name, field in members.items():
            if _help_group(name, field) != group:
                continue
            if group not in groups:
                groups[group] = parser.add_argument_group(title)
            action = groups[group].add_argument(
                f"--{name.replace('_', '-')}",
                dest=f"setting_{name}",
                nargs="+",
                metavar="N,N" if isinstance(field.default, tuple) else "X",
                default=argparse.SUPPRESS,
                help=_help(field).replace("%", "%%"),
            )
            complete_with(action, functools.partial(list, field.metadata.get("choices") or ()))
    return config


def _help_group(name: str, field: Field) -> str:
    """Return the group of a setting in the help: `method`, `optimization` or `ours`."""
    if field.metadata.get("help", "").startswith("ours"):
        return "ours"
    return "optimization" if name in OPTIMIZATION or name.endswith(("learning_rate", "hidden")) else "method"


def _help(field: Field) -> str:
    """Return a setting's help with its choices and its default."""
    choices = " | ".join(field.metadata.get("choices") or ())
    default = ",".join(map(str, field.default)) if isinstance(field.default, tuple) else str(field.default)
    text = field.metadata.get("help", "").removeprefix("ours: ")
    return f"{text} ({choices}{'; ' if choices else ''}default: {default})"


def notices(config: type, settings: Mapping[str, object]) -> Iterator[str]:
    """Yield the notes that the algorithm's Config declares for these values of settings."""
    for name, field in fields(config).items():
        values = settings.get(name, [field.default])
        for value, text in field.metadata.get("notes", {}).items():
            if value in (values if isinstance(values, list) else [values]):
                yield text


def moved_flag(algorithm: str, named_settings: Mapping[str, object], words: list[str]) -> str | None:
    """Return the first flag that bdb had in earlier versions and bdb_plus has now; None if there is none.

    Args:
        named_settings: the settings in the method's name, which count as flags: `bdb (learned)`.
    """
    from offbench.training.former_settings import MOVED

    if algorithm != "bdb":
        return None
    if named_settings.get("beta") == ["learned"]:
        return "--beta learned"
    moved, flag = {f"--{name.replace('_', '-')}" for name in MOVED}, ""
    for word in words:
        name, _, value = word.partition("=")
        flag = name if word.startswith("--") else flag
        if flag in moved:
            return flag
        if flag == "--beta" and "learned" in (word, value):
            return "--beta learned"
    return None
