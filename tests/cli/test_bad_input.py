"""Bad input: exit code 2 and one line that names the problem and the remedy; never a traceback."""

from __future__ import annotations

import json
import shlex
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.reports.figures import plot_curves
from tests.commands import refusal
from tests.conftest import TINY_RECIPE
from tests.made_datasets import episode, foreign

CASES: dict[str, tuple[str, str]] = {
    # what the user typed: what the line must hold
    "colect hopper": ("unknown command 'colect': did you mean 'collect'?", ""),
    "collect": ("the following arguments are required: ENV", "--help"),
    "collect hoper": ("unknown environment 'hoper': did you mean 'hopper'?", ""),
    "collect xyzzy": ("unknown environment 'xyzzy': available:", "hopper"),
    "collect hopper --level medum": ("unknown level 'medum': did you mean 'medium'?", ""),
    "collect hopper --level 1.5": ("a fraction for --level must be more than 0 and at most 1", "1.5"),
    "collect hopper --level nan": ("unknown level 'nan'", ""),
    "collect hopper --steps ten": ("argument --steps: 'ten' is not a whole number from 1", ""),
    "collect hopper --steps 0": ("argument --steps: '0' is not a whole number from 1", ""),
    "collect hopper --steps 1.5": ("argument --steps: '1.5' is not a whole number", ""),
    "collect hopper --steps inf": ("argument --steps: 'inf' is not a whole number", ""),
    "collect hopper --seed -1": ("argument --seed: '-1' is not a whole number from 0", ""),
    "collect hopper --workers 0": ("argument --workers: '0' is not a whole number from 1", ""),
    "collect hopper --id bad id": ("unrecognized arguments: id", ""),
    "collect hopper --id nodigits": ("'nodigits' is not a dataset id", "-v0"),
    "collect hopper --id ../../etc-v0": ("is not a dataset id", ""),
    "collect hopper --id /tmp/x-v0": ("is not a dataset id", ""),
    "collect hopper --id mine//x-v0": ("is not a dataset id", "mine/name-v0"),
    "collect hopper --policy x.zip --level medium": ("leave out --level and --mix", ""),
    "collect hopper --policy x.zip --accept": ("--accept is about the policy that --level or --mix chooses", ""),
    "collect hopper --mix random": ("--mix takes LEVEL:SHARE", ""),
    "collect hopper --mix random:0.5,expert:0.4": ("must add up to 1, not 0.9", ""),
    "collect hopper --level medium --mix random:0.5,expert:0.5": ("give --level or --mix, not both", ""),
    "collect hopper --mix randm:0.5,expert:0.5": ("unknown level 'randm': did you mean 'random'?", ""),
    "collect hopper --mix medium-expert:0.5,random:0.5": ("--mix takes single levels", ""),
    "collect ./none.toml": ("no recipe file none.toml", ""),
    "collect hopper --flag": ("unrecognized arguments: --flag (see `offbench collect --help`)", ""),
    "train": ("the following arguments are required: ALGO, --dataset", "--help"),
    "train bcd --dataset x-v0": ("unknown algorithm 'bcd': did you mean", ""),
    "train bdb": ("the following arguments are required: --dataset", "`offbench train bdb --help`"),
    "train bdb --dataset x-v0": ("unknown dataset 'x-v0'", "offbench collect"),
    "train bdb --dataset ../x-v0": ("unknown dataset '../x-v0'", ""),
    "evaluate x --similarity --episodes 5": ("--episodes has no effect with --similarity", ""),
    "evaluate x --tolerance 0": ("--tolerance has no effect without --similarity", ""),
    "video hopper:medium --env walker2d": ("hopper:medium names its environment already", "--env"),
    "benchmark smoke --plan --address auto": ("--address has no effect with --plan; leave it out", ""),
    "benchmark smoke --plan --budget 5x": ("--budget has no effect with --plan; leave it out", ""),
    "benchmark smoke --address auto": ("--address needs", "--executor ray"),
    "train bdb --dataset MEDIUM --beta 2": ("bdb: beta must be at most 1, not 2", ""),
    "train bdb --dataset MEDIUM --beta adaptve": ("beta must be a number or adaptive, not 'adaptve'", ""),
    "train bdb --dataset MEDIUM --alpha nan": ("alpha must be a finite number", ""),
    "train bdb --dataset MEDIUM --alpha -1": ("alpha must be at least 0", ""),
    "train bdb --dataset MEDIUM --critics 1": ("critics must be at least 2", ""),
    "train bdb --dataset MEDIUM --critics two": ("critics must be a whole number, not 'two'", ""),
    "train bdb --dataset MEDIUM --hidden 256*256": (
        "hidden must be a list of whole numbers like 256,256 or",
        "256x256",
    ),
    "train bdb --dataset MEDIUM --hidden 256x": ("hidden must be a list of whole numbers like 256,256 or", "256x256"),
    "train bdb --dataset MEDIUM --normalize perhaps": ("normalize must be true or false, not 'perhaps'", ""),
    "train bdb --dataset MEDIUM --beta-scope world": ("beta_scope must be one of sample, batch", ""),
    "train bdb --dataset MEDIUM --seeds 3:3": ("'3:3' contains no seeds", ""),
    "train bdb --dataset MEDIUM --seeds a": ("'a' is not a whole number from 0", ""),
    "train bdb --dataset MEDIUM --seeds 0-3": ("'0-3' is not a whole number from 0; seeds are 3, 0,1,2 or 0:4", ""),
    "train bdb --dataset MEDIUM --seeds 1,1": ("seeds must be different whole numbers", ""),
    "train bdb --dataset MEDIUM --steps 0": ("'0' is not a whole number from 1", ""),
    "train bdb --dataset MEDIUM --eval-every x": ("'x' is not a whole number from 1", ""),
    "train bdb --dataset MEDIUM --device cuda": ("no device cuda: PyTorch", "--device cpu"),
    "train bdb --dataset MEDIUM --device tpu": ("device must be auto, cpu, cuda or cuda:N, not 'tpu'", ""),
    "train bdb --dataset MEDIUM --device cpu:0": ("device must be auto, cpu, cuda or cuda:N, not 'cpu:0'", ""),
    "train td3_bc --dataset MEDIUM --beta 0.5": (
        "unrecognized arguments: --beta (see",
        "`offbench train td3_bc --help`",
    ),
    "train td3_bc --dataset MEDIUM --batchsize 3": (
        "--batchsize: did you mean --batch-size? (see",
        "train td3_bc --h",
    ),
    "train td3_bc --dataset MEDIUM --batchsize=3": ("--batchsize: did you mean --batch-size?", ""),
    "train td3_bc --datset MEDIUM": ("unrecognized arguments: --datset: did you mean --dataset?", ""),
    "train td3_bc --dataset MEDIUM --hidden 64 64": ("hidden takes lists such as 32,32 64,64", "64,64"),
    "--flag collect hopper": ("unrecognized arguments: --flag (see `offbench --help`)", ""),
    "train bdb --dataset DISCRETE": ("actions must be a Box space, not Discrete(2)", ""),
    "train bdb --dataset NAN": ("rewards contain NaN or infinite numbers", ""),
    "train bdb --dataset MEDIUM DISCRETE": ("actions must be a Box space", ""),
    "evaluate nowhere": ("no run or policy file nowhere", ""),
    "evaluate .": ("no run in .", ""),
    "evaluate empty.safetensors": ("not a readable policy file", ""),
    "normalize --runs nowhere": ("no evaluated runs below nowhere", "offbench train"),
    "normalize 100": ("returns need their environment: give --env", ""),
    "normalize --env hopper": ("give the returns to normalize", ""),
    "normalize --env hoper 100": ("did you mean 'hopper'?", ""),
    "normalize --env hopper abc": ("'abc' is not a number", ""),
    "normalize --env hopper nan": ("returns must be finite numbers", ""),
    "normalize --env hopper 1 --steps 5": ("--steps has no effect with --env; leave it out", ""),
    "normalize --env hopper 1 --runs runs": ("--runs has no effect with --env; leave it out", ""),
    "normalize --env hopper 1 --plot x.png": ("--plot has no effect with --env; leave it out", ""),
    "list runs --runs nowhere": ("nowhere is not a folder of runs", ""),
    "list --runs other": ("--runs has an effect only in `offbench list runs`", ""),
    "card x-v0 --huggingface --behaviour-dir behaviour": ("--behaviour-dir has no effect with --huggingface", ""),
    "evaluate x --similarity --tolerance nan": ("tolerances must be finite numbers from 0", ""),
    "normalize --plot curves.gif": ("a figure's name must end in", ".png"),
    "normalize --format html": ("invalid choice: 'html'", ""),
    "list files": ("invalid choice: 'files'", "runs"),
    "report --runs nowhere here": ("no evaluated runs below nowhere, here", "offbench train"),
    "compare td3_bc": ("the following arguments are required: B", "--help"),
    "compare td3_bc cql --runs nowhere": ("no evaluated runs below nowhere", ""),
    "train --tensorboard td3_bc --dataset x-v0": ("unknown dataset 'x-v0'", ""),
    "train --tensorb td3_bc --dataset x-v0": ("--tensorb: did you mean --tensorboard?", ""),
    "train 'bdb (beta=0.5)' --dataset MEDIUM --beta 0.7": ("beta is part of the method's name and of the flags", ""),
    "train 'td3_bc (precision=bfloat16)' --dataset MEDIUM --precision float32": (
        "precision is part of the method",
        "",
    ),
    "train --seeds=0,1 td3_bc --dataset x-v0": ("unknown dataset 'x-v0'", ""),
    "train --dataset x-v0 -- td3_bc": ("unknown dataset 'x-v0'", ""),
    "train td3_bc --dataset MEDIUM --wandb": ("argument --wandb: expected one argument", ""),
    "show x-v0": (
        "unknown dataset 'x-v0'",
        "available: discrete-v0, nan-v0, tiny-medium-v0; record one: `offbench collect ENV --level LEVEL`",
    ),
    "show xyzzy-v0": ("available: discrete-v0, nan-v0, tiny-medium-v0; record one: `offbench collect ENV", ""),
    "show hopper-medium-expert-v0": (
        "hopper-medium-expert-v0 is not recorded yet: `offbench collect hopper --level medium-expert`",
        "",
    ),
    "train td3_bc --dataset hopper-60percent-v0": ("not recorded yet: `offbench collect hopper --level 0.6`", ""),
    "show inverted-pendulum-random-v0": ("`offbench collect inverted-pendulum --level random`", ""),
    "show hopper-medium-v2": ("unknown dataset", "`offbench collect hopper --level medium` records hopper-medium-v0"),
    "show hopper-mediun-v0": ("unknown dataset 'hopper-mediun-v0'", "record one: `offbench collect ENV"),
    "show MEDIM": ("did you mean 'tiny-medium-v0'? Or record one: `offbench collect", ""),
    "show MEDIUM --plot out.gif": ("a figure's name must end in .png, .svg, .pdf, not 'out.gif'", ""),
    "verify": ("the following arguments are required: ID", ""),
    "train bc --dataset empty.safetensors": ("empty.safetensors is a file, not a dataset's id", "import-d4rl"),
    "verify FOLDER": ("is a folder, not a dataset's id", "and give tiny-medium-v0"),
    "verify x-v0": ("unknown dataset 'x-v0'", "offbench collect"),
    "verify MEDIM": ("did you mean 'tiny-medium-v0'?", ""),
    "verify ../MEDIUM": ("unknown dataset '../MEDIUM'", ""),
    "verify /etc": ("unknown dataset '/etc'", ""),
    "verify MEDIUM --episodes -1": ("'-1' is not a whole number from 0", ""),
    "verify MEDIUM --workers 0": ("'0' is not a whole number from 1", ""),
    "verify DISCRETE": ("actions must be a Box space, not Discrete(2)", ""),
    "import-d4rl": ("the following arguments are required: FILE.hdf5, --id", ""),
    "import-d4rl none.hdf5 --id x-v0": ("no file none.hdf5", ""),
    "import-d4rl . --id x-v0": ("no file .", ""),
    "import-d4rl empty.safetensors --id x-v0": ("is not a readable D4RL file", ""),
    "import-d4rl text.hdf5 --id x-v0": ("text.hdf5 is not a readable D4RL file", ""),
    "import-d4rl hopper.hdf5 --id ../x-v0": ("is not a dataset id", ""),
    "import-d4rl hopper.hdf5 --id x": ("'x' is not a dataset id", "-v0"),
    "import-d4rl D4RL --id x-v0": ("cannot tell the environment of file.hdf5", "--env hopper"),
    "import-d4rl D4RL --id x-v0 --env hoper": ("did you mean 'hopper'?", ""),
    "import-d4rl D4RL --id x-v0 --env hopper": ("has 4 observations", "give the right --env"),
    "import-d4rl D4RL --id MEDIUM --env inverted-pendulum": ("tiny-medium-v0 exists already", "--overwrite"),
    "export": ("the following arguments are required: ID, --out", ""),
    "export x-v0 --out out.hdf5": ("unknown dataset 'x-v0'", ""),
    "export MEDIUM --out out.hdf5 --drop-timeouts": ("--drop-timeouts needs an .npz file", ""),
    "export MEDIUM --out .": ("cannot write", ""),
    "export MEDIUM --out empty.safetensors/out.hdf5": ("cannot write", ""),
    "export MEDIUM --out out.csv": ("cannot write 'out.csv'", ".npz"),
    "card MEDIUM": ("is a dataset: give --huggingface", ""),
    "export-policy policy.safetensors --out policy.txt": ("cannot write 'policy.txt'", ".pt or FILE.onnx"),
    "report --out report.html": ("a report is a folder", "--out report"),
    "show mujoco/hopper/medium-v0": ("no local dataset", "`minari download mujoco/hopper/medium-v0`"),
    "train bc --dataset mujoco/hopper/medium-v0": ("no local dataset", "`minari download mujoco/hopper/medium-v0`"),
    "verify mujoco/hopper/medium-v0": ("no local dataset", "`minari download mujoco/hopper/medium-v0`"),
    "train ddpg --dataset MEDIUM": ("unknown algorithm 'ddpg': available: bc", "td3_bc"),
    "plot": ("unknown command 'plot': available: ", "report"),
    "eval": ("did you mean 'evaluate'?", ""),
    "export MEDIUM --out new/out.hdf5": ("cannot write new/out.hdf5: there is no folder new", ""),
    "export-policy policy.safetensors --out new/policy.pt": ("there is no folder new", ""),
    "show MEDIUM --plot new/a.png": ("cannot write new/a.png: there is no folder new", ""),
    "export DISCRETE --out out.hdf5": ("must be a Box space", ""),
    "export-policy nowhere --out policy.pt": ("no run or policy file nowhere", ""),
    "export-policy . --out policy.pt": ("no run in . (no config.json)", ""),
    "export-policy empty.safetensors --out policy.pt": ("not a readable policy file", ""),
    "completion tcsh": ("invalid choice: 'tcsh'", "bash"),
    "behaviour hoper": ("did you mean 'hopper'?", ""),
    "behaviour hopper --steps 12345": ("steps must be a multiple of 10000", ""),
}


@pytest.fixture
def prepared(medium: str, home: Path) -> dict[str, str]:
    discrete = {"actions": np.zeros(3, np.int64)}
    foreign("discrete-v0", [episode(3, 0, True, **discrete)], actions=gym.spaces.Discrete(2))
    foreign("nan-v0", [episode(3, 0, True, rewards=np.array([0.0, np.nan, 1.0]))])
    (home / "empty.safetensors").touch()
    (home / "text.hdf5").write_text("text")
    with h5py.File(home / "file.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((9, 4)), np.zeros((9, 1))
        file["rewards"], file["terminals"] = np.zeros(9), np.zeros(9, bool)
    return {
        "D4RL": "file.hdf5",
        "MEDIUM": medium,
        "FOLDER": f"minari/{medium}",
        "DISCRETE": "discrete-v0",
        "NAN": "nan-v0",
        "MEDIM": "tiny-medum-v0",
    }


@pytest.mark.parametrize("typed", CASES)
def test_bad_words(typed: str, prepared: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal([prepared.get(word, word) for word in shlex.split(typed)], capsys)
    for part in CASES[typed]:
        assert part in line


RECIPES: dict[str, tuple[str, str]] = {
    "unknown key": ('env_id = "Hopper-v5"\nversoin = 3', "unknown key 'versoin': did you mean 'version'?"),
    "unknown sac key": ('env_id = "Hopper-v5"\n[sac]\nlerning_rate = 1', "did you mean 'learning_rate'?"),
    "wrong type": ('env_id = "Hopper-v5"\n[sac]\nsteps = "many"', "steps must be a whole number, not 'many'"),
    "wrong range": ('env_id = "Hopper-v5"\n[sac]\ndiscount = 1.5', "discount must be at most 1"),
    "no env": ("dataset_steps = 5", "missing key 'env_id'"),
    "not TOML": ("env_id = ", "not a readable TOML file"),
    "table": ('env_id = "Hopper-v5"\nsac = 3', "sac must be a table"),
    "name": ('env_id = "Hopper-v5"\nname = "../x"', "name must begin with a letter or digit"),
    "other references": (
        'env_id = "Hopper-v5"\nd4rl_min = 0.0\nd4rl_max = 1000.0',
        "d4rl_min and d4rl_max of Hopper-v5 are -20.272305 and 3234.3 in D4RL",
    ),
    "half a reference": ('env_id = "Hopper-v5"\nd4rl_min = 1.0', "both d4rl_min and d4rl_max"),
    "segment": ('env_id = "Hopper-v5"\n[sac]\nsegment = 30\nenvs = 4', "segment must be a multiple of 4"),
    "nothing to learn in": (
        'env_id = "Hopper-v5"\n[sac]\nsteps = 4000',
        "learning_starts 10,000 leaves none of 4,000 steps",
    ),
    "unknown env": ('env_id = "Hoper-v5"', "cannot make the environment 'Hoper-v5'"),
    "own env": (
        'env_id = "Tank-v0"',
        "doesn't exist. If a module of yours registers it, name it before a colon: my_module:Tank-v0",
    ),
    "version": ('env_id = "Hopper-v9"', "[ `v2`, `v3`, `v4`, `v5` ]"),
    "discrete env": ('env_id = "CartPole-v1"', "actions must be a Box space, not Discrete(2)"),
    "env argument": ('env_id = "Hopper-v5"\n[env_kwargs]\nlegs = 3', "cannot make the environment"),
}


@pytest.mark.parametrize("kind", RECIPES)
def test_bad_recipes(kind: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, message = RECIPES[kind]
    (home / "my.toml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        line = refusal(["behaviour", "./my.toml"], capsys)
    assert message in line
    assert not list(home.glob("behaviour/**/*.safetensors"))


def test_an_existing_id(tiny: tuple[str, str], medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    recipe, behaviour_dir = tiny
    line = refusal(["collect", recipe, "--behaviour-dir", behaviour_dir, "--seed", "5"], capsys)
    assert "tiny-medium-v0 exists already (600 transitions); use --overwrite" in line


def test_more_replay_than_there_is(tiny: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    recipe, behaviour_dir = tiny
    words = ["collect", recipe, "--behaviour-dir", behaviour_dir, "--level", "medium-replay", "--steps", "1000000"]
    assert "use fewer --steps" in refusal(words, capsys)


def test_a_refusing_disk(
    tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A read-only folder, as root meets it in a container: the operating system refuses to make a folder."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(minari_store.Path, "mkdir", refuse)
    line = refusal(["collect", tiny[0], "--behaviour-dir", tiny[1]], capsys)
    assert "cannot write" in line
    assert "Permission denied" in line


def test_a_file_where_a_folder_should_be(
    tiny: tuple[str, str], medium: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "taken").write_text("")
    line = refusal(["train", "bdb", "--dataset", medium, "--runs", "taken", "--steps", "10"], capsys)
    assert "cannot write" in line


def test_a_full_disk_is_seen_before_recording(
    tiny: tuple[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: type("Usage", (), {"free": 10_000})())
    recipe, behaviour_dir = tiny
    line = refusal(["collect", recipe, "--behaviour-dir", behaviour_dir], capsys)
    assert "not enough room" in line
    assert "MINARI_DATASETS_PATH" in line
    assert minari_store.local_ids() == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"entry_point": "os:system", "kwargs": {"command": "touch PWNED"}, "id": "Evil-v0"}, "os:system.*--trust"),
        ({"entry_point": "no_such_module:Env", "id": "Gone-v0"}, "no_such_module:Env.*--trust"),
        ({"id": "Hopper-v5", "entry_point": "gymnasium.envs.mujoco.hopper_v5:HopperEnv"}, "has \\(11,\\) and"),
        (
            {"additional_wrappers": [{"name": "x", "entry_point": "os:system", "kwargs": {"command": "touch PWNED"}}]},
            "os:system.*--trust",
        ),
    ],
)
def test_an_environment_named_by_a_file_is_not_simply_run(
    medium: str, home: Path, change: dict[str, Any], message: str
) -> None:
    path = home / "minari" / medium / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    spec = json.loads(metadata["eval_env_spec"])
    spec = {**spec, "kwargs": {}, **change}
    path.write_text(json.dumps(metadata | {"eval_env_spec": json.dumps(spec)}))
    with pytest.raises(offbench.OffbenchError, match=message):
        offbench.train("td3_bc", medium, steps=10, hidden=(8,))
    assert not (home / "PWNED").exists()


def test_curves_go_into_a_folder_that_is_there(home: Path) -> None:
    with pytest.raises(offbench.OffbenchError, match=r"cannot write new/a\.png: there is no folder new"):
        plot_curves("runs", "new/a.png")
    assert not (home / "new").exists()


def test_a_ladder_never_replaces_other_files(tiny: tuple[str, str], home: Path) -> None:
    (home / "results").mkdir()
    (home / "results" / "thesis.tex").write_text("years of work")
    with pytest.raises(offbench.OffbenchError, match="contains other files"):
        offbench.behaviour(tiny[0], behaviour_dir=tiny[1], out="results")
    assert (home / "results" / "thesis.tex").read_text() == "years of work"


def test_a_ladder_of_another_environment_is_refused(tiny: tuple[str, str], home: Path) -> None:
    (home / "tiny.toml").write_text(TINY_RECIPE + "\n[env_kwargs]\nframe_skip = 4\n")
    with pytest.raises(offbench.OffbenchError, match=r"the recipe is of InvertedPendulum-v5 \{'frame_skip': 4\}"):
        offbench.collect("./tiny.toml", behaviour_dir=tiny[1])
    (home / "tiny.toml").write_text('contact_margin = "sum"\n' + TINY_RECIPE)
    with pytest.raises(
        offbench.OffbenchError, match=r"the recipe is of InvertedPendulum-v5 .*with contact_margin sum"
    ):
        offbench.collect("./tiny.toml", behaviour_dir=tiny[1])


def test_a_share_of_nothing(tiny: tuple[str, str]) -> None:
    with pytest.raises(offbench.OffbenchError, match="leave a part of the mix without transitions"):
        offbench.collect(tiny[0], mix="random:0.01,expert:0.99", steps=10, behaviour_dir=tiny[1])


def test_a_policy_for_another_environment(medium: str, capsys: pytest.CaptureFixture[str]) -> None:
    settings: dict[str, Any] = {"hidden": (8,), "batch_size": 8, "eval_every": 10, "eval_episodes": 1}
    (folder,) = offbench.train("td3_bc", medium, steps=10, **settings)
    assert "has observations (4,)" in refusal(["evaluate", str(folder), "--env", "hopper"], capsys)


def test_a_changed_recipe_is_another_training(tiny: tuple[str, str], home: Path) -> None:
    """The message names what differs, and how to train on."""
    text = Path(tiny[0]).read_text().replace("steps = 2400", "steps = 3200")
    (home / "tiny.toml").write_text(text)
    with pytest.raises(OffbenchError, match=r"sac\.steps 2400, not 3200; .*offbench behaviour ENV --steps N"):
        offbench.behaviour("./tiny.toml", behaviour_dir=tiny[1])


def test_the_suffix_says_what_is_exported(medium: str, home: Path) -> None:
    main(["export", medium, "--out", "arrays.npz"])
    with np.load(home / "arrays.npz", allow_pickle=False) as arrays:
        assert len(arrays["rewards"]) == 600
    main(["export", medium, "--out", "rows.h5"])
    with h5py.File(home / "rows.h5") as file:
        assert len(file["rewards"]) == 600
