"""Settings and metadata as frozen dataclasses, whose fields hold their defaults, help, ranges and types.

build       a recipe (TOML), a grid (TOML) or an algorithm's settings (CLI flags, config.json) to a settings object
read_back   metadata that offbench wrote as JSON (a run's config.json) to a dataclass
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from offbench.common.errors import DamagedError, OffbenchError, unknown
from offbench.common.text import MAX_INT, whole_number

T = TypeVar("T")
Field: TypeAlias = dataclasses.Field[Any]
_type_hints = functools.cache(typing.get_type_hints)  # evaluating them takes most of the time of reading a config.json


def setting(
    default: T,
    help: str,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    per_run: bool = False,
    notes: Mapping[str, str] | None = None,
) -> T:
    """Declare a dataclass field: its default, its help and the values it may take.

    Args:
        low, high: inclusive bounds; `above` is an exclusive lower bound.
        choices: the values a string may have.
        per_run: runs that differ in this setting may train in one stack.
        notes: {value: a note to print when a run is trained with it}.
    """
    metadata = {
        "help": help,
        "low": low,
        "above": above,
        "high": high,
        "choices": choices,
        "per_run": per_run,
        "notes": notes or {},
    }
    return dataclasses.field(default=default, metadata=metadata)


def fields(cls: type) -> Mapping[str, Field]:
    """Return the fields of a settings class that a user may set, by name."""
    return _fields(cls)


@functools.cache  # not on `fields`: mypy would refuse type[T] as a key
def _fields(cls: type) -> Mapping[str, Field]:
    return {f.name: f for f in dataclasses.fields(cls) if not f.metadata.get("internal")}


def build(cls: type[T], values: Mapping[str, object], where: str) -> T:
    """Make a settings object from a mapping, e.g. a parsed TOML table.

    Args:
        where: the name of the mapping in error messages.

    Raises:
        OffbenchError: an unknown key (the nearest valid one is named), a missing one, a wrong type or a value out of
            range.
    """
    valid = fields(cls)
    for key in values:
        if key not in valid:
            raise OffbenchError(f"{where}: {unknown('key', key, valid)}")
    return cls(**_checked(cls, values, where, parse=True))


def read_back(cls: type[T], values: object, file: Path | str, remedy: str) -> T:
    """Make a metadata object from parsed JSON, as another version of offbench may have written it.

    Types are strict (text is no number), and keys that `cls` does not have are ignored. A field may be a dataclass or
    a list of them (`tuple[cls, ...]`).

    Args:
        file, remedy: for the error line: where the JSON is from, and what to do about it.

    Raises:
        DamagedError: not a JSON object, a missing key, a wrong type or a value out of range.
    """
    try:
        return _from_json(cls, values)
    except (OffbenchError, ValueError) as error:
        raise DamagedError(f"{file} is damaged ({error}); {remedy}") from None


def _from_json(cls: type[T], values: object) -> T:
    if not isinstance(values, dict):
        raise ValueError(f"must be a JSON object, not {short_repr(values)}")
    return cls(**_checked(cls, {key: values[key] for key in fields(cls) if key in values}, "", parse=False))


def _checked(cls: type, values: Mapping[str, object], where: str, parse: bool) -> dict[str, Any]:
    checked = {key: check(cls, key, value, where, parse=parse) for key, value in values.items()}
    for name, field in fields(cls).items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in checked:
            raise _error(where, f"missing key {name!r}")
    return checked


def _error(where: str, text: str) -> OffbenchError:
    return OffbenchError(f"{where}: {text}" if where else text)


def check(cls: type, name: str, value: object, where: str, *, parse: bool = True) -> Any:
    """Return `value` as the type of the field `name`. Raises OffbenchError, which begins with `where`.

    Args:
        parse: whether to convert text to numbers, lists and so on, as for a command line.
    """
    hint = _type_hints(cls)[name]
    try:
        value = _convert(value, hint, parse)
    except (TypeError, ValueError, OverflowError):
        raise _error(where, f"{name} must be {_describe(hint)}, not {short_repr(value)}") from None
    metadata = fields(cls)[name].metadata
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_range(name, number, metadata, where)
    return value


def check_declarations(cls: type, where: str) -> None:
    """Raise OffbenchError if a settings class has a field of a type that settings cannot have, or a bad default."""
    try:
        hints = _type_hints(cls)
    except NameError as error:
        raise _error(where, f"the type of a setting is unknown: {error}") from None
    for name, field in fields(cls).items():
        options = _options(hints[name])
        if not all(option in _FROM_TEXT or typing.get_origin(option) is tuple for option in options):
            types_text = "int, float, bool, str, None, tuple[int, ...] and unions of these"
            raise _error(where, f"the setting {name} is declared as {hints[name]}; settings are {types_text}")
        words = str in options and not field.metadata.get("choices")
        if field.metadata.get("per_run") and (words or not {int, float, bool, str}.issuperset(options)):
            raise _error(where, f"the setting {name} is per_run, so it must be a number, or a word of its choices=")
        if field.init and field.default is not dataclasses.MISSING:
            check(cls, name, field.default, f"{where}: a default", parse=False)


def without_numpy(value: object) -> Any:
    """Return a NumPy number or array as Python's number or list, which JSON can hold; anything else as it is."""
    numpy = sys.modules.get("numpy")  # not imported here, because --help does without it
    return value.tolist() if numpy and isinstance(value, numpy.generic | numpy.ndarray) else value


def check_count(name: str, value: object, low: int = 1) -> int:
    """Return a whole number from `low` that a user of the Python interface gave. Raises OffbenchError for others."""
    value = without_numpy(value)
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise OffbenchError(f"{name} must be a whole number from {low}, not {short_repr(value)}")
    return value


def short_repr(value: object) -> str:
    """Return the repr of a value, shortened for an error message."""
    try:
        return f"{value!r:.60}"
    except (ValueError, RecursionError):  # Python prints no number of 5000 digits
        return "this"


def _check_range(name: str, value: object, metadata: Mapping[str, Any], where: str) -> None:
    choices = metadata.get("choices")
    if isinstance(value, str) and choices and value not in choices:
        kind = "a number or" if metadata.get("low") is not None else "one of"
        raise _error(where, f"{name} must be {kind} {', '.join(choices)}, not {value!r}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if isinstance(value, int) and abs(value) > MAX_INT:
        raise _error(where, f"{name} is too large a number")
    low, above, high = metadata.get("low"), metadata.get("above"), metadata.get("high")
    if not math.isfinite(value):
        raise _error(where, f"{name} must be a finite number, not {value}")
    if low is not None and value < low:
        raise _error(where, f"{name} must be at least {low:g}, not {value:g}")
    if above is not None and value <= above:
        raise _error(where, f"{name} must be more than {above:g}, not {value:g}")
    if high is not None and value > high:
        raise _error(where, f"{name} must be at most {high:g}, not {value:g}")


def _options(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.get_args(hint)
    return (hint,)


def _convert(value: object, hint: Any, parse: bool) -> Any:
    """Return `value` as `hint`. Raises TypeError, ValueError, or OffbenchError from a dataclass in it."""
    errors = []
    for option in _options(hint):
        try:
            return _convert_one(value, option, parse)
        except (TypeError, ValueError) as error:
            errors.append(error)
    raise errors[0]


def _convert_one(value: object, option: Any, parse: bool) -> Any:
    if option is Any:
        return value
    value = without_numpy(value)
    if typing.get_origin(option) is tuple:
        items = typing.get_args(option)
        parts = re.split("[,x]", value) if isinstance(value, str) and parse else value  # 64x64 as folders are named
        if not isinstance(parts, list | tuple):
            raise TypeError
        if items[-1] is Ellipsis:
            items = items[:1] * len(parts)
        return tuple(_convert(part, item, parse) for part, item in zip(parts, items, strict=True))
    if typing.get_origin(option) is dict:
        if not isinstance(value, dict):
            raise TypeError
        return {key: _convert(item, typing.get_args(option)[1], parse) for key, item in value.items()}
    if dataclasses.is_dataclass(option) and isinstance(value, dict) and not parse:
        return _from_json(option, value)  # type: ignore[arg-type]
    if option in _FROM_TEXT and isinstance(value, str) and parse:
        return _FROM_TEXT[option](value)
    if option is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if option is int and isinstance(value, float) and value.is_integer() and parse:
        return int(value)
    if type(value) is not option and not (dataclasses.is_dataclass(option) and isinstance(value, option)):  # type: ignore[arg-type]
        raise TypeError
    return value


def _parse_bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError
    return text.lower() == "true"


def _parse_none(text: str) -> None:
    if text != "none":
        raise ValueError


_FROM_TEXT: dict[type, Callable[[str], object]] = {
    int: whole_number,
    float: float,
    bool: _parse_bool,
    str: str,
    type(None): _parse_none,
}


_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "none"}


def _describe(hint: Any) -> str:
    parts = []
    for option in _options(hint):
        if typing.get_origin(option) is tuple:
            parts.append(
                "a list of whole numbers like 256,256 or 256x256" if int in typing.get_args(option) else "a list"
            )
        else:
            parts.append(_TYPE_NAMES.get(option, "a table"))
    return " or ".join(parts)
