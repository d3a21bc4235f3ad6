"""Two methods against each other, with numbers worked out by hand and verdicts that few seeds allow."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import offbench
from offbench.analysis.compare import compare
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from tests.made_runs import made_run


def scores(
    root: Path, algorithm: str, values: list[float], dataset: str = "hopper-medium-v0", variant: str = "default"
) -> None:
    """Write one run a seed; the made runs' own reference is 0 to 100, so a return is a score."""
    for seed, value in enumerate(values):
        made_run(root, dataset, algorithm, variant, seed, 0, returns={30_000: value})


def test_three_seeds_by_hand(home: Path) -> None:
    scores(home / "runs", "td3_bc", [51.0, 52.0, 53.0])
    scores(home / "runs", "bdb", [50.0, 50.0, 50.0], variant="beta=0.5")
    found = offbench.compare("td3_bc", "bdb/beta=0.5")
    # differences 1, 2, 3: see test_statistics.py for the interval and p
    assert (found.statistics.difference.value, found.statistics.standardized, found.statistics.p) == (2.0, 2.0, 0.25)
    assert (found.statistics.difference.low, found.statistics.difference.high) == (1.0, 3.0)
    assert found.chance.value == 1.0  # all nine pairs of runs
    # the interval leaves out 0, as three equal signs always make it; one time in four that is chance
    assert found.verdict == "no evidence of a difference with 3 seeds"


def test_enough_seeds_give_a_verdict(home: Path) -> None:
    for dataset in ("hopper-medium-v0", "hopper-expert-v0"):
        scores(home / "runs", "td3_bc", [55.0, 55.0, 55.0], dataset)
        scores(home / "runs", "cql", [50.0, 50.0, 50.0], dataset)
    # six differences of 5: p = 2 / 64
    assert offbench.compare("td3_bc", "cql").verdict == "td3_bc is better: +5.0 [5.0, 5.0] with 3 seeds on 2 datasets"
    assert offbench.compare("cql", "td3_bc").verdict == "td3_bc is better: +5.0 [5.0, 5.0] with 3 seeds on 2 datasets"
    found = offbench.compare("cql", "td3_bc")
    assert (found.statistics.difference.value, found.statistics.p, found.chance.value) == (-5.0, 2 / 64, 0.0)


def test_only_what_both_have_is_paired(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scores(home / "runs", "td3_bc", [10.0, 20.0, 30.0])
    scores(home / "runs", "td3_bc", [99.0], "hopper-expert-v0")
    scores(home / "runs", "cql", [11.0, 24.0])
    main(["compare", "td3_bc", "cql", "--json"])
    row = json.loads(capsys.readouterr().out)
    assert [(pair["seed"], pair["a"], pair["b"]) for pair in row["pairs"]] == [(0, 10.0, 11.0), (1, 20.0, 24.0)]
    assert (row["difference"], row["unpaired"], row["unfinished"]) == (-2.5, 2, 0)
    # only the paired runs: 10 and 20 against 11 and 24, one of four above
    assert row["probability_of_improvement"] == 0.25
    main(["compare", "td3_bc", "cql"])
    text = capsys.readouterr().out
    assert "note: 2 runs have no partner of the same dataset and seed and are left out" in text
    assert "mean difference             -2.5 [-4.0, -1.0]" in text
    assert text.splitlines()[-1] == "no evidence of a difference with 2 seeds"


def test_the_scores_stand_below_whose_they_are(home: Path) -> None:
    scores(home / "runs", "td3_bc", [51.0, 152.0, 7.0])
    scores(home / "runs", "bdb", [50.0, 50.0], variant="beta=0.5")
    lines = offbench.compare("td3_bc", "bdb/beta=0.5").lines()
    assert lines[2:6] == [
        "dataset           seed  td3_bc  bdb (beta=0.5)  difference",
        "----------------  ----  ------  --------------  ----------",
        "hopper-medium-v0     0    51.0            50.0        +1.0",
        "hopper-medium-v0     1   152.0            50.0      +102.0",
    ]
    assert "note: 1 run has no partner of the same dataset and seed and is left out" in lines


def test_one_seed_is_no_evidence(home: Path) -> None:
    scores(home / "runs", "td3_bc", [90.0])
    scores(home / "runs", "cql", [10.0])
    found = offbench.compare("td3_bc", "cql")
    assert found.verdict == "no evidence of a difference with 1 seed"
    assert "mean difference             +80.0\n" in "\n".join(found.lines())


def test_unequal_training_is_said(home: Path) -> None:
    scores(home / "runs", "td3_bc", [50.0, 50.0])
    for seed in range(2):
        made_run(home / "runs", "hopper-medium-v0", "cql", "default", seed, 0, returns={3000: 40.0})
    text = "\n".join(offbench.compare("td3_bc", "cql").lines())
    assert "evaluated at different steps: td3_bc 1 evaluation, step 30,000; cql 1 evaluation, step 3,000" in text
    assert "no verdict" in text
    assert "note: 2 of the paired runs did not reach their last step" in text


def test_an_algorithm_alone_is_its_default_or_only_variant(home: Path) -> None:
    scores(home / "runs", "cql", [1.0], variant="alpha=1")
    scores(home / "runs", "bdb", [1.0], variant="beta=0.5")
    scores(home / "runs", "bdb", [2.0])
    assert (offbench.compare("cql", "bdb").a, offbench.compare("cql", "bdb").b) == ("cql", "bdb")


def test_a_variant_may_be_named_as_tables_name_it(home: Path) -> None:
    """The adaptive beta is BDB's default: a folder says `default`, a table `bdb (adaptive)`."""
    scores(home / "runs", "td3_bc", [1.0])
    for seed, value in enumerate([2.0, 3.0]):
        beta, returns = {"beta": "adaptive"}, {30_000: value}
        made_run(home / "runs", "hopper-medium-v0", "bdb", "default", seed, 0, settings=beta, returns=returns)
    for name in ("bdb", "bdb (adaptive)", "bdb/default", "bdb/beta=adaptive", "bdb/adaptive", "bdb beta=adaptive"):
        assert compare(name, "td3_bc", runs="runs").a == "bdb (adaptive)"
    assert compare("bdb (adaptive) (30,000 steps)", "td3_bc", runs="runs").a == "bdb (adaptive)"  # a column's heading
    with pytest.raises(
        OffbenchError, match=r"cql has no evaluated runs here; available: 'td3_bc', 'bdb \(adaptive\)'"
    ):
        compare("cql", "td3_bc", runs="runs")


def test_settings_that_a_name_leaves_out_are_noted(home: Path) -> None:
    scores(home / "runs", "td3_bc", [51.0, 52.0], variant="alpha=10")
    scores(home / "runs", "cql", [50.0, 50.0])
    found = compare("td3_bc", "cql")
    assert found.title.startswith("td3_bc against cql")
    assert "note: settings of td3_bc: alpha=10" in found.lines()
    assert found.row()["notes"] == ["settings of td3_bc: alpha=10"]
    assert not compare("td3_bc/alpha=10", "cql").row()["unpaired"]


def test_runs_of_different_settings_in_one_variant_are_said(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As after an edit of a default, which no variant's name has: seeds 0 and 1 are not the same method."""
    for seed, alpha in enumerate((2.5, 5.0)):
        settings = {"alpha": alpha, "hidden": [8]}
        made_run(home / "runs", "x-medium-v0", "td3_bc", "default", seed, 50, settings=settings)
    note = "the runs of td3_bc on x-medium-v0 differ in alpha (2.5 and 5.0)"
    main(["normalize"])
    assert note in " ".join(capsys.readouterr().out.split())
    offbench.report("runs", "out")
    assert note[1:] in (home / "out" / "tables" / "scores.md").read_text().replace("\\", "")
    scores(home / "runs", "cql", [50.0, 50.0], "x-medium-v0")
    assert f"note: {note}" in compare("td3_bc", "cql").lines()


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ("td3bc", "bdb/beta=0.5", "unknown method 'td3bc': did you mean 'td3_bc'?"),
        ("td3_bc", "bdb", "bdb has several variants: give one of 'bdb (beta=0.5)', 'bdb (beta=0.75)'"),
        ("td3_bc", "bdb/beta=0.55", "no method 'bdb/beta=0.55' here: did you mean 'bdb (beta=0.5)'?"),
        ("td3_bc", "td3_bc/default", "are the same method"),
        ("td3_bc", "cql", "share no dataset with a seed in common"),
        ("td3_bc", "bc", "raw returns, which do not average"),
    ],
)
def test_bad_selectors(home: Path, capsys: pytest.CaptureFixture[str], a: str, b: str, message: str) -> None:
    scores(home / "runs", "td3_bc", [1.0])
    scores(home / "runs", "bdb", [1.0], variant="beta=0.5")
    scores(home / "runs", "bdb", [1.0], variant="beta=0.75")
    scores(home / "runs", "cql", [1.0], "hopper-expert-v0")
    scores(home / "runs", "bc", [1.0])
    for algorithm in ("td3_bc", "bc"):
        made_run(home / "runs", "mine-v0", algorithm, "default", 0, 9, references=(None, None))
    with pytest.raises(SystemExit) as stopped:
        main(["compare", a, b])
    assert stopped.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
