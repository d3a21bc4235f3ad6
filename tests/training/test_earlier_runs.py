"""Runs, policies and datasets written before the code was laid out in packages (commit 057d2b0) stay valid.

tests/fixtures/earlier has a dataset of 60 steps, each algorithm's run after 20 of 40 updates, and the policies and
losses after 40, all written by that commit on one AMD EPYC (AVX-512).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.provenance import hardware
from offbench.rollouts.policy import read_policy_file
from offbench.training.run import find_runs
from tests.conftest import ROOT

EARLIER = ROOT / "tests" / "fixtures" / "earlier"
SETTINGS = {"td3_bc": {}, "bdb": {"beta": "adaptive"}, "cql": {"bc_steps": 10}, "bc": {}}


@pytest.mark.parametrize("algorithm", SETTINGS)
def test_an_earlier_run_resumes_with_the_same_bits(algorithm: str, home: Path) -> None:
    shutil.copytree(EARLIER / "minari", home / "minari")
    shutil.copytree(EARLIER / "runs", home / "runs")
    (run,) = offbench.train(
        algorithm,
        "pendulum-small-v0",
        steps=40,
        eval_every=20,
        eval_episodes=1,
        workers=1,
        hidden=(8, 8),
        batch_size=16,
        **SETTINGS[algorithm],
    )
    config = json.loads((run / "config.json").read_text())
    before = json.loads((EARLIER / "runs" / run.relative_to("runs") / "config.json").read_text())
    assert config["settings"] == before["settings"]
    now, then = (
        read_policy_file(run / "policy.safetensors"),
        read_policy_file(EARLIER / "after" / f"{algorithm}.safetensors"),
    )
    losses = (run / "losses.csv").read_text()
    same = all(hardware()[key] == before["hardware"][key] for key in ("processor", "vectors"))
    for ours, theirs in zip(now.layers, then.layers, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=0 if same else 1e-6)
    if same:
        assert losses == (EARLIER / "after" / f"{algorithm}-losses.csv").read_text()


def test_earlier_runs_are_reported(home: Path) -> None:
    shutil.copytree(EARLIER / "runs", home / "runs")
    rows = offbench.normalize("runs")
    assert {row["algorithm"] for row in rows} == set(SETTINGS)
    assert all(row["steps"] == 20 and row["evaluations"] == 1 for row in rows)
    assert len(find_runs(home / "runs")) == len(SETTINGS)


@pytest.mark.parametrize("method", [["bdb", "--beta", "learned"], ["bdb", "--beta=learned"], ["bdb (learned)"]])
def test_a_learned_beta_trains_bdb_plus(method: list[str], home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(EARLIER / "minari", home / "minari")
    words = "--dataset pendulum-small-v0 --steps 4 --eval-every 2 --eval-episodes 1 --hidden 8,8 --workers 1"
    main(["train", *method, *words.split()])
    assert "--beta learned is an option of bdb_plus, no longer of bdb" in capsys.readouterr().err
    (run,) = find_runs(home / "runs")
    assert (run.config().algorithm, run.config().settings["beta"]) == ("bdb_plus", "learned")


@pytest.mark.parametrize("words", [["--runs", "learned"], ["--beta", "0.5", "--runs", "learned"]])
def test_a_folder_named_learned_trains_bdb(words: list[str], home: Path) -> None:
    shutil.copytree(EARLIER / "minari", home / "minari")
    small = "--dataset pendulum-small-v0 --steps 4 --eval-every 2 --eval-episodes 1 --hidden 8,8 --workers 1"
    main(["train", "bdb", *small.split(), *words])
    (run,) = find_runs(home / "learned")
    assert run.config().algorithm == "bdb"


def test_options_that_bdb_had_train_bdb_plus(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(EARLIER / "minari", home / "minari")
    words = "train bdb --dataset pendulum-small-v0 --steps 4 --eval-every 2 --eval-episodes 1 --hidden 8,8 --workers 1"
    main([*words.split(), "--beta", "adaptive", "--beta-max=0.5", "--critic-penalty", "cql"])
    assert "--beta-max is an option of bdb_plus, no longer of bdb" in capsys.readouterr().err
    (run,) = find_runs(home / "runs")
    config = run.config()
    assert config.algorithm == "bdb_plus"
    assert {"beta": "adaptive", "critic_penalty": "cql", "beta_max": 0.5}.items() <= config.settings.items()


def test_a_run_with_a_removed_setting_is_reported_but_not_resumed(home: Path) -> None:
    shutil.copytree(EARLIER / "minari", home / "minari")
    small = {"eval_every": 2, "eval_episodes": 1, "workers": 1, "hidden": (8, 8)}
    (folder,) = offbench.train("bdb_plus", "pendulum-small-v0", steps=4, **small)
    config = json.loads((folder / "config.json").read_text())
    for value, why in ((10, "cloning_steps = 10, which was removed"), (0, "trained by other code of bdb_plus")):
        config |= {"settings": config["settings"] | {"cloning_steps": value}, "code": {"bdb_plus.py": "0" * 64}}
        (folder / "config.json").write_text(json.dumps(config))
        assert [row["steps"] for row in offbench.normalize()] == [4]
        with pytest.raises(OffbenchError, match=why):
            offbench.train("bdb_plus", "pendulum-small-v0", steps=8, **small)
