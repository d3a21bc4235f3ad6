"""The wheel, installed in a clean environment outside the repository, is all that a user needs."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def shipped() -> set[str]:
    """Everything below datasets/ that a user's install must have."""
    return {
        str(path.relative_to(ROOT))
        for path in (ROOT / "datasets").rglob("*")
        if path.is_file() and path.suffix in (".toml", ".csv", ".json", ".safetensors", ".hdf5", ".md", ".png")
    }


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel and an sdist of the working tree."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(out), str(ROOT)], check=True, capture_output=True)
    return out


@pytest.mark.slow
def test_wheel_and_sdist_carry_recipes_weights_and_algorithms(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    (sdist,) = built.glob("*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert shipped()
    for name in shipped():
        assert f"offbench/{name}" in in_wheel
        assert f"offbench/{name}" in in_sdist
    for folder in ("grids", "reports/assets", "reports/published"):
        for path in (ROOT / "offbench" / folder).iterdir():
            assert f"offbench/{folder}/{path.name}" in in_wheel
            assert f"offbench/{folder}/{path.name}" in in_sdist
    for path in (ROOT / "algos").glob("*.py"):
        assert f"offbench/algos/{path.name}" in in_wheel
    assert not {name for name in in_wheel if name.startswith(("algos/", "datasets/", "tests/"))}


@pytest.mark.slow
def test_a_clean_install_works_outside_the_repository(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", "clean"], check=True, cwd=tmp_path)
    python = tmp_path / "clean" / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt"), str(wheel)]
    subprocess.run(pip, check=True, cwd=tmp_path)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [str(tmp_path / "clean" / "bin" / "offbench")]

    def run(*words: str) -> str:
        done = subprocess.run([*command, *words], capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    listed = run("list")
    assert all(name in listed for name in ("hopper", "walker2d", "halfcheetah", "ant", "bdb", "cql", "td3_bc"))
    run("collect", "inverted-pendulum", "--level", "medium", "--steps", "2000")
    run("train", "bdb", "--dataset", "inverted-pendulum-medium-v0", "--steps", "20", "--eval-every", "10")
    assert "bdb" in run("normalize")
    assert "index.html" in run("report")
    for name in ("algos", "datasets"):
        code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({name!r}) is not None)"
        assert subprocess.run([str(python), "-c", code], cwd=tmp_path, env=environment).returncode == 0, name
