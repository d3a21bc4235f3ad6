"""A grid: what it says, what it costs, how it goes on, and how it is shared."""

from __future__ import annotations

import itertools
import json
import subprocess
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import offbench
from offbench.analysis.methods import find_method
from offbench.analysis.results import read_results
from offbench.benchmarks.benchmark import LocalExecutor, benchmark
from offbench.benchmarks.grid import load_grid, shipped_grids
from offbench.benchmarks.plan import Benchmark, Cost, prepare, shard_of, write_plan
from offbench.benchmarks.throughput import Rate
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.common.settings import fields as settings_of
from offbench.data import minari_store
from offbench.reports.tables import score_table
from offbench.training.registry import load_algorithm
from offbench.training.run import Run, find_runs
from offbench.training.spec import Job
from tests.made_runs import made_run

Cli = Callable[..., subprocess.CompletedProcess[str]]
GRID = """
datasets = ["DATASET"]
seeds = 2
steps = 200
eval_every = 100
eval_episodes = 2

[[algorithms]]
name = "td3_bc"
hidden = [16, 16]
batch_size = 32

[[algorithms]]
name = "bdb"
hidden = [16, 16]
batch_size = 32
beta = [0.5, "adaptive"]
seeds = [7]
steps = 100
"""


@pytest.fixture
def grid(medium: str, home: Path) -> str:
    """A grid file on the tiny dataset: two runs of TD3+BC, two of BDB."""
    (home / "grid.toml").write_text(GRID.replace("DATASET", medium))
    return "./grid.toml"


def silent(_: str) -> None:
    """Take a line of the plan and drop it."""


def plan_lines(bench: Benchmark, shard: tuple[int, int] = (0, 1)) -> list[str]:
    """Return the lines of a plan."""
    lines: list[str] = []
    write_plan(bench, shard, lines.append)
    return lines


@pytest.fixture
def unmeasured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let plans name costs at once instead of measuring them."""
    monkeypatch.setattr(
        "offbench.benchmarks.plan.measure", lambda *_: Rate(updates_per_second=1000.0, bytes_per_run=10**6)
    )
    monkeypatch.setattr("offbench.benchmarks.plan.operations", lambda *_: 1e9)


@pytest.mark.usefixtures("unmeasured")
def test_the_papers_grid_is_its_table() -> None:
    """15 datasets x (TD3+BC, CQL, four BDB) x 5 seeds = 450 runs of a million updates."""
    bench = prepare("paper", workers=1)
    assert sum(map(len, bench.variants)) == 450
    assert {spec.schedule for specs in bench.variants for spec in specs} == {(1_000_000, 5_000, 10)}
    bdb = [f"bdb ({beta})" for beta in ("beta=0.25", "beta=0.5", "beta=0.75", "adaptive")]
    assert [line.partition("  75 runs")[0].strip() for line in plan_lines(bench)[1:7]] == [
        "td3_bc",
        *bdb,
        "cql (eval_samples=10)",
    ]
    assert {source.env for source in bench.grid.datasets} == {"hopper", "halfcheetah", "walker2d"}
    assert {source.level for source in bench.grid.datasets} == set(offbench.inventory()["levels"])


@pytest.mark.usefixtures("unmeasured")
def test_a_plan_does_not_charge_the_updates_that_are_done(grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def total_seconds(costs: list[Cost], _: object) -> list[str]:
        return [str(sum(cost.seconds for cost in costs))]

    monkeypatch.setattr("offbench.benchmarks.plan.step_seconds", lambda _: 1e-4)
    monkeypatch.setattr("offbench.benchmarks.plan._totals", total_seconds)
    seconds = []
    for part in (0, 2):
        for spec in (spec for specs in prepare(grid, workers=1).variants for spec in specs if part):
            spec.folder.mkdir(parents=True)
            (spec.folder / f"checkpoint-{spec.steps // part:09d}.safetensors").touch()
        seconds.append(float(plan_lines(prepare(grid, workers=1))[-1]))
    assert seconds[1] == pytest.approx(seconds[0] / 2)


@pytest.mark.usefixtures("unmeasured")
@pytest.mark.parametrize("name", shipped_grids())
def test_shipped_grids_are_sound_and_their_plan_counts_what_is_left(name: str) -> None:
    bench = prepare(name, workers=2)
    first, *lines = plan_lines(bench)
    runs = sum(map(len, bench.variants))
    datasets = len(bench.grid.datasets)
    words = "1 dataset" if datasets == 1 else f"{datasets} datasets"
    variants = "1 variant" if len(bench.variants) == 1 else f"{len(bench.variants)} variants"
    assert first == f"{name}: {words}, {variants}, {runs} runs, {runs} to train"
    assert any("to record first" in line for line in lines)
    assert "on 2 processes of one thread about" in lines[-2]
    assert "on a GPU: not measured here" in lines[-1]


def test_settings_of_each_dataset_are_one_column(home: Path) -> None:
    """Two entries with one label, on a dataset each: two variants when they train, one method in tables."""
    ids = [offbench.collect("inverted-pendulum", "random", steps=300, workers=1, dataset_id=f"{x}-v0") for x in "ab"]
    text = f"datasets = {ids}\nseeds = 1\nsteps = 20\neval_every = 20\neval_episodes = 1\n"
    for name, rate in zip(ids, ("1e-3", "1e-4"), strict=True):
        text += f'[[algorithms]]\nname = "bc"\nlabel = "tuned"\ndatasets = ["{name[0]}-*"]\nlearning_rate = {rate}\n'
    (home / "grid.toml").write_text(text)
    bench = prepare("./grid.toml", workers=1)
    first, *lines = plan_lines(bench)
    assert first == "grid: 2 datasets, 2 variants, 2 runs, 2 to train"
    assert [line.partition("    1 run x")[0] for line in lines[:2]] == ["  tuned (a-v0)", "  tuned (b-v0)"]
    assert benchmark(bench, say=silent)
    rows = [(row["dataset"], row["method"], row["variant"]) for row in offbench.normalize()]
    assert rows == [("a-v0", "tuned", "learning_rate=0.001"), ("b-v0", "tuned", "learning_rate=0.0001")]
    results = read_results("runs")
    assert score_table(results).header == ["level", "environment", "tuned"]
    assert list(results.scores(find_method(results.methods, "tuned"))) == ids
    (home / "grid.toml").write_text(text.replace("tuned", "tuned again"))
    trained = [run.policy_path.stat().st_mtime_ns for run in find_runs(home / "runs")]
    assert benchmark(prepare("./grid.toml", workers=1), say=silent)
    assert [row["method"] for row in offbench.normalize()] == ["tuned again", "tuned again"]
    assert [run.policy_path.stat().st_mtime_ns for run in find_runs(home / "runs")] == trained


def test_a_finished_grid_is_left_alone_and_its_table_is_of_its_runs(
    grid: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert benchmark(prepare(grid, workers=1), say=silent)
    runs = find_runs(home / "runs")
    assert {(r.config().algorithm, r.config().seed, r.config().steps) for r in runs} == {
        ("td3_bc", 0, 200),
        ("td3_bc", 1, 200),
        ("bdb", 7, 100),
    }
    assert len(runs) == 4
    before = {run.folder: run.policy_path.stat().st_mtime_ns for run in runs}
    made_run(home / "runs", "hopper-medium-v0", "cql", "default", 0, 50)  # of another grid
    main(["benchmark", grid, "--workers", "1"])
    assert {run.folder: run.policy_path.stat().st_mtime_ns for run in runs} == before
    said = capsys.readouterr().out
    assert "4 runs, 0 to train" in said
    assert "bdb" in said.splitlines()[-2]  # the paper's order: td3_bc, cql, bdb
    assert "different steps" in said  # 200 updates and 100
    assert "hopper-medium-v0" not in said


def test_missing_datasets_are_recorded_first(home: Path) -> None:
    text = GRID.replace('"DATASET"', '{id = "mine-v0", env = "inverted-pendulum", level = "random", steps = 500}')
    (home / "grid.toml").write_text(text)
    assert benchmark(prepare("./grid.toml", workers=1), say=silent)
    assert minari_store.read_metadata("mine-v0")["total_steps"] == 500


def test_datasets_without_an_environment_are_evaluated_where_env_says(grid: str, home: Path) -> None:
    (dataset,) = load_grid(grid).datasets
    path = minari_store.path_of(dataset.id) / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"env_spec": None, "eval_env_spec": None}))
    with pytest.raises(OffbenchError, match=f"{dataset.id} names no environment: .*--env RECIPE"):
        benchmark(prepare(grid, workers=1), say=silent)
    main(["benchmark", grid, "--workers", "1", "--env", "inverted-pendulum"])
    assert [run.config().env_id for run in find_runs(home / "runs")] == ["InvertedPendulum-v5"] * 4
    assert all(run.evaluations() for run in find_runs(home / "runs"))


def test_a_budget_stops_cleanly_and_the_same_call_goes_on(grid: str) -> None:
    assert not benchmark(prepare(grid, workers=1), budget="0.001s", say=silent)
    assert benchmark(prepare(grid, workers=1), budget="1h", say=silent)


def test_a_budget_that_ends_before_any_training_begins_ends_the_command(grid: str, offbench_cli: Cli) -> None:
    done = offbench_cli("benchmark", grid, "--budget", "0.001s", "--workers", "2", timeout=100)
    assert done.returncode == 0, done.stderr
    assert "rerun the same command" in done.stderr


def test_the_longest_training_begins_first(grid: str, home: Path) -> None:
    """The grid's BDB runs, last in the file, take a hundred times TD3+BC's updates."""
    text = (home / "grid.toml").read_text()
    (home / "grid.toml").write_text(text.replace("steps = 100\n", "steps = 20000\n"))
    begun: list[int] = []

    class Idle(LocalExecutor):
        def train(self, jobs: Sequence[Job], processes: int) -> list[str]:
            begun.extend(job.first.steps for job in jobs)
            return []

    assert not benchmark(prepare(grid, workers=2), executor=Idle(), say=silent)
    assert begun == sorted(begun, reverse=True)
    assert set(begun) == {200, 20_000}


def test_shards_share_the_runs_and_together_are_the_grid(grid: str, home: Path) -> None:
    """Machines that differ, too: the shares are the grid's, and a run's bits do not depend on its stack."""
    benchmark(prepare(grid, workers=1, runs="whole"), say=silent)
    for place in range(3):
        benchmark(prepare(grid, workers=1 + place, runs="shared"), shard=(place, 3), say=silent)
        counted = len([run for run in find_runs(home / "shared") if run.evaluations()])
        assert counted == (2, 3, 4)[place]  # two runs of each of two variants, dealt to three
    for run in find_runs(home / "whole"):
        other = Run(home / "shared" / run.folder.relative_to(home / "whole"))
        assert run.evaluations() == other.evaluations()
        assert run.policy_path.read_bytes() == other.policy_path.read_bytes()


@pytest.mark.parametrize("count", [2, 7, 16])
def test_shares_of_the_papers_grid_are_even_and_leave_none_out(count: int) -> None:
    bench = prepare("paper", workers=1)
    whole = sorted(spec.folder for specs in bench.variants for spec in specs)
    of_shard = [[spec for share in shard_of(bench, (i, count)) for spec in share] for i in range(count)]
    shares = [[spec.folder for spec in specs] for specs in of_shard]
    assert sorted(folder for share in shares for folder in share) == whole
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    for specs in of_shard:
        of_each = Counter((spec.algorithm, spec.variant) for spec in specs)
        assert len(of_each) == len(bench.variants)  # some of every algorithm
        assert max(of_each.values()) - min(of_each.values()) <= 1


def test_a_recipe_is_found_beside_its_grid_then_from_here(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "mine").mkdir()
    text = GRID.replace('"DATASET"', '{id = "tank-v0", env = "tank.toml"}, {id = "pool-v0", env = "envs/pool.toml"}')
    (home / "mine" / "grid.toml").write_text(text)
    (home / "mine" / "tank.toml").touch()
    (home / "tank.toml").touch()
    assert [source.env for source in load_grid("mine/grid.toml").datasets] == ["mine/tank.toml", "envs/pool.toml"]
    monkeypatch.chdir("mine")
    assert load_grid("grid.toml").datasets[0].env == "tank.toml"


def test_layers_may_be_written_as_folders_name_them(grid: str, home: Path) -> None:
    (home / "grid.toml").write_text((home / "grid.toml").read_text().replace("[16, 16]", '"16x16"'))
    assert {specs[0].config.hidden for specs in prepare(grid, workers=1).variants} == {(16, 16)}


BAD: dict[str, tuple[str, str]] = {
    "no TOML": ("datasets = [", "not a readable TOML file"),
    "no datasets": ('datasets = []\n[[algorithms]]\nname = "bc"', "datasets must be a list"),
    "no algorithms": ('datasets = ["a-v0"]', "algorithms must be a list"),
    "unknown key": ('datasets = ["a-v0"]\nstep = 3\n[[algorithms]]\nname = "bc"', "did you mean 'steps'"),
    "bad seeds": (
        'datasets = ["a-v0"]\nseeds = [1, 1]\n[[algorithms]]\nname = "bc"',
        "seeds must be a count up to 100,000 or a list",
    ),
    "half a seed": (
        'datasets = ["a-v0"]\nseeds = 1.5\n[[algorithms]]\nname = "bc"',
        "seeds must be a count up to 100,000 or a list",
    ),
    "seeds on a day": (
        'datasets = ["a-v0"]\nseeds = 2026-01-01\n[[algorithms]]\nname = "bc"',
        "seeds must be a count up to 100,000 or a list",
    ),
    "a seed too many": (
        'datasets = ["a-v0"]\nseeds = 1000000000000\n[[algorithms]]\nname = "bc"',
        "seeds must be a count up to 100,000 or a list",
    ),
    "a number of 5000 digits": (f'datasets = ["a-v0"]\nsteps = {"1" * 5000}', "not a readable TOML file"),
    "no seeds": (
        'datasets = ["a-v0"]\nseeds = 0\n[[algorithms]]\nname = "bc"',
        "seeds must be a count up to 100,000 or a list",
    ),
    "bad steps": ('datasets = ["a-v0"]\nsteps = 0\n[[algorithms]]\nname = "bc"', "steps must be at least 1"),
    "bad id": ('datasets = ["a"]\n[[algorithms]]\nname = "bc"', "is not a dataset id"),
    "twice": ('datasets = ["a-v0"]\n[[algorithms]]\nname = "bc"\n[[algorithms]]\nname = "bc"', "is listed twice"),
    "dataset twice": ('datasets = ["a-v0", "a-v0"]\n[[algorithms]]\nname = "bc"', "a dataset is listed twice"),
    "dataset of another grid": (
        'datasets = ["a-v0"]\n[[algorithms]]\nname = "bc"\ndatasets = ["b-*"]',
        "bc: no dataset of this grid matches 'b-*'; there are a-v0",
    ),
    "no list of datasets": (
        'datasets = ["a-v0"]\n[[algorithms]]\nname = "bc"\ndatasets = "a-*"',
        "datasets must be a list",
    ),
    "twice on one dataset": (
        'datasets = ["a-v0", "b-v0"]\n[[algorithms]]\nname = "bc"\n[[algorithms]]\nname = "bc"\ndatasets = ["b-v0"]',
        "is listed twice",
    ),
    "no name": ('datasets = ["a-v0"]\n[[algorithms]]\nbeta = 1', "needs a name"),
    "unknown algorithm": ('datasets = ["a-v0"]\n[[algorithms]]\nname = "td3bc"', "did you mean 'td3_bc'"),
    "unknown setting": ('datasets = ["a-v0"]\n[[algorithms]]\nname = "bdb"\nbta = 1', "did you mean 'beta'"),
    "bad level": (
        'datasets = [{id = "a-v0", env = "hopper", level = "medim"}]\n[[algorithms]]\nname = "bc"',
        "'medium'",
    ),
    "unknown source": ('datasets = ["strange-v0"]\n[[algorithms]]\nname = "bc"', "strange-v0"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_grid_is_one_line(fault: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, message = BAD[fault]
    (home / "grid.toml").write_text(text)
    with pytest.raises(SystemExit) as end:
        main(["benchmark", "./grid.toml"])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["papr"], "did you mean 'paper'"),
        (["./nothing.toml"], "no grid file"),
        (["smoke", "--budget", "9"], "a budget is a time"),
        (["smoke", "--budget=-9m"], "a budget must be positive"),
        (["smoke", "--shard", "3"], "not a part I/N such as 0/4"),
        (["smoke", "--shard", "9/2", "--plan"], "a part is I/N with I from 0 to N-1, not 9/2"),
        (["smoke", "--stack", "0"], "whole number from 1"),
    ],
)
def test_bad_words_are_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["benchmark", *words])
    assert end.value.code == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_a_shard_beyond_the_last_is_refused(grid: str) -> None:
    with pytest.raises(OffbenchError, match="a shard is i/n"):
        benchmark(prepare(grid, workers=1), shard=(2, 2), say=silent)


@pytest.mark.parametrize(
    ("text", "env", "level"),
    [
        ("hopper-medium-replay-v0", "hopper", "medium-replay"),
        ("inverted-pendulum-60percent-v0", "inverted-pendulum", "0.6"),
        ("hopper-medium-v2", "", ""),  # D4RL's: ours has another version
        ("hopper-12p5percent-v0", "hopper", "0.125"),
        ("D4RL/hopper/medium-v2", "", ""),
    ],
)
def test_an_id_tells_how_it_is_recorded(text: str, env: str, level: str, home: Path) -> None:
    (home / "grid.toml").write_text(f'datasets = ["{text}"]\n[[algorithms]]\nname = "bc"')
    (source,) = load_grid("./grid.toml").datasets
    assert (source.env, source.level) == (env, level)


def test_a_run_that_diverged_before_is_said_and_left_alone(grid: str, home: Path) -> None:
    assert benchmark(prepare(grid, workers=1), say=silent)
    run = find_runs(home / "runs")[0]
    run.mark_diverged(100, "critic.flat")
    said: list[str] = []
    assert benchmark(prepare(grid, workers=1), say=said.append)
    assert (
        said[-1] == f"{run.folder.relative_to(home)} diverged earlier and is skipped; delete it to train the run again"
    )


def test_a_list_is_a_variant_for_each_value_of_any_setting(tmp_path: Path) -> None:
    """Also of settings that runs of one stack cannot differ in; a list that is one value stays one."""
    grid = tmp_path / "grid.toml"
    settings = (
        'beta = [0.5, "adaptive"]\nbatch_size = [16, 32]\nhidden = [[8, 8], [16]]\ndiscriminator_hidden = [4, 4]'
    )
    grid.write_text(f'datasets = ["hopper-medium-v0"]\n[[algorithms]]\nname = "bdb"\n{settings}')
    configs = [specs[0].config for specs in prepare(str(grid)).variants]
    assert {(config.beta, config.batch_size, config.hidden) for config in configs} == set(
        itertools.product((0.5, "adaptive"), (16, 32), ((8, 8), (16,)))
    )
    assert {config.discriminator_hidden for config in configs} == {(4, 4)}


def test_help_lists_the_words_that_a_setting_may_be(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["train", "bdb", "--help"])
    assert stopped.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    for name, field in settings_of(load_algorithm("bdb").Config).items():
        if words := field.metadata["choices"]:
            assert f"({' | '.join(words)}; default: {field.default})" in said, name
    assert "(default: 256,256)" in said
