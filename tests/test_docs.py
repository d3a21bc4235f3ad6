"""Every command and Python block of README and docs runs, in its order, with no other set-up (see doc_blocks)."""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

import offbench
from offbench.algorithm.interface import Algorithm, Batch, PolicyParts
from offbench.rollouts.policy import ACTIVATIONS, KINDS
from tests.browsers import chromium
from tests.doc_blocks import (
    DOCS,
    LANGUAGES,
    REASONS,
    ROOT,
    Block,
    blocks,
    commands,
    environment_beside,
    pages,
    run_page,
)

PAGES = [page for page in pages() if any(block.runs for block in blocks(page)) and page.name != "interop.md"]
ALL = [block for page in pages() if page.name != "interop.md" for block in blocks(page)]


@pytest.fixture(scope="session")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment of its own for pages that install something."""
    return environment_beside(tmp_path_factory.mktemp("beside") / "env")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_of_the_page_runs(page: Path, home: Path, request: pytest.FixtureRequest) -> None:
    installs = any("pip install ./" in block.content for block in blocks(page) if block.runs)
    python = request.getfixturevalue("beside") if installs else Path(sys.executable)
    expected = sum(1 if b.language == "python" else len(commands(b)) for b in blocks(page) if b.runs)
    assert run_page(page, home, python) == expected


def test_blocks_that_do_not_run_say_why(capsys: pytest.CaptureFixture[str]) -> None:
    left_out = [block for block in ALL if block.reason]
    unknown = {block.reason for block in left_out} - set(REASONS)
    assert not unknown
    assert {block.language for block in ALL} <= set(LANGUAGES)
    for block in ALL:
        assert block.runs or block.title or block.note or block.language not in ("sh", "python"), block
    counts = Counter((block.reason, block.page) for block in left_out)
    with capsys.disabled():
        print(f"\n{sum(block.runs for block in ALL)} blocks of README and docs run; {len(left_out)} do not:")
        for (reason, page), count in sorted(counts.items()):
            print(f"  {count} of {page}: {reason}")


def test_the_protocol_is_told_whole() -> None:
    text = (DOCS / "extending.md").read_text()
    protocol = ["Config", "setup", "noise_spec", "phase", "update", "policy", "learned"]
    assert all(hasattr(Algorithm, name) or name in Algorithm.__annotations__ for name in protocol)
    for name in (*protocol, *Batch._fields, *PolicyParts._fields, *KINDS, *ACTIVATIONS):
        assert re.search(rf"`[^`]*\b{name}\b[^`]*`", text), name


def test_no_command_hides_outside_the_blocks_that_run() -> None:
    command = re.compile(r"^(?: {4,}|\t)\$? ?(?:offbench|make|pip|python) ", re.M)
    for page in (page for page in pages() if page.name != "interop.md"):
        outside = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
        assert not command.search(outside), page.name
    for block in ALL:
        if block.language == "text":
            assert not re.search(r"^\$? ?offbench ", block.content, re.M), block


def test_shown_parts_of_files_are_there_word_for_word() -> None:
    shown = [block for block in ALL if block.note.startswith("part of ")]
    assert shown
    for block in shown:
        assert block.content in (DOCS / block.note.removeprefix("part of ")).read_text(), block


def test_shown_tables_are_those_that_the_report_wrote() -> None:
    shown = 0
    for page in pages():
        for name, table in re.findall(r"^<!-- table of (\S+) -->\n((?:\|.*\n)+)", page.read_text(), re.M):
            written = [line for line in (DOCS / name).read_text().splitlines() if line.startswith("|")]
            assert table.splitlines() == written, f"{page.name}: {name}"
            shown += 1
    assert shown


def test_the_pages_commands_agree_so_that_one_may_go_from_page_to_page() -> None:
    """The same small dataset and the same evaluations everywhere, or the second page would be refused."""
    text = "\n".join(block.content for page in pages() for block in blocks(page) if not block.reason)
    collected = re.findall(r"(?:collect inverted-pendulum --level medium|\"inverted-pendulum\", \"medium\",).*", text)
    assert len(collected) > 5
    assert {re.search(r"steps[ =](\d+)", line)[1] for line in collected} == {"5000"}  # type: ignore[index]
    assert set(re.findall(r"eval.every[ =](\d+)", text)) == {"100"}
    assert "--eval-episodes" not in text


def test_links_lead_somewhere() -> None:
    count = 0
    for page in pages():
        text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)|(?:src|href)=\"([^\"#]+)", text):
            link = target[0] or target[1]
            if re.match(r"https?://", link):
                continue
            assert (page.parent / link).exists(), f"{page.name}: {link}"
            count += 1
    assert count > 20


def test_source_files_named_in_the_pages_exist() -> None:
    named = re.compile(r"(?<![\w/.-])((?:offbench|algos|tests|docs|datasets)/[\w/-]+\.(?:py|toml|md|sh|csv))\b")
    files = {
        (page.name, file) for page in (*pages(), ROOT / "CONTRIBUTING.md") for file in named.findall(page.read_text())
    }
    assert len(files) > 40
    assert not {(page, file) for page, file in files if not (ROOT / file).exists()}


def test_every_public_name_is_in_the_python_reference() -> None:
    named = re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(), re.M)
    for name in named:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name
    assert {f"offbench.{name}" for name in offbench.__all__} <= set(named)


def test_every_page_is_in_the_sites_contents() -> None:
    listed = set(re.findall(r"[\w-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert {page.name for page in DOCS.glob("*.md")} <= listed


def test_ci_calls_the_readmes_two_commands() -> None:
    ci = (ROOT / ".ci" / "run").read_text().splitlines()
    assert {"STEPS=2000 make demo", "make test", "make docs"} <= set(ci)
    assert any(b.content == "make demo\nmake test\n" for b in blocks(ROOT / "README.md"))


def test_the_parser_of_blocks_reads_notes_titles_and_contents(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    first = "```sh\na \\\n  b\n# c\nd\n```\n"
    second = "<!-- not run: needs a GPU -->\n```sh\ne\n```\n"
    page.write_text(f'# x\n\n{first}\n{second}\n```toml title="f.toml"\ng = 1\n```\n')
    one, two, three = blocks(page)
    assert one == Block("page.md", "sh", "", "", "a \\\n  b\n# c\nd\n")
    assert commands(one) == ["a    b", "d"]
    assert (one.runs, two.runs, three.runs) == (True, False, False)
    assert (two.reason, three.title) == ("needs a GPU", "f.toml")


def test_the_readmes_first_screen_is_true() -> None:
    """The badges agree with pyproject.toml, and before the first heading are install, three commands, one picture."""
    text = (ROOT / "README.md").read_text()
    first = text.partition("\n## ")[0]
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = settings["project"]
    versions = [name.rpartition(" ")[2] for name in project["classifiers"] if "Python ::" in name]
    badges = re.findall(r"https://img\.shields\.io/badge/(\S+)-\w+\)", first)
    assert badges == [f"python-{versions[0]}_to_{versions[-1]}", f"license-{project['license']}", "types-mypy_strict"]
    assert project["requires-python"] == f">={versions[0]}"
    assert settings["tool"]["mypy"]["strict"] is True
    install, three = [block for block in blocks(ROOT / "README.md") if block.content in first]
    assert re.fullmatch(r"pip install (-c constraints\.txt \.) +# or: uv pip install \1\n", install.content)
    assert [command.split()[:2] for command in commands(three)] == [
        ["offbench", word] for word in ("collect", "train", "normalize")
    ]
    (picture,) = re.findall(r"!\[[^]]+\]\((docs/results/[^\s)]+)\)", first)
    assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


def test_citation_names_the_version_and_licence() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {project['version']}" in citation
    assert f"license: {project['license']}" in citation


@pytest.fixture
def site() -> Path:
    """The site that `make docs` has built."""
    if not (ROOT / "site" / "index.html").exists():
        pytest.skip("there is no site/: `make docs` builds it")
    return ROOT / "site"


def test_the_site_has_pictures_equations_and_the_reference(site: Path) -> None:
    assert "Hopper-v5 at three levels" in (site / "index.html").read_text()
    equations = (site / "algorithms.html").read_text()
    assert equations.count("<math ") == (DOCS / "algorithms.md").read_text().count("```math") > 10
    assert "```" not in equations
    assert "<mi>&" + "</mi>" not in equations  # what the converter leaves of TeX that it does not know
    assert 'id="offbench.collect"' in (site / "api.html").read_text()


@pytest.mark.slow
def test_the_site_is_searched_without_a_server(site: Path) -> None:
    """It asks no other server for anything either."""
    try:
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1360, "height": 900})
            requests: list[str] = []
            errors: list[str] = []
            page.on("request", lambda request: requests.append(request.url))
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto((site / "algorithms.html").as_uri())
            page.click("input.md-search__input")
            page.keyboard.type("discriminator")
            page.wait_for_selector(".md-search-result__item")
            assert any("Algorithms" in text for text in page.locator(".md-search-result__item").all_inner_texts())
            page.keyboard.press("Escape")
            page.locator("label[title='Switch to dark']").click()
            assert page.get_attribute("body", "data-md-color-scheme") == "slate"
            page.set_viewport_size({"width": 390, "height": 844})
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
            assert not errors
            assert all(url.startswith(("file:", "data:", "blob:", "about:")) for url in requests), requests
    except (ImportError, FileNotFoundError) as missing:
        pytest.skip(str(missing))
