"""HTML as nested calls: text is escaped unless it is markup already, so no name can become a tag."""

from __future__ import annotations

import html
import re

from offbench.common.text import printable


class Markup(str):
    """HTML, which is not escaped again."""

    __slots__ = ()


SHORT = 28
VOID = ("meta", "img", "br", "wbr")


def tag(name: str, /, *children: str | Markup, **attributes: str | int | bool | None) -> Markup:
    """Return an element. A trailing _ of an attribute is dropped (class_), other _ become -; None leaves it out."""
    parts = [name]
    for key, value in attributes.items():
        key = key.rstrip("_").replace("_", "-")
        if value is True:
            parts.append(key)
        elif value is not None and value is not False:
            parts.append(f'{key}="{_escaped(str(value), quote=True)}"')
    opening = f"<{' '.join(parts)}>"
    return Markup(opening) if name in VOID else Markup(f"{opening}{join(*children)}</{name}>")


def _escaped(text: str, quote: bool = False) -> str:
    return html.escape(printable(text), quote)


def join(*children: str | Markup) -> Markup:
    """Return markup and text (escaped) one after another."""
    return Markup("".join(c if isinstance(c, Markup) else _escaped(c) for c in children))


def breakable(text: str) -> Markup:
    """Return short text as one piece; long text may break after commas (not those of 1,000), slashes, equals signs."""
    if len(text) <= SHORT:
        return tag("span", text, class_="short")
    return Markup(re.sub(r"(,(?!\d)|[=/])", r"\1<wbr>", _escaped(text)))


def prose(text: str) -> Markup:
    """Return text with the parts between backticks as code elements."""
    return join(*[tag("code", part) if i % 2 else part for i, part in enumerate(text.split("`"))])
