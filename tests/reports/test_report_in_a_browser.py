"""The report in headless Chromium: no console error, nothing fetched, tables sort, a cell opens its box.

Needs the extra `browser` and a Chromium (Debian: `apt-get install chromium`; elsewhere `playwright install chromium`);
skipped without them. OFFBENCH_SCREENSHOTS names a folder to keep what was seen.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import offbench
from tests.browsers import VIEWS, chromium
from tests.made_runs import made_grid, made_run
from tests.pages import hostile_runs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    try:
        with chromium() as found:
            yield found
    except (ImportError, FileNotFoundError) as error:
        pytest.skip(str(error))


def opened(browser: Any, path: Path, view: str) -> tuple[Any, list[str], list[str]]:
    """Open a page; return it with the lists of its console messages and of its requests."""
    page = browser.new_context(**VIEWS[view]).new_page()
    messages: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    return page, messages, requests


@pytest.mark.parametrize("view", VIEWS)
def test_the_report_opens_sorts_and_explains_a_cell(browser: Any, home: Path, view: str) -> None:
    made_grid(home / "runs", envs=("hopper", "walker2d"), seeds=2, levels=2)
    path = offbench.report(home / "runs", home / "out").absolute()
    page, messages, requests = opened(browser, path, view)
    widths = [page.evaluate(f"document.documentElement.{key}") for key in ("scrollWidth", "clientWidth")]
    assert widths[0] <= widths[1]  # wide tables scroll inside their frames, not the page
    values = "[...document.querySelectorAll('#scores tbody tr')].map(row => Number(row.cells[2].dataset.value))"
    assert len(page.evaluate(values)) == 4
    head = page.locator("#scores thead th").nth(2)
    head.locator("button").click()
    assert head.get_attribute("aria-sort") == "descending"
    assert page.evaluate(values) == sorted(page.evaluate(values), reverse=True)
    head.locator("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert page.evaluate(values) == sorted(page.evaluate(values))
    names = "[...document.querySelectorAll('#scores tbody tr')].map(row => row.cells[1].textContent)"
    page.locator("#scores thead th button").nth(1).click()
    assert page.evaluate(names) == sorted(page.evaluate(names))
    cell = page.locator("#scores button[data-box]").first
    cell.click()
    box = page.locator("dialog[open]")
    assert box.count() == 1
    for words in ("offbench train td3_bc --dataset", "torch 2.13.0", "seed-0", "seed-1", "own reference: 0 to 100"):
        assert words in box.inner_text()
    keep = os.environ.get("OFFBENCH_SCREENSHOTS")
    if keep:
        page.screenshot(path=Path(keep) / f"report-{view}-cell.png")
    page.keyboard.press("Escape")
    assert page.locator("dialog[open]").count() == 0
    cell.click()
    box.get_by_role("button", name="Close").click()
    assert page.locator("dialog[open]").count() == 0
    if keep:
        page.screenshot(path=Path(keep) / f"report-{view}.png")
    assert messages == []
    assert requests == [path.as_uri()]


def test_seven_methods_fit_a_laptop(browser: Any, home: Path) -> None:
    made_grid(home / "runs", envs=("hopper", "halfcheetah"), seeds=2, levels=2)
    for seed in range(2):
        made_run(home / "runs", "halfcheetah-medium-replay-v0", "bc", "default", seed, 20)
    path = offbench.report(home / "runs", home / "out").absolute()
    page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
    page.goto(path.as_uri())
    frames = "[...document.querySelectorAll('main .wide')].filter(frame => frame.scrollWidth > frame.clientWidth + 1)"
    assert page.evaluate("document.querySelectorAll('#scores thead th').length") == 9
    assert page.evaluate(f"{frames}.map(frame => frame.ariaLabel)") == []
    edges = "[...document.querySelectorAll('#finals figure')].map(f => f.getBoundingClientRect().right)"
    table = "document.querySelector('#scores .wide').getBoundingClientRect().right"
    assert max(page.evaluate(edges)) == pytest.approx(page.evaluate(table), abs=1)  # figures use the page's width


def test_tables_fit_on_a_printed_page(browser: Any, home: Path) -> None:
    made_grid(home / "runs", envs=("hopper", "walker2d"), seeds=2, levels=2)
    path = offbench.report(home / "runs", home / "out").absolute()
    # the page within its margins at 96 dots an inch: A4 across less 12 mm left and right
    page = browser.new_context(viewport={"width": 1032, "height": 703}, color_scheme="dark").new_page()
    page.goto(path.as_uri())
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 1032
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator("nav").is_hidden()
    assert page.locator("#runs h2").is_hidden()  # its table is closed
    page.emulate_media(media="screen")
    page.locator("#runs summary").click()
    page.emulate_media(media="print")
    assert page.locator("#runs h2").is_visible()
    assert page.locator("#runs td").first.is_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_on_its_ground(browser: Any, home: Path, scheme: str) -> None:
    """Contrast of at least 4.5 to 1 (WCAG AA) of ink, small print and links on page, card and mark."""
    made_grid(home / "runs", seeds=2, levels=1)
    path = offbench.report(home / "runs", home / "out").absolute()
    page = browser.new_context(color_scheme=scheme).new_page()
    page.goto(path.as_uri())

    def luminance(name: str) -> float:
        script = "name => getComputedStyle(document.documentElement).getPropertyValue(name).trim()"
        text = page.evaluate(script, name).lstrip("#")
        assert len(text) in (3, 6), text
        text = text if len(text) == 6 else "".join(2 * digit for digit in text)
        parts = [int(text[i : i + 2], 16) / 255 for i in (0, 2, 4)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for ink in ("--ink", "--soft", "--accent"):
        for ground in ("--paper", "--card", "--mark"):
            low, high = sorted((luminance(ink), luminance(ground)))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, ground)


def test_hostile_names_do_not_run(browser: Any, home: Path) -> None:
    hostile_runs(home / "runs")
    path = offbench.report(home / "runs", home / "out").absolute()
    page, messages, requests = opened(browser, path, "wide")
    page.locator("#scores button[data-box]").first.click()
    assert page.locator("dialog[open]").count() == 1
    assert page.evaluate("typeof hacked") == "undefined"
    assert messages == []
    assert requests == [path.as_uri()]


def test_a_script_that_got_in_would_not_run(browser: Any, home: Path) -> None:
    """The second fence: the page's own policy refuses every script but its own."""
    made_grid(home / "runs", seeds=1, levels=1)
    path = offbench.report(home / "runs", home / "out").absolute()
    path.write_text(path.read_text().replace("</main>", "<script>hacked = 1</script></main>"))
    page, messages, _ = opened(browser, path, "wide")
    assert page.evaluate("typeof hacked") == "undefined"
    assert any("Content Security Policy" in message for message in messages)
