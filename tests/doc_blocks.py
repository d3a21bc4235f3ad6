"""The blocks of a Markdown page, and how each is tried.

A page's blocks run in their order in one fresh folder, with no other set-up:

    ```sh                             each command in bash; `\\` at a line's end goes on
    ```python                         as a script
    ```toml title="grid.toml"         written to that file (any language with a title)

A comment in the line before a block says otherwise:

    <!-- not run: needs a GPU -->     a reason of REASONS
    <!-- part of examples/x.py -->    shown, and there word for word

`offbench train` without --steps is an hours' training: it is stopped with Ctrl-C after its first evaluation.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
LANGUAGES = ("sh", "python", "toml", "text", "bibtex", "slurm", "math")
REASONS = (
    "CI itself runs it",
    "tests/test_packaging.py installs the wheel",
    "tests/data/test_interop.py runs this page",
    "needs a Slurm cluster",
    "needs a Ray cluster",
    "needs a GPU",
    "takes days",
    "takes hours",
    "needs other MuJoCo versions",
    "needs d3rlpy's environment and the runs above",
    "reads the run files of a clone",
    "needs a renderer",
    "needs D4RL's files",
    "another library's code",
    "changes your shell",
    "downloads from another server",
    "uploads to another server",
)
LONGEST = 600.0  # seconds that a command may take: several times as long as any does
FENCE = re.compile(
    r"(?:^<!-- (?P<note>.*?) -->\n)?^```(?P<language>\w*) ?(?P<info>.*)\n(?P<content>(?s:.*?))^```$", re.M
)


@dataclass(frozen=True)
class Block:
    """One fenced block.

    Attributes:
        note: the comment before it, or "".
        title: the file it is to be written to, or "".
    """

    page: str
    language: str
    title: str
    note: str
    content: str

    @property
    def reason(self) -> str:
        """Why it is not run; "" if it is."""
        return self.note.removeprefix("not run: ") if self.note.startswith("not run: ") else ""

    @property
    def runs(self) -> bool:
        """Whether it is commands or a script that are tried."""
        return self.language in ("sh", "python") and not self.title and not self.note


def pages() -> list[Path]:
    """README and all pages of docs/."""
    return [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """Return a page's fenced blocks."""
    found = []
    for match in FENCE.finditer(page.read_text()):
        title = re.search(r'title="(.*?)"', match["info"])
        note = match["note"] or ""
        found.append(Block(page.name, match["language"], title[1] if title else "", note, match["content"]))
    return found


def commands(block: Block) -> list[str]:
    """Return a shell block's commands, comments left out."""
    lines = block.content.replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def run_page(page: Path, home: Path, python: Path) -> int:
    """Run a page's blocks with the programs beside `python`; return how many commands and scripts ran."""
    if any("docs/examples" in block.content for block in blocks(page)):
        # such a page says that it is read in a clone
        hidden = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
        shutil.copytree(DOCS / "examples", home / "docs" / "examples", ignore=hidden)
    environment = dict(os.environ) | {"PATH": f"{python.parent}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    ran = 0
    for block in blocks(page):
        if block.title:
            (home / block.title).write_text(block.content)
        if not block.runs:
            continue
        if block.language == "python":
            (home / "script.py").write_text(block.content)  # as a user would run it: a plain script
            _run([str(python), "script.py"], home, environment)
            ran += 1
            continue
        for command in commands(block):
            if command.startswith("offbench train") and "--steps" not in command and "--help" not in command:
                _run_and_stop(command, home, environment)
            else:
                _run(["bash", "-c", command], home, environment)
            ran += 1
    return ran


def _run(command: list[str], home: Path, environment: dict[str, str]) -> None:
    begun = time.monotonic()
    environment = environment | {"PYTHONFAULTHANDLER": "1"}
    with subprocess.Popen(
        command, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            output, errors = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # Python says where it hangs
            output, errors = process.communicate(timeout=60)
    shown = command[-1] if command[0] == "bash" else (home / "script.py").read_text()
    assert process.returncode == 0, f"{shown}\n{output}\n{errors}"
    print(f"{time.monotonic() - begun:6.1f} s  {shown.splitlines()[0]}")


def _run_and_stop(command: str, home: Path, environment: dict[str, str]) -> None:
    """Start a long training, stop it with Ctrl-C once it has been evaluated, and check what it says."""
    process = subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        cwd=home,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 900
    while process.poll() is None and time.monotonic() < deadline:
        if any(len(path.read_text().splitlines()) > 1 for path in home.glob("runs/*/**/evaluations.csv")):
            break
        time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    try:
        _, errors = process.communicate(timeout=120)
    except subprocess.TimeoutExpired:
        process.kill()
        _, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "rerun the same command to resume" in errors
    print(f"stopped   {command}")


def environment_beside(folder: Path) -> Path:
    """Make a virtual environment that sees all of ours, for pages that install a package; return its Python."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    site = next(folder.glob("lib/python*/site-packages"))
    ours = [path for path in sys.path if path.endswith("site-packages")]
    (site / "ours.pth").write_text("".join(f"import site; site.addsitedir({path!r})\n" for path in ours))
    script = folder / "bin" / "offbench"
    script.write_text(f"#!{python}\nfrom offbench.cli.main import main\n\nmain()\n")
    script.chmod(0o755)
    return python
