"""What a browser would read in a report, without a browser; and runs whose every name is markup."""

from __future__ import annotations

import csv
import json
from html.parser import HTMLParser
from pathlib import Path

from offbench.common.files import write_json
from tests.made_runs import made_run


class Page(HTMLParser):
    """What a browser would see: elements, their attributes, and the text of each section and box."""

    VOID = ("meta", "img", "br", "wbr")

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.ids: list[str] = []
        self.feed(path.read_text())
        assert self.open == []  # every element is closed, in order

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((name, dict(attributes)))
        self.ids += [value for key, value in attributes if key == "id" and value]
        if name not in self.VOID:
            self.open.append(name)

    def handle_startendtag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(name, attributes)
        if name not in self.VOID:
            self.open.pop()

    def handle_endtag(self, name: str) -> None:
        assert self.open.pop() == name

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.text += data


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


HOSTILE = "<script>hacked=1</script><img src=x onerror=hacked=1>\"'--> $x^{ %&#_~|`</style>"


def hostile_runs(root: Path) -> None:
    for seed in range(2):
        for algorithm in ("td3_bc", HOSTILE):
            settings = {"beta": HOSTILE, HOSTILE: HOSTILE}
            run = made_run(root, f"_{HOSTILE}-v0", algorithm, HOSTILE, seed, 50, settings=settings, beta=0.5)
            config = json.loads(run.config_path.read_text())
            bad = {
                "command": HOSTILE,
                "versions": {HOSTILE: HOSTILE},
                "hardware": {HOSTILE: HOSTILE},
                "device": HOSTILE,
            }
            write_json(run.config_path, config | bad)
