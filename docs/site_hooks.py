"""Hooks that turn these pages, which are also read on a code server, into a site (see mkdocs.yml).

- Dataset cards (datasets/<env>/README.md) become pages below cards/.
- Links to source files outside docs/ become plain text.
- Equations (```math, as on GitHub) become MathML, which browsers draw without a script.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
MATH = re.compile(r"^```math\n(.*?)^```$", re.M | re.S)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the dataset cards and their pictures."""
    for card in sorted(ROOT.glob("datasets/*/README.md")):
        files.append(File.generated(config, f"cards/{card.parent.name}/index.md", content=card.read_text()))
        for picture in card.parent.glob("*.png"):
            files.append(
                File.generated(config, f"cards/{card.parent.name}/{picture.name}", content=picture.read_bytes())
            )
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Rewrite links that lead out of docs/, and equations."""

    def rewrite(match: re.Match[str]) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        if re.match(r"\w+:", target):
            return match[0]
        card = re.fullmatch(r"\.\./datasets/([\w-]+)/README\.md", target)
        target = f"cards/{card[1]}/index.md" if card else target
        page_of_site = files.get_file_from_path(target)
        outside = target.startswith("../") or page.file.src_uri.startswith("cards/")
        if page_of_site is None and outside:
            return text
        return f"[{text}]({target}{anchor})"

    return MATH.sub(_equation, LINK.sub(rewrite, markdown))


def _equation(match: re.Match[str]) -> str:
    return f'<div style="overflow-x: auto; margin: 1em 0">{convert(match[1].strip(), display="block")}</div>'
