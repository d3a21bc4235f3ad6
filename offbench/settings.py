"""Settings as frozen dataclasses: defaults, help, ranges and types live in one place, the field itself.

Recipes (TOML), algorithm configs (CLI flags, config.json) and checks all read the same fields.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from offbench.errors import OffbenchError, unknown

T = TypeVar("T")


def setting(
    default: Any,
    help: str,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    per_run: bool = False,
) -> Any:
    """Declare a dataclass field: its default, its help and the values it may take.

    Args:
        low, high: inclusive bounds; `above` is an exclusive lower bound.
        choices: the words a string may be.
        per_run: runs that differ in this setting may train in one stack.
    """
    metadata = {
        "help": help,
        "low": low,
        "above": above,
        "high": high,
        "choices": choices,
        "per_run": per_run,
    }
    return dataclasses.field(default=default, metadata=metadata)


def fields(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields of a settings class by name."""
    return {f.name: f for f in dataclasses.fields(cls)}


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """Make a settings object from a mapping, e.g. a parsed TOML table.

    Args:
        where: what the mapping is, for the error line.

    Raises:
        OffbenchError: an unknown key (the nearest known one is named), a wrong type or a value out of range.
    """
    known = fields(cls)
    for key in values:
        if key not in known:
            raise OffbenchError(f"{where}: {unknown('key', key, known)}")
    checked = {key: check(cls, key, value, where) for key, value in values.items()}
    missing = [
        name
        for name, f in known.items()
        if name not in checked and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise OffbenchError(f"{where}: missing key {missing[0]!r}")
    return cls(**checked)


def check(cls: type, name: str, value: Any, where: str) -> Any:
    """Return `value` as the type of the field `name`, or raise OffbenchError naming `where`."""
    hint = typing.get_type_hints(cls)[name]
    try:
        value = _convert(value, hint)
    except (TypeError, ValueError):
        raise OffbenchError(f"{where}: {name} must be {_describe(hint)}, not {value!r}") from None
    metadata = fields(cls)[name].metadata
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_range(name, number, metadata, where)
    return value


def _check_range(name: str, value: Any, metadata: Mapping[str, Any], where: str) -> None:
    choices = metadata.get("choices")
    if isinstance(value, str) and choices and value not in choices:
        raise OffbenchError(f"{where}: {name} must be one of {', '.join(choices)}, not {value!r}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    low, above, high = metadata.get("low"), metadata.get("above"), metadata.get("high")
    if not math.isfinite(value):
        raise OffbenchError(f"{where}: {name} must be a finite number, not {value}")
    if low is not None and value < low:
        raise OffbenchError(f"{where}: {name} must be at least {low:g}, not {value:g}")
    if above is not None and value <= above:
        raise OffbenchError(f"{where}: {name} must be more than {above:g}, not {value:g}")
    if high is not None and value > high:
        raise OffbenchError(f"{where}: {name} must be at most {high:g}, not {value:g}")


def _options(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.get_args(hint)
    return (hint,)


def _convert(value: Any, hint: Any) -> Any:
    """Return `value` as `hint`; text (from a command line) is parsed. Raises TypeError or ValueError."""
    errors = []
    for option in _options(hint):
        try:
            return _convert_one(value, option)
        except (TypeError, ValueError) as error:
            errors.append(error)
    raise errors[0]


def _convert_one(value: Any, option: Any) -> Any:
    if option is type(None):
        if value is None or value == "none":
            return None
        raise TypeError
    if typing.get_origin(option) is tuple:
        item = typing.get_args(option)[0]
        parts = value.split(",") if isinstance(value, str) else value
        if not isinstance(parts, list | tuple):
            raise TypeError
        return tuple(_convert_one(part, item) for part in parts)
    if option is bool:
        if isinstance(value, bool):
            return value
        return {"true": True, "false": False}[value.lower()] if isinstance(value, str) else _wrong()
    if isinstance(value, bool) or value is None:
        raise TypeError
    if option is int:
        number = float(value)
        if number != int(number):
            raise ValueError
        return int(value) if not isinstance(value, str) else int(number)
    if option is float:
        return float(value)
    if option is str and isinstance(value, str):
        return value
    if dataclasses.is_dataclass(option) and isinstance(value, option):  # type: ignore[arg-type]
        return value
    raise TypeError


def _wrong() -> bool:
    raise TypeError


def _describe(hint: Any) -> str:
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "none"}
    parts = []
    for option in _options(hint):
        if typing.get_origin(option) is tuple:
            parts.append(f"a list of {words.get(typing.get_args(option)[0], 'values')}s like 256,256")
        else:
            parts.append(words.get(option, getattr(option, "__name__", str(option))))
    return " or ".join(parts)
