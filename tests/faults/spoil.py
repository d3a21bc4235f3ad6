"""How the fuzz tests spoil a sound file: bytes, JSON values, words of a table, tensors' headers."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import strategies as st

ODD_WORDS = ["", "nan", "inf", "-inf", "-1", "0", "1e999", "9" * 400, "0x" + "f" * 5000, "true", "[[", "{}", "\0", '"']
ODD_WORDS += ["../../etc/passwd", "/etc/passwd", "ß∞", "1_0", "1979-05-27T07:32:00Z", "None", "=", "[" * 3000, "'''"]
ODD_VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(ODD_WORDS) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
PLACES = st.floats(0, 1, exclude_max=True)
WOUNDS = st.lists(
    st.tuples(st.sampled_from(["flip", "cut", "put", "double", "drop"]), PLACES, st.binary(min_size=1, max_size=12)),
    min_size=1,
    max_size=4,
)


def wounded(data: bytes, wounds: list[tuple[str, float, bytes]]) -> bytes:
    """Flip bits, cut the end off, put bytes in, double or drop a piece."""
    for kind, place, extra in wounds:
        at, size = int(place * len(data)), len(extra)
        if kind == "flip" and data:
            data = data[:at] + bytes([data[at] ^ (1 << extra[0] % 8)]) + data[at + 1 :]
        elif kind == "cut":
            data = data[:at]
        elif kind == "put":
            data = data[:at] + extra + data[at:]
        elif kind == "double":
            data = data[: at + size] + data[at:]
        else:
            data = data[:at] + data[at + size :]
    return data


def with_value(value: Any, place: float, odd: Any) -> Any:
    """Return a JSON value with one of its values, at whatever depth, replaced by an odd one."""
    paths: list[list[Any]] = [[]]

    def walk(part: Any, path: list[Any]) -> None:
        items = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        for key, inner in items:
            paths.append([*path, key])
            walk(inner, [*path, key])

    value = json.loads(json.dumps(value))
    walk(value, [])
    path = paths[int(place * len(paths))]
    if not path:
        return odd
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = odd
    return value


@st.composite
def spoiled_json(draw: Any, sound: bytes) -> bytes:
    if draw(st.booleans()):
        return wounded(sound, draw(WOUNDS))
    value = json.loads(sound)
    for _ in range(draw(st.integers(1, 2))):
        value = with_value(value, draw(PLACES), draw(ODD_VALUES))
    return json.dumps(value).encode()


@st.composite
def spoiled_words(draw: Any, sound: bytes, separators: str) -> bytes:
    """Replace words of a text (cells of a CSV file, names and values of TOML) by odd ones."""
    if draw(st.booleans()):
        return wounded(sound, draw(WOUNDS))
    text = sound.decode()
    for separator in separators[1:]:
        text = text.replace(separator, separators[0] + separator + separators[0])
    words = text.split(separators[0])
    for _ in range(draw(st.integers(1, 3))):
        words[int(draw(PLACES) * len(words))] = draw(st.sampled_from(ODD_WORDS) | st.text(max_size=8))
    return separators[0].join(words).encode("utf-8", "surrogatepass")


@st.composite
def spoiled_tensors(draw: Any, sound: bytes) -> bytes:
    """Wound a safetensors file anywhere, or put odd values into the JSON of its header."""
    if draw(st.booleans()):
        return wounded(sound, draw(WOUNDS))
    length = int.from_bytes(sound[:8], "little")
    header, ours = json.loads(sound[8 : 8 + length]), None
    if draw(st.booleans()):
        ours = json.loads(header["__metadata__"]["offbench"])
        header["__metadata__"]["offbench"] = json.dumps(with_value(ours, draw(PLACES), draw(ODD_VALUES)))
    else:
        header = with_value(header, draw(PLACES), draw(ODD_VALUES))
    text = json.dumps(header).encode()
    return (
        (len(text) if draw(st.booleans()) else draw(st.integers(0, 2**64 - 1))).to_bytes(8, "little")
        + text
        + sound[8 + length :]
    )
