"""A headless Chromium for tests, and a way to take the picture of a report.

python -m tests.browsers report/index.html docs/report.png [--dark | --phone]
"""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

VIEWS: dict[str, dict[str, Any]] = {
    "wide": {"viewport": {"width": 1360, "height": 900}},
    "dark": {"viewport": {"width": 1360, "height": 900}, "color_scheme": "dark"},
    "phone": {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "device_scale_factor": 2},
}


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """Yield a browser: the system's Chromium, or the one playwright has downloaded.

    Raises:
        ImportError: playwright is missing.
        FileNotFoundError: there is no Chromium.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise ImportError("playwright is missing: pip install 'offbench[browser]'") from None
    names = ("chromium", "chromium-browser", "google-chrome")
    system = next((path for name in names if (path := shutil.which(name))), None)
    with sync_playwright() as driver:
        path = system or driver.chromium.executable_path
        if not Path(path).exists():
            raise FileNotFoundError("no Chromium here: apt-get install chromium, or playwright install chromium")
        # the sandbox needs a user namespace, which containers often lack; the page is our own
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


def main(page_path: str, picture: str, view: str = "--wide") -> None:
    """Save what a reader sees first."""
    with chromium() as browser:
        page = browser.new_context(**VIEWS[view.removeprefix("--")]).new_page()
        page.goto(Path(page_path).absolute().as_uri())
        page.screenshot(path=picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
