"""Settings as frozen dataclasses: defaults, help, ranges and types live in one place, the field itself.

Recipes (TOML), algorithm configs (CLI flags, config.json) and checks all read the same fields.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from offbench.common.errors import OffbenchError, unknown

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
    """Return the fields of a settings class by name, those that a user may set."""
    return {f.name: f for f in dataclasses.fields(cls) if not f.metadata.get("internal")}


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
    except (TypeError, ValueError, OverflowError):
        raise OffbenchError(f"{where}: {name} must be {_describe(hint)}, not {_shown(value)}") from None
    metadata = fields(cls)[name].metadata
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_range(name, number, metadata, where)
    return value


def _shown(value: Any) -> str:
    """Return a value for an error line, whatever a file held."""
    try:
        return f"{value!r:.60}"
    except (ValueError, RecursionError):  # Python prints no number of 5000 digits
        return "that"


def _check_range(name: str, value: Any, metadata: Mapping[str, Any], where: str) -> None:
    choices = metadata.get("choices")
    if isinstance(value, str) and choices and value not in choices:
        raise OffbenchError(f"{where}: {name} must be one of {', '.join(choices)}, not {value!r}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if isinstance(value, int) and abs(value) >= 2**63:
        raise OffbenchError(f"{where}: {name} is too large a number")
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
    if typing.get_origin(option) is tuple:
        item = typing.get_args(option)[0]
        parts = re.split("[,x]", value) if isinstance(value, str) else value  # 64x64 as folders are named
        if not isinstance(parts, list | tuple):
            raise TypeError
        return tuple(_convert_one(part, item) for part in parts)
    if option in _FROM_TEXT and isinstance(value, str):
        return _FROM_TEXT[option](value)
    if option is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if option is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if type(value) is not option and not (dataclasses.is_dataclass(option) and isinstance(value, option)):  # type: ignore[arg-type]
        raise TypeError
    return value


def _whole(text: str) -> int:
    number = float(text)  # so that 1e6 is understood
    if not number.is_integer():
        raise ValueError
    return int(number)


def _truth(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError
    return text.lower() == "true"


def _none(text: str) -> None:
    if text != "none":
        raise ValueError


_FROM_TEXT: dict[Any, Callable[[str], Any]] = {int: _whole, float: float, bool: _truth, str: str, type(None): _none}


_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "none"}


def _describe(hint: Any) -> str:
    parts = []
    for option in _options(hint):
        if typing.get_origin(option) is tuple:
            parts.append(
                "a list of whole numbers like 256,256 or 256x256" if int in typing.get_args(option) else "a list"
            )
        else:
            parts.append(_WORDS.get(option, str(option)))
    return " or ".join(parts)
