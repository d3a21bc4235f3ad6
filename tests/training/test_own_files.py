"""An algorithm from a file or a class, and runs whose algorithm's code has changed since."""

from __future__ import annotations

import importlib
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.analysis.results import read_results
from offbench.cli.main import main
from offbench.common import code_hash
from offbench.common.code_hash import describe_changes
from offbench.common.errors import OffbenchError
from offbench.reports.tables import score_table
from offbench.training import registry, source_code
from offbench.training.restore import restore
from offbench.training.run import Run
from offbench.training.source_code import code_of
from tests.commands import refusal
from tests.conftest import ROOT, forget_modules
from tests.made_runs import made_run

DATA = "pendulum-small-v0"
TIMES: dict[str, Any] = {"steps": 20, "eval_every": 10, "eval_episodes": 1, "workers": 1}
WORDS = ["--dataset", DATA, "--eval-every", "10", "--eval-episodes", "1", "--hidden", "8,8", "--batch-size", "16"]
EXAMPLE = (ROOT / "docs" / "examples" / "awac.py").read_text()


@pytest.fixture(autouse=True)
def _alone(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test a dataset, and the source code of no algorithm."""
    shutil.copytree(ROOT / "tests" / "fixtures" / "earlier" / "minari", home / "minari")
    monkeypatch.setattr(source_code, "_codes", {})


def again(home: Path) -> None:
    """Forget what a process knows of own algorithms, as a new process does."""
    registry._user_algorithms.clear()
    source_code._codes.clear()
    forget_modules(home)
    shutil.rmtree(home / "__pycache__", ignore_errors=True)


def test_the_documented_example_has_at_most_60_lines() -> None:
    assert len(EXAMPLE.splitlines()) <= 60


def test_a_file_trains_resumes_and_reports(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "awac.py").write_text(EXAMPLE)
    main(["train", "./awac.py:AWAC", *WORDS, "--steps", "20", "--runs", "whole"])
    for steps in ("10", "20"):
        main(["train", "awac.py", *WORDS, "--steps", steps, "--temperature", "1.0"])
    whole, pieces = (Run(next(Path(root).rglob("config.json")).parent) for root in ("whole", "runs"))
    assert whole.policy_path.read_bytes() == pieces.policy_path.read_bytes()
    assert whole.losses_path.read_bytes() == pieces.losses_path.read_bytes()
    assert pieces.folder == Path("runs") / DATA / "AWAC" / "batch_size=16,hidden=8x8" / "seed-0"
    again(home)
    del os.environ[registry.USER_ALGORITHMS_VARIABLE]
    said = refusal(["evaluate", str(pieces.folder), "--similarity"], capsys)
    assert "unknown algorithm 'AWAC'" in said
    assert "for a file of your own, give --algorithm ./FILE.py:CLASS" in said
    main(["evaluate", str(pieces.folder), "--similarity", "--algorithm", "awac.py"])
    assert (pieces.folder / "similarity.json").exists()
    with pytest.raises(OffbenchError, match="is a run of AWAC, not of bdb"):
        restore(pieces, "bdb")
    capsys.readouterr()
    main(["normalize"])
    assert "AWAC" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["train", "./awac.py", "--help"])
    assert "exp(advantage / temperature)" in capsys.readouterr().out


@pytest.mark.slow
def test_worker_processes_and_grids_have_it_too(home: Path) -> None:
    folder = home / "mine"
    folder.mkdir()
    (folder / "awac.py").write_text(EXAMPLE)
    (folder / "grid.toml").write_text(
        f'datasets = ["{DATA}"]\nseeds = 2\nsteps = 20\neval_every = 20\neval_episodes = 1\n'
        '[[algorithms]]\nname = "./awac.py:AWAC"\nhidden = [[8], [8, 8]]\nbatch_size = 16\n'
    )
    main(["benchmark", "mine/grid.toml", "--workers", "2", "--stack", "1"])
    assert len(list((home / "runs").rglob("policy.safetensors"))) == 4


def test_a_class_trains_and_one_that_others_cannot_import_in_this_process(home: Path) -> None:
    from offbench.algos.bc import BC

    class Local(BC):
        pass

    for seeds, algorithm, name in ((0, BC, "bc"), ((0, 1), Local, "Local")):
        runs = offbench.train(
            algorithm, DATA, seeds=seeds, hidden=(8,), batch_size=16, stack=1, **TIMES | {"workers": 2}
        )
        assert {run.parts[-3] for run in runs} == {name}
        assert all(Run(run).evaluations().keys() == {10, 20} for run in runs)


MISTAKES = {
    "nothing.py:AWAC": "no algorithm file nothing.py",
    "awac.py:ABAC": "awac.py has no algorithm 'ABAC'; name one: awac.py:AWAC",
    "two.py": "two.py has several algorithms; name one: two.py:One or :Two",
    "none.py": "none.py has no algorithm",
    "my-algo.py": "rename the file to what Python can import",
    "json.py": "Python has another module 'json'; rename the file",
}


@pytest.mark.parametrize("reference", MISTAKES)
def test_mistakes_are_one_line(reference: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "awac.py").write_text(EXAMPLE)
    (home / "two.py").write_text("from offbench.algos.bc import BC\nclass One(BC): pass\nclass Two(BC): pass\n")
    for name in ("none", "my-algo", "json"):
        (home / f"{name}.py").write_text("")
    assert MISTAKES[reference] in refusal(["train", reference, *WORDS], capsys)


@pytest.mark.parametrize(
    ("text", "error"), [("class AWAC(:\n", "SyntaxError"), ("raise SystemExit(3)", "SystemExit: 3")]
)
def test_a_file_that_does_not_import_shows_its_line(
    text: str, error: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "awac.py").write_text(text)
    with pytest.raises(SystemExit):
        main(["train", "awac.py", *WORDS])
    said = capsys.readouterr().err
    assert 'awac.py", line 1' in said
    assert said.splitlines()[-1].startswith(f"offbench: awac.py does not import: {error}")


@pytest.mark.parametrize("seeds", ["0", pytest.param("0,1", marks=pytest.mark.slow)])
def test_an_error_shows_the_users_line(seeds: str, home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """In this process, and in a worker process."""
    (home / "awac.py").write_text(EXAMPLE.replace("self.critic.minimize(critic_loss)", "raise ValueError('oh')"))
    with pytest.raises(SystemExit) as exit_:
        main(["train", "awac.py", *WORDS, "--steps", "20", "--seeds", seeds, "--stack", "1", "--workers", "2"])
    assert exit_.value.code == 2
    said = capfd.readouterr().err
    assert "Traceback" in said
    line = EXAMPLE.splitlines().index("        self.critic.minimize(critic_loss)") + 1
    assert f'awac.py", line {line}, in update' in said
    assert "raise ValueError('oh')" in said
    assert "an error in awac: ValueError: oh" in said


def test_an_error_in_one_job_does_not_stop_the_next(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """On a GPU and with one worker, all jobs are trained in one process."""
    (home / "awac.py").write_text(EXAMPLE.replace("self.critic.minimize(critic_loss)", "raise ValueError('oh')"))
    with pytest.raises(SystemExit):
        main(["train", "awac.py", *WORDS, "--steps", "20", "--seeds", "0:3", "--stack", "1", "--workers", "1"])
    said = capfd.readouterr().err
    assert said.splitlines()[-1].endswith("see the traceback above (and 2 more)")
    assert said.count("Traceback") == 1


def test_an_edit_is_noticed_and_a_comment_is_none(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = home / "awac.py"
    file.write_text(EXAMPLE)
    train = ["train", "awac.py", *WORDS, "--steps"]
    main([*train, "10"])
    (run,) = (Run(path.parent) for path in Path("runs").rglob("config.json"))
    assert list(run.config().code) == ["awac.py"]
    again(home)
    file.write_text("# mine\n" + EXAMPLE.replace('"""AWAC: ', '"""My AWAC: ').replace("  # but for a constant", ""))
    main([*train, "20"])
    again(home)
    file.write_text(EXAMPLE.replace("max=100", "max=0.5"))
    before = run.policy_path.read_bytes()
    for steps in ("20", "30"):  # a finished run, and one to resume
        assert (
            "was trained by other code of AWAC: awac.py has changed; delete that run (`train` does with --fresh)"
            in refusal([*train, steps], capsys)
        )
    assert run.policy_path.read_bytes() == before
    main([*train, "20", "--fresh"])
    assert run.policy_path.read_bytes() != before
    assert run.evaluations().keys() == {10, 20}


def test_code_that_fails_at_once_can_be_mended(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A run without a checkpoint starts over with the new code; --fresh deletes nothing for code that fails."""
    file, train = home / "awac.py", ["train", "awac.py", *WORDS, "--steps", "10"]
    broken = EXAMPLE.replace("self.critic.minimize(critic_loss)", "raise ValueError('oh')")
    file.write_text(broken)
    with pytest.raises(SystemExit):
        main(train)
    again(home)
    file.write_text(EXAMPLE)
    main(train)
    again(home)
    (run,) = (Run(path.parent) for path in Path("runs").rglob("config.json"))
    before = run.policy_path.read_bytes()
    assert run.evaluations().keys() == {10}
    for checkpoint in run.folder.glob("checkpoint-*"):  # as run folders are handed over
        checkpoint.unlink()
    file.write_text(EXAMPLE.replace("max=100", "max=0.5"))
    assert "was trained by other code" in refusal(train, capfd)
    again(home)
    file.write_text(broken)
    with pytest.raises(SystemExit):
        main([*train, "--fresh"])
    assert "an error in awac: ValueError: oh" in capfd.readouterr().err
    assert run.policy_path.read_bytes() == before


@pytest.mark.parametrize(("frozen", "message"), [("False", "frozen=True"), ("True", "has no network `actor`")])
def test_a_class_that_lacks_something_is_told_what(
    frozen: str, message: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "mine.py").write_text(
        "from dataclasses import make_dataclass\nfrom offbench.algorithm import Algorithm\n"
        "settings = [('batch_size', int, 16), ('normalize', bool, False)]\n"
        f"Config = make_dataclass('Config', settings, frozen={frozen})\n"
        "class Mine(Algorithm[Config]):\n    Config = Config\n    def setup(self, c): pass\n"
        "    def update(self, batch, noise, phase): return {}\n"
    )
    assert message in refusal(["train", "mine.py", *WORDS[:6], "--steps", "10"], capsys)


def test_an_edit_of_an_imported_neighbor_is_noticed(home: Path) -> None:
    (home / "losses.py").write_text("WEIGHT = 100\n")
    (home / "awac.py").write_text(
        "from losses import WEIGHT\n" + EXAMPLE.replace("from __future__ import annotations\n", "")
    )
    before = code_of(registry.register("awac.py"))
    again(home)
    (home / "losses.py").write_text("WEIGHT = 50\n")
    assert describe_changes(before, code_of(registry.register("awac.py"))) == "losses.py has changed"
    assert describe_changes({}, code_of(registry.register("awac.py"))) == ""  # a run of an earlier version


LAYOUTS = {  # how the file imports a neighbor, and the neighbor
    "import parts.losses": "parts/losses.py",
    "from parts import losses": "parts/losses.py",
    "from parts.losses import WEIGHT": "parts/losses.py",
    "import parts": "parts/__init__.py",
    "from parts.relative import WEIGHT": "parts/losses.py",
    "from parts.absolute import WEIGHT": "parts/losses.py",
    "from losses import WEIGHT  # of a folder beside it, of the same name as another file": "losses.py",
}


@pytest.mark.parametrize("line", LAYOUTS)
def test_an_edit_is_noticed_however_a_neighbor_is_imported(line: str, home: Path) -> None:
    (home / "parts").mkdir()
    (home / "offbench" / "algos").mkdir(parents=True)  # as in a clone
    for name in ("losses.py", "parts/losses.py", "parts/__init__.py", "offbench/__init__.py", "offbench/algos/bc.py"):
        (home / name).write_text("WEIGHT = 1\n")
    (home / "parts" / "relative.py").write_text("from . import losses\nWEIGHT = losses.WEIGHT\n")
    (home / "parts" / "absolute.py").write_text("from parts.losses import WEIGHT\n")
    (home / "my_algo.py").write_text(f"import torch\n{line}\nfrom offbench.algos.bc import BC\nclass Mine(BC): pass\n")
    before = code_of(registry.register("my_algo.py"))
    assert before.keys() <= {"bc.py", "my_algo.py", "losses.py", *(f"parts/{p.name}" for p in home.glob("parts/*.py"))}
    again(home)
    (home / LAYOUTS[line]).write_text("WEIGHT = 2\n")
    assert describe_changes(before, code_of(registry.register("my_algo.py"))) == f"{LAYOUTS[line]} has changed"


def test_files_of_a_package_that_are_no_python_of_today_are_hashed_all_the_same(home: Path) -> None:
    """A package without __init__.py, with a template and a file in another encoding."""
    (home / "space").mkdir()
    (home / "space" / "algo.py").write_text("from offbench.algos.bc import BC\nclass Mine(BC): pass\n")
    (home / "space" / "template.py").write_text("print 'hello {{ name }}'\n")
    (home / "space" / "latin.py").write_bytes("# -*- coding: latin-1 -*-\nNAME = 'é'\n".encode("latin-1"))
    (home / "unrelated.py").write_text("")
    sys.path.insert(0, str(home))
    algorithm = importlib.import_module("space.algo").Mine
    files = {"bc.py", "space/algo.py", "space/template.py", "space/latin.py"}
    before = code_of(registry.register(algorithm))
    assert set(before) == files
    source_code._codes.clear()
    (home / "space" / "template.py").write_text("print 'goodbye {{ name }}'\n")
    assert describe_changes(before, code_of(registry.register(algorithm))) == "space/template.py has changed"


def test_an_edit_of_a_package_and_another_version_are_noticed(home: Path) -> None:
    """Installed or editable: a package's files are hashed where Python finds them."""
    package = home / "mypackage"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "parts.py").write_text("X = 1\n")
    (package / "algo.py").write_text("from offbench.algos.bc import BC\nclass Mine(BC): pass\n")
    info = home / "mypackage-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mypackage\nVersion: 1.0\n")
    (info / "top_level.txt").write_text("mypackage\n")
    (info / "entry_points.txt").write_text("[offbench.algos]\nmine = mypackage.algo:Mine\n")
    (info / "RECORD").write_text("mypackage/__init__.py,,\n")
    script = "import json; from offbench.training.source_code import code_of; print(json.dumps(code_of('mine')))"

    def code() -> dict[str, str]:
        environment = os.environ | {"PYTHONPATH": str(home)}
        found = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        )
        return dict(json.loads(found.stdout))

    before = code()
    assert set(before) == {
        "bc.py",
        "mypackage/__init__.py",
        "mypackage/algo.py",
        "mypackage/parts.py",
        "version of mypackage",
    }
    (package / "parts.py").write_text("X = 2\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mypackage\nVersion: 1.1\n")
    assert describe_changes(before, code()) == "mypackage/parts.py has changed, version of mypackage was 1.0, is 1.1"


def test_runs_of_one_script_are_known_by_the_class_alone(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = """
from offbench.algos.bc import BC
from offbench.training.source_code import code_of
from offbench.training.registry import register

class Mine(BC):
    {}

print(code_of(register(Mine)))
"""
    found = []
    for body in ("pass", "pass  # a comment", "x = 1"):
        (home / "script.py").write_text(text.format(body))
        runpy.run_path("script.py", run_name="__main__")
        found.append(capsys.readouterr().out)
    assert "Mine" in found[0]
    assert "bc.py" in found[0]
    assert found[0] == found[1] != found[2]


def test_no_file_that_a_run_folder_names_is_imported(home: Path) -> None:
    (run,) = offbench.train("td3_bc", DATA, hidden=(8, 8), batch_size=16, **TIMES)
    (home / "evil.py").write_text("raise SystemExit('imported')")
    path = run / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"algorithm": "./evil.py:TD3BC"}))
    with pytest.raises(OffbenchError, match="unknown algorithm"):
        restore(Run(run))


def test_two_algorithms_of_one_name_are_refused(home: Path) -> None:
    for name in ("one", "two"):
        (home / f"{name}.py").write_text("from offbench.algos.bc import BC\nclass Mine(BC): pass\n")
    registry.register("one.py")
    with pytest.raises(OffbenchError, match="two algorithms are named 'Mine', in one and two"):
        registry.register("two.py")
    (home / "three.py").write_text("from offbench.algos.bc import BC\nclass cql(BC): pass\n")
    with pytest.raises(OffbenchError, match="an algorithm of a package is named 'cql' too"):
        registry.register("three.py")


def test_tables_mark_a_cell_of_different_code(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs of earlier versions, which name no code, count as the same."""
    for number, codes in enumerate((["a", "a", ""], ["a", "b", ""])):
        for seed, code in enumerate(codes):
            run = made_run(home / str(number), "hopper-medium-v0", "bdb", "default", seed, 50.0)
            config = json.loads(run.config_path.read_text())
            run.config_path.write_text(json.dumps(config | {"code": {"bdb.py": code} if code else {}}))
        made_run(home / str(number), "hopper-medium-v0", "bdb", "beta=0.5", 0, 50.0)  # another variant, of no code
        table = score_table(read_results(home / str(number)))
        assert ("§" in table.rows[0][2].text) == bool(number)
        assert ("§" in table.rows[0][3].text) == bool(number)
        assert any("trained by different code" in note for note in table.notes) == bool(number)
        for seed in range(3):
            made_run(home / str(number), "hopper-medium-v0", "bc", "default", seed, 50.0)
        for words in (["normalize"], ["compare", "bdb", "bc"]):
            main([*words, "--runs", str(home / str(number))])
            said = "note: the runs of bdb" in (text := capsys.readouterr().out)
            assert said == ("trained by different code" in text) == bool(number)


F_STRINGS = """
def update(x, width):
    '''Docstrings do not count.'''
    print(f"{x!r:>{width}} {{}}", rf'\\{x:{width}.3}' "plain")  # nor comments
    return f'''{x + 1
    } and {f"{x}"}'''
"""


def test_the_hash_of_f_strings_is_the_same_in_all_versions_of_python() -> None:
    """Python 3.12 and later split f-strings into tokens. The hash is of the tokens that Python 3.11 makes of it."""
    tokens = ["def", "update", "(", "x", ",", "width", ")", ":", "", "    ", ""]
    tokens += ["print", "(", 'f"{x!r:>{width}} {{}}"', ",", r"rf'\{x:{width}.3}'", '"plain"', ")", ""]
    tokens += ["return", "f'''{x + 1\n    } and {f\"{x}\"}'''", "", ""]
    assert list(code_hash._tokens(F_STRINGS)) == tokens
