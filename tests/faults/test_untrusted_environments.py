"""Environments that a file names are judged by name; code beside the file is imported with --trust alone."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from offbench import collect, train
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.envs.environments import env_spec, make_env, untrusted_env
from offbench.envs.trust import VARIABLE, check_code
from offbench.evaluation import renderer
from offbench.evaluation.evaluate import evaluate, open_policy
from offbench.rollouts.policy import uniform_policy
from offbench.training.run import Run
from tests.commands import refusal
from tests.made_runs import small_run

Cli = Callable[..., subprocess.CompletedProcess[str]]


POLE = json.loads(env_spec("InvertedPendulum-v5"))


OWN = "from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv as Own\n"


OWN += "open('IMPORTED', 'w').close()\n"


def wrapped(entry_point: str, **kwargs: Any) -> dict[str, Any]:
    """Return POLE in a wrapper."""
    return {"additional_wrappers": [{"name": "Wrapper", "entry_point": entry_point, "kwargs": kwargs}]}


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else 0


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"id": "Foo-v0", "entry_point": "own:Own"}, "own:Own"),
    ({"entry_point": "own:Own"}, "own:Own"),  # under the id of a registered one
    ({"id": "Foo-v0", "entry_point": "os:system"}, "os:system"),
    ({"id": "Foo-v0", "entry_point": "gymnasium.envs_of_mine:Own"}, "envs_of_mine"),
    (wrapped("own:Own"), "own:Own"),
    (wrapped("stable_baselines3.common.monitor:Monitor", filename="precious"), "monitor:Monitor"),
    (wrapped("gymnasium.wrappers:RecordVideo", video_folder="x"), "RecordVideo"),
    (wrapped("gymnasium.wrappers.rendering:HumanRendering"), "HumanRendering"),
    (wrapped("gymnasium.wrappers:RescaleAction", min_action=10**400, max_action=1), "10000"),
    ({"kwargs": {"frame_skip": 2_000_000_000}}, "2000000000"),
    ({"kwargs": {"xml_file": "/dev/zero"}}, "/dev/zero"),
    ({"kwargs": {"xml_file": "./fifo"}}, "./fifo"),
    ({"kwargs": {"xml_file": "~root"}}, "~root"),
    ({"kwargs": {"xml_file": "..\\x"}}, "..\\\\x"),
    ({"kwargs": {"env_id": "this:X-v0"}}, "this:X-v0"),  # Gymnasium imports what is before a colon
    ({"kwargs": {"a": nested(20)}}, "nested"),
    ({"kwargs": {"a": [0] * 20_000}}, "too many"),
    ({"kwargs": {"/etc/passwd": 0}}, "/etc/passwd"),
]


NEVER: list[tuple[dict[str, Any], str]] = [  # with --trust neither
    (
        {"id": "Foo-v0", "entry_point": "gymnasium.envs.registration:load_env_creator"},
        "is not a class derived from Env",
    ),
    ({"id": "Foo-v0", "entry_point": "os:system"}, "is not a class derived from Env"),
    ({"id": "Foo-v0", "entry_point": "own"}, "'own' does not have the form module:Class"),
    (wrapped("gymnasium.envs.mujoco.hopper_v5:HopperEnv"), "is not a class derived from Wrapper"),
]


ALLOWED: list[dict[str, Any]] = [
    {},
    {"id": "Foo-v0"},
    {"kwargs": {"frame_skip": 4, "reset_noise_scale": 0.1, "xml_file": "inverted_pendulum.xml"}},
    {"kwargs": {"healthy_z_range": [0.7, float("inf")], "camera": {"distance": 3.0}, "render_mode": None}},
    wrapped("gymnasium.wrappers:RescaleAction", min_action=-1.0, max_action=1.0),
    wrapped("gymnasium.wrappers.common:RecordEpisodeStatistics", buffer_length=100),
]


@pytest.fixture
def own(home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module `own` beside the run that names it; its import leaves a file."""
    (home / "own.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(home))
    return home


def run_of(change: dict[str, Any], folder: Path) -> Path:
    """Write a run whose environment is the pole with a change."""
    run = small_run(folder / "seed-0")
    config = json.loads(run.config_path.read_text()) | {"env_spec": json.dumps(POLE | change)}
    run.config_path.write_text(json.dumps(config))
    uniform_policy(np.array([-3.0], np.float32), np.array([3.0], np.float32), 4, "").save(run.policy_path)
    return run.folder


@pytest.mark.parametrize(("change", "value"), REFUSED)
def test_code_and_arguments_that_a_file_may_not_name(change: dict[str, Any], value: str, own: Path) -> None:
    with pytest.raises(OffbenchError) as refused:
        open_policy(run_of(change, own))
    assert value in str(refused.value)
    assert "--trust" in str(refused.value)
    assert "own" not in sys.modules
    assert not (own / "IMPORTED").exists()


@pytest.mark.parametrize(("change", "value"), NEVER)
def test_what_is_no_class_of_an_environment_is_never_run(
    change: dict[str, Any], value: str, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "1")
    with pytest.raises(OffbenchError, match=value):
        open_policy(run_of(change, own))


@pytest.mark.parametrize("change", ALLOWED)
def test_environments_of_gymnasium_with_plain_arguments(change: dict[str, Any]) -> None:
    check_code(EnvSpec.from_json(json.dumps(POLE | change)))


def test_ones_own_environment_runs_with_trust(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In worker processes too; once the command has ended nothing is trusted any more."""
    run = run_of({"id": "Own-v0", "entry_point": "own:Own"}, own)
    words = ["evaluate", str(run), "--episodes", "2", "--workers", "2"]
    main([*words, "--trust"])
    assert "return" in capsys.readouterr().out
    assert (own / "IMPORTED").exists()
    assert VARIABLE not in os.environ
    assert "own:Own" in refusal(words, capsys)


def test_a_plan_runs_nothing_that_a_dataset_names(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = collect("inverted-pendulum", "random", steps=300, workers=1, dataset_id="own-v0")
    path = own / "minari" / dataset / "data" / "metadata.json"
    spec = json.dumps(POLE | {"id": "Foo-v0", "entry_point": "own:Own"})
    path.write_text(json.dumps(json.loads(path.read_text()) | {"env_spec": spec, "eval_env_spec": spec}))
    (own / "grid.toml").write_text(f'[[datasets]]\nid = "{dataset}"\n[[algorithms]]\nname = "bc"\n')
    assert "own:Own" in refusal(["benchmark", "grid.toml", "--plan"], capsys)
    assert not (own / "IMPORTED").exists()


def test_the_variable_is_for_python(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of({"id": "Own-v0", "entry_point": "own:Own"}, own)
    for value in ("", "0", "false", "no"):
        monkeypatch.setenv(VARIABLE, value)
        with pytest.raises(OffbenchError, match="own:Own"):
            open_policy(run)
    monkeypatch.setenv(VARIABLE, "1")
    assert len(evaluate(str(run), episodes=1, workers=1).returns) == 1


def test_ones_own_recipe_needs_no_trust(own: Path) -> None:
    """It may name any code and file, also where a policy that was handed over is evaluated, or a run is trained."""
    model = own / "model.xml"
    model.write_bytes((Path(gym.envs.mujoco.__file__).parent / "assets" / "inverted_pendulum.xml").read_bytes())
    (own / "mine.toml").write_text(f'env_id = "InvertedPendulum-v5"\n[env_kwargs]\nxml_file = "{model}"\n')
    uniform_policy(np.array([-3.0], np.float32), np.array([3.0], np.float32), 4, "").save(own / "x.safetensors")
    assert len(evaluate("x.safetensors", env="./mine.toml", episodes=1, workers=1).returns) == 1
    dataset = collect("inverted-pendulum", "random", steps=300, workers=1)
    settings: dict[str, Any] = {"hidden": (8,), "batch_size": 4, "eval_episodes": 1, "workers": 1}
    (run,) = train("bc", dataset, env="./mine.toml", steps=2, eval_every=2, **settings)
    assert Run(run).evaluations()


def test_the_next_command_has_the_trust_that_it_needs(
    own: Path, offbench_cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A registration that `collect` has imported is not there in the process of the next command."""
    (own / "own.py").write_text(
        OWN + "import gymnasium\ngymnasium.register('Own-v0', 'own:Own', max_episode_steps=9)\n"
    )
    (own / "mine.toml").write_text('env_id = "own:Own-v0"\n')
    monkeypatch.setenv("PYTHONPATH", f"{own}:{os.environ.get('PYTHONPATH', '')}")
    for env, trust in (("mine.toml", ["--trust"]), ("inverted-pendulum", [])):
        done = offbench_cli("collect", env, "--level", "random", "--steps", "300")
        command = shlex.split(done.stderr.rpartition("next: ")[2])
        assert command[5:] == trust
        done = offbench_cli(*command[1:], "--steps", "2", "--eval-every", "2", "--hidden", "8", "--workers", "1")
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["evaluate", "train"])
def test_files_in_the_working_directory_are_not_imported(command: str, medium: str, home: Path) -> None:
    """Python puts the working directory on the path of a process that it starts with `-c`, as it does for workers."""
    small = ["--hidden", "8", "--batch-size", "4", "--eval-every", "2", "--eval-episodes", "2", "--workers", "2"]
    training = ["train", "bc", "--dataset", medium, "--seeds", "0:2", *small]
    main([*training, "--steps", "2"])
    for module in ("socket", "queue", "secrets", "mujoco", "signal"):
        (home / f"{module}.py").write_text(f"open({str(home / 'RAN')!r}, 'w').close()\nraise SystemExit(module)\n")
    launcher = home / "bin" / "launch.py"  # as the installed script, which is in another folder
    launcher.parent.mkdir()
    launcher.write_text("from offbench.cli.main import main\nif __name__ == '__main__':\n    main()\n")
    run = str(next((home / "runs").rglob("seed-0")))
    evaluation = ["evaluate", run, "--episodes", "4", "--workers", "2"]
    words = evaluation if command == "evaluate" else [*training, "--steps", "4"]
    done = subprocess.run(
        [sys.executable, str(launcher), *words], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert not (home / "RAN").exists()


def test_the_renderer_is_probed_without_the_working_directory(home: Path) -> None:
    (home / "mujoco.py").write_text("open('RAN', 'w').close()\n")
    renderer.working_backend.__wrapped__()
    assert not (home / "RAN").exists()


def test_a_folder_named_like_an_allowed_package_is_not_imported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "gym" / "envs").mkdir(parents=True)
    for name in ("gym/__init__.py", "gym/envs/__init__.py", "gym/envs/evil.py"):
        (home / name).write_text("open('ran', 'w')")
    monkeypatch.syspath_prepend(home)
    spec = json.loads(make_env_spec()) | {"id": "Foo-v0", "entry_point": "gym.envs.evil:X"}
    with pytest.raises(OffbenchError, match=r"it would run gym\.envs\.evil from .*, where it is not installed"):
        untrusted_env(json.dumps(spec), "the run")
    assert not (home / "ran").exists()
    package = home / "gym-0.26.dist-info"  # installed elsewhere, and hidden by that folder
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: gym\nVersion: 0.26\n")
    (home / "site").mkdir()
    package.rename(home / "site" / package.name)
    monkeypatch.setattr(sys, "path", [*sys.path, str(home / "site")])
    with pytest.raises(OffbenchError, match=r"it would run gym\.envs\.evil from .*, where it is not installed"):
        untrusted_env(json.dumps(spec), "the run")
    assert not (home / "ran").exists()


def make_env_spec() -> str:
    from offbench.envs.recipes import load_recipe

    return load_recipe("inverted-pendulum").env_spec()


def test_the_environment_of_a_file_opens_no_window() -> None:
    spec = json.loads(make_env_spec())
    spec["kwargs"] = {"render_mode": "human"}
    env = make_env(json.dumps(spec))
    assert env.render_mode is None
    env.close()


ABSTRACT = {"model_path": "inverted_pendulum.xml", "frame_skip": 2, "observation_space": None}


def spec_of(**changes: Any) -> str:
    return json.dumps(json.loads(gym.spec("InvertedPendulum-v5").to_json()) | changes)


def wrappers(name: str, times: int, **kwargs: Any) -> list[dict[str, Any]]:
    return [{"name": name, "entry_point": f"gymnasium.wrappers.{name}", "kwargs": kwargs}] * times


@pytest.mark.parametrize("mode", ["human", "human_list", "rgb_array_list", "rgb_array", "nonsense", 3])
def test_no_render_mode_of_a_file_is_used(mode: object) -> None:
    env = make_env(spec_of(kwargs={"render_mode": mode}))
    env.reset(seed=0)
    assert env.render_mode is None
    env.close()


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"additional_wrappers": wrappers("stateful_action:RepeatAction", 3, num_repeats=100)}, "1,000,000"),
        ({"additional_wrappers": wrappers("stateful_observation:MaxAndSkipObservation", 4, skip=20)}, "160,000"),
        ({"additional_wrappers": wrappers("stateful_observation:FrameStackObservation", 2, stack_size=300)}, "90,000"),
        ({"entry_point": "gymnasium.envs.registration:Env"}, "not a class derived from"),
        ({"entry_point": "gymnasium:Env"}, "not among the environments"),
        ({"max_episode_steps": True}, "its time limit is True"),
        ({"max_episode_steps": 0}, "its time limit is 0"),
        (
            {"entry_point": "gymnasium.envs.mujoco.mujoco_env:MujocoEnv", "kwargs": ABSTRACT},
            "has no observation_space",
        ),
    ],
)
def test_an_environment_of_a_file_that_is_none_or_never_ends(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(OffbenchError, match=fault):
        untrusted_env(spec_of(**changes), "file")
