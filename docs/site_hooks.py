"""What makes these pages, which are also read on a code server, a site (see mkdocs.yml).

- Dataset cards (datasets/<env>/README.md) become pages below cards/.
- Pages that a command generates may be missing; links to them become plain text then.
- Links to source files outside docs/ become plain text.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
OPTIONAL = ("benchmarks.md", "cards/")
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Leave out of the contents what is not there."""
    config["nav"] = _present(config["nav"])
    return config


def _present(item: Any) -> Any:
    if isinstance(item, list):
        return [kept for part in item if (kept := _present(part))]
    if isinstance(item, dict):
        return {name: kept for name, part in item.items() if (kept := _present(part))}
    return item if not item.startswith(OPTIONAL) or (ROOT / "docs" / item).exists() else None


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
    """Mend links."""

    def mend(match: re.Match[str]) -> str:
        text, target, place = match[1], match[2], match[3] or ""
        if re.match(r"\w+:", target):
            return match[0]
        card = re.fullmatch(r"\.\./datasets/([\w-]+)/README\.md", target)
        target = f"cards/{card[1]}/index.md" if card else target
        known = files.get_file_from_path(target)
        outside = target.startswith("../") or page.file.src_uri.startswith("cards/")
        if known is None and (outside or target.startswith(OPTIONAL)):
            return text
        return f"[{text}]({target}{place})"

    return LINK.sub(mend, markdown)
