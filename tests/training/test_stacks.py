"""Many runs of one command: over processes, to a deadline, with one that diverges."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import offbench
from offbench.benchmarks.benchmark import benchmark
from offbench.cli.main import main
from offbench.common import checkpoints
from offbench.common.errors import OffbenchError
from offbench.training import registry
from offbench.training.devices import pick_machine
from offbench.training.jobs import run_jobs, train_job
from offbench.training.registry import load_algorithm
from offbench.training.run import Run
from offbench.training.spec import Job, RunSpec, configurations
from offbench.training.train import Training
from tests.made_datasets import episode, foreign

SMALL: dict[str, Any] = {"hidden": (16, 16), "batch_size": 32}
TIMES: dict[str, Any] = {"eval_every": 100, "eval_episodes": 2}


def specs(
    dataset: str, runs: str, seeds: int, times: tuple[int, int], algorithm: str = "bdb", **settings: Any
) -> list[RunSpec]:
    """Specs of seeds 0, 1, ...; `times` are steps and eval_every."""
    (config,) = configurations(load_algorithm(algorithm).Config, {"hidden": (16, 16), "batch_size": 32} | settings, "")
    folder = Path(runs) / (algorithm + "-".join(f"{key}={value}" for key, value in settings.items()))
    return [RunSpec(algorithm, config, dataset, seed, *times, 2, folder / str(seed)) for seed in range(seeds)]


def jobs_of(specs: list[RunSpec], processes: int, stack: int | str = "auto") -> list[Job]:
    return Training(specs, pick_machine("cpu", processes, stack, "float32")).jobs


def finish(jobs: list[Job]) -> None:
    for job in jobs:
        assert train_job(job, lambda step, note: None) == []


@pytest.mark.slow
def test_two_processes_train_what_one_does(medium: str) -> None:
    """A stack of three against stacks of two and one: the same bits."""
    one = offbench.train("bdb", medium, steps=200, runs="one", seeds=[0, 1, 2], workers=1, **SMALL, **TIMES)
    two = offbench.train("bdb", medium, steps=200, runs="two", seeds=[0, 1, 2], workers=2, **SMALL, **TIMES)
    for a, b in zip(map(Run, one), map(Run, two), strict=True):
        assert a.policy_path.read_bytes() == b.policy_path.read_bytes()
        assert a.evaluations_path.read_bytes() == b.evaluations_path.read_bytes()


def test_a_deadline_within_a_training_changes_no_file(medium: str, home: Path) -> None:
    whole, stopped = (specs(medium, runs, 2, (400, 400)) for runs in ("whole", "stopped"))
    finish(jobs_of(whole, 1))
    for step in (100, 200, 300, 400):
        finish([replace(job, deadline=0.0) for job in jobs_of(stopped, 1)])  # which is checked every 100 updates
        assert all(checkpoints.steps(spec.folder)[0] == step for spec in stopped)
    for one, other in zip(whole, stopped, strict=True):
        for name in ("evaluations.csv", "losses.csv", "policy.safetensors", "checkpoint-000000400.safetensors"):
            assert (one.folder / name).read_bytes() == (other.folder / name).read_bytes(), name


def test_runs_are_grouped_for_the_processes_and_by_size(medium: str) -> None:
    def sizes(count: int, processes: int, stack: int | str = "auto") -> list[int]:
        return [len(job.specs) for job in jobs_of(specs(medium, "runs", count, (100, 100)), processes, stack)]

    assert sizes(5, 1) == [5]
    assert sizes(5, 2) == [3, 2]
    assert sizes(1, 8) == [1]
    assert sizes(20, 1) == [7, 7, 6]  # at most 8 of them in one process
    assert sizes(20, 2) == [5, 5, 5, 5]  # three stacks would leave a process idle at the end
    assert sizes(4, 1, stack=3) == [2, 2]
    with pytest.raises(OffbenchError, match="stack must be auto or a whole number"):
        sizes(4, 1, stack=0)


def test_what_cannot_differ_within_a_stack_makes_stacks_of_its_own(medium: str) -> None:
    where = (medium, "runs")
    mixed = specs(*where, 2, (100, 100), beta=0.5) + specs(*where, 1, (100, 100), beta="adaptive")
    mixed += specs(*where, 2, (100, 100), critics=3) + specs(*where, 1, (100, 100), algorithm="td3_bc")
    mixed += specs(*where, 1, (200, 100), beta=0.25)
    assert [len(job.specs) for job in jobs_of(mixed, 1)] == [3, 2, 1, 1]


def test_another_environment_makes_a_stack_of_its_own(medium: str, home: Path) -> None:
    """The same shapes, another time limit: evaluations and references must not be mixed up."""
    shutil.copytree(home / "minari" / medium, home / "minari" / "longer-v0")
    path = home / "minari" / "longer-v0" / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    spec = json.loads(metadata["eval_env_spec"]) | {"max_episode_steps": 500}
    path.write_text(json.dumps(metadata | {"eval_env_spec": json.dumps(spec), "dataset_id": "longer-v0"}))
    both = specs(medium, "runs", 2, (100, 100)) + specs("longer-v0", "longer", 1, (100, 100))
    assert [{spec.dataset for spec in job.specs} for job in jobs_of(both, 1)] == [{medium}, {"longer-v0"}]


@pytest.mark.parametrize(("processes", "evaluators"), [(1, 0), (4, 3)])
def test_one_job_has_the_other_processes_for_its_evaluations(
    medium: str, processes: int, evaluators: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[Job] = []
    monkeypatch.setattr("offbench.training.jobs.train_job", lambda job, _: trained.append(job) or [])
    assert run_jobs([Job(tuple(specs(medium, "runs", 2, (100, 100))), "cpu")], processes) == []
    assert [job.workers for job in trained] == [evaluators]


def test_a_job_that_resumes_has_the_same_runs_as_before(medium: str) -> None:
    """Of two stacks of two, one is done: the other is not split to fill the processes."""
    runs = specs(medium, "runs", 4, (200, 100))
    finish(jobs_of(runs, 2)[:1])
    (job,) = jobs_of(runs, 2)
    assert [spec.seed for spec in job.specs] == [2, 3]


def test_a_run_that_diverges_is_marked_and_the_others_continue(medium: str) -> None:
    common: dict[str, Any] = {"runs": "runs", "seeds": [0, 1], "workers": 1, **SMALL, **TIMES}
    calm = offbench.train("td3_bc", medium, steps=300, **common | {"runs": "calm"})
    bad, good = offbench.train("td3_bc", medium, steps=100, **common)
    newest = bad / "checkpoint-000000100.safetensors"
    tensors = load_file(newest)
    tensors["critic.flat"] *= 1e30  # as a run that is about to overflow
    save_file(tensors, newest, metadata={"offbench": '{"step": 100}'})
    with pytest.raises(
        OffbenchError, match=r"seed-0: critic.*became NaN or infinite by step 200; its last checkpoint is kept"
    ):
        offbench.train("td3_bc", medium, steps=300, **common)
    assert checkpoints.steps(bad) == [100]
    assert Run(bad).evaluations().keys() == {100}
    ours, theirs = (load_file(run / "checkpoint-000000300.safetensors") for run in (calm[1], good))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    with pytest.raises(OffbenchError, match="seed-0 diverged earlier and is skipped"):
        offbench.train("td3_bc", medium, steps=300, **common)


def test_several_networks_in_one_command(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--steps", "2", "--eval-every", "2", "--eval-episodes", "1", "--workers", "1"]
    main(["train", "bc", "--dataset", medium, *words, "--hidden", "8,8", "16x16", "--runs", "my runs"])
    out, err = capsys.readouterr()
    folders, hint = out.splitlines(), err.splitlines()[-1]
    assert [Run(Path(folder)).config().settings["hidden"] for folder in folders] == [[8, 8], [16, 16]]
    main(shlex.split(hint.removeprefix("next: offbench ")))  # as it can be pasted
    assert "bc (hidden=16x16)" in capsys.readouterr().out


def test_any_number_of_settings_has_a_folder(medium: str) -> None:
    settings = {"alpha": 3.0, "discount": 0.98, "tau": 0.01, "policy_noise": 0.3, "noise_clip": 0.4, "policy_freq": 3}
    settings |= {"actor_learning_rate": 0.001, "critic_learning_rate": 0.001, "normalize": False, "beta": "adaptive"}
    settings |= {"beta_scope": "batch", "critics": 3}
    settings |= {"beta_max": 0.5, "beta_learning_rate": 0.001, "penalty_actions": 3, "critic_penalty": "cql"}
    settings["penalty_weight"] = [2.0, 3.0]
    more: dict[str, Any] = {"steps": 2, "eval_every": 2, "eval_episodes": 1, "workers": 1, **SMALL, **settings}
    folders = offbench.train("bdb_plus", medium, **more)
    assert len(set(folders)) == 2
    assert all(len(part.encode()) <= 255 for folder in folders for part in folder.parts)
    variants = [Run(folder).config().variant for folder in folders]
    assert ["penalty_weight=2," in variants[0], "penalty_weight=3," in variants[1]] == [True, True]
    assert offbench.train("bdb_plus", medium, **more) == folders  # finished already
    found = offbench.compare(*[f"bdb_plus/{folder.parent.name}" for folder in folders])
    assert "penalty_weight=2" in found.a
    assert "penalty_weight=3" in found.b


def test_data_without_an_environment_are_trained_on_and_that_is_said(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign("house-v0", [episode(40, 0, True), episode(40, 1, True)])
    main(["train", "bc", "--dataset", "house-v0", "--steps", "2", "--eval-every", "2", "--hidden", "8,8"])
    out, err = capsys.readouterr()
    assert "house-v0 names no environment" in err
    assert "normalize" not in out
    assert "give one: `offbench evaluate runs/house-v0/bc/hidden=8x8/seed-0 --env ENV`" in err


def test_each_run_of_a_stack_has_the_mean_of_its_own_updates(medium: str) -> None:
    """One run was stopped at step 100, between two rows of losses.csv; the training of the other ended there."""

    def train(folder: str, together: bool) -> list[Path]:
        stopped, other = specs(medium, folder, 2, (400, 400))
        finish([replace(job, deadline=0.0) for job in jobs_of([stopped], 1)])
        finish(jobs_of([replace(other, steps=100)], 1))
        for group in [[stopped, other]] if together else [[stopped], [other]]:
            finish(jobs_of(group, 1))
        return [spec.run.losses_path for spec in (stopped, other)]

    for one, alone in zip(train("stack", True), train("alone", False), strict=True):
        assert one.read_bytes() == alone.read_bytes()
        assert [row["step"] for row in Run(one.parent).losses()][-1] == 400


def test_an_ensemble_of_numbers_is_checked_for_nan(medium: str) -> None:
    """A learned part may have tensors [ensemble, runs], without further axes."""
    from offbench.training.datasets import load_datasets
    from offbench.training.stack import Stack

    stack_specs = specs(medium, "runs", 2, (10, 10))
    stack = Stack(load_algorithm("bdb"), stack_specs, load_datasets(stack_specs), "cpu")
    stack.tensors = lambda: {"actor.scale": torch.tensor([[1.0, 2.0], [3.0, float("nan")]])}  # type: ignore[method-assign]
    assert stack.diverged() == {1: "actor.scale"}


def test_arguments_of_other_natural_types_are_taken(medium: str, home: Path) -> None:
    (home / "mine.py").write_text("from offbench.algos.bc import BC\nclass Mine(BC): pass\n")
    seeds: Any = np.array(3)
    device: Any = torch.device("cpu")
    times: dict[str, Any] = {
        "steps": 10,
        "eval_every": 10,
        "eval_episodes": 1,
        "workers": np.int64(1),
        "stack": np.int64(1),
    }
    (folder,) = offbench.train(home / "mine.py", medium, seeds=seeds, device=device, **times, **SMALL)
    assert folder.name == "seed-3"
    text = '["tiny-medium-v0"]\nsteps = 10\neval_episodes = 1\n[[algorithms]]\nname = "bc"\nhidden = [8]\n'
    (home / "grid.toml").write_text(f"datasets = {text}")
    assert benchmark(home / "grid.toml", budget=600, say=lambda line: None)
    assert offbench.normalize(env="hopper", returns=1234.5) == offbench.normalize(env="hopper", returns=[1234.5])
    many: Any = "many"
    with pytest.raises(OffbenchError, match="workers must be a whole number from 1 to 1,000, not 'many'"):
        offbench.train("bc", medium, workers=many)
    for wrong in (None, 5, json):
        with pytest.raises(OffbenchError, match=r"an algorithm is a name, a file .* or a class, not"):
            offbench.train(wrong, medium)  # type: ignore[arg-type]
    with pytest.raises(OffbenchError, match=r"a budget is a time like 9m, 1.5h or 90s, not \[1\]"):
        benchmark(home / "grid.toml", budget=[1])  # type: ignore[arg-type]


def test_an_algorithm_that_only_the_parent_process_can_import_is_unknown(
    medium: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(registry.USER_ALGORITHMS_VARIABLE, '{"Mine": "gone_module:Mine"}')
    with pytest.raises(OffbenchError, match="unknown algorithm 'Mine'"):
        offbench.train("Mine", medium)


def test_numpys_numbers_are_numbers(medium: str) -> None:
    beta: Any = np.linspace(0.25, 0.75, 2)
    times: dict[str, Any] = {"steps": np.int64(20), "eval_every": np.int32(10), "eval_episodes": 1}
    wide: dict[str, Any] = {"hidden": np.array([8, 8]), "batch_size": np.int64(4), "workers": 1}
    folders = offbench.train("bdb", medium, beta=beta, seeds=np.arange(1), **times, **wide)
    configs = [json.loads((folder / "config.json").read_text()) for folder in folders]
    assert [config["settings"]["beta"] for config in configs] == [0.25, 0.75]
    assert configs[0]["settings"]["hidden"] == [8, 8]
    assert configs[0]["steps"] == 20
