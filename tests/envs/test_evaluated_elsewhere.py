"""`train --env`: a dataset whose own environment is gone, or that names none, is evaluated in the user's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import offbench
from offbench.cli.main import main
from offbench.common.errors import OffbenchError
from offbench.data import minari_store
from offbench.training.run import Run

SMALL: dict[str, Any] = {
    "steps": 4,
    "eval_every": 2,
    "eval_episodes": 1,
    "hidden": (8,),
    "batch_size": 4,
    "workers": 1,
}


@pytest.fixture
def pendulum() -> str:
    """The id of a small dataset with references."""
    return offbench.collect("inverted-pendulum", "random", steps=200, workers=1)


def change(name: str, **changes: Any) -> None:
    path = minari_store.path_of(name) / "data" / "metadata.json"
    metadata = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in metadata.items() if value is not None}))


def gone(name: str) -> None:
    """Let a dataset name an environment that today's Gymnasium cannot make."""
    spec = json.loads(minari_store.read_metadata(name)["env_spec"])
    spec |= {"id": "HalfCheetah-v2", "entry_point": "gymnasium.envs.mujoco.half_cheetah:HalfCheetahEnv"}
    change(name, env_spec=json.dumps(spec), eval_env_spec=None)


def test_a_dataset_whose_environment_is_gone_is_evaluated_in_the_users(pendulum: str) -> None:
    gone(pendulum)
    with pytest.raises(OffbenchError, match=r"cannot make its environment.*--env RECIPE"):
        offbench.train("bc", pendulum, **SMALL)
    (folder,) = offbench.train("bc", pendulum, env="inverted-pendulum", **SMALL)
    assert sorted(Run(folder).evaluations()) == [2, 4]
    config = json.loads((folder / "config.json").read_text())
    assert config["env_id"] == "InvertedPendulum-v5"
    assert config["references"]["dataset"] is None  # they are of the environment that is gone
    evaluated = offbench.evaluate(folder, episodes=1, workers=1)  # the run names its environment itself
    assert evaluated.env_id == "InvertedPendulum-v5"


def test_a_dataset_without_an_environment_is_evaluated_where_one_is_given(
    pendulum: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change(pendulum, env_spec=None, eval_env_spec=None)
    (folder,) = offbench.train("bc", pendulum, **SMALL | {"hidden": (4,)})
    assert Run(folder).evaluations() == {}
    assert "names no environment" in capsys.readouterr().err
    words = ["--steps", "2", "--eval-every", "2", "--eval-episodes", "1", "--hidden", "8", "--workers", "1"]
    main(["train", "bc", "--dataset", pendulum, "--env", "inverted-pendulum", *words])
    assert "names no environment" not in capsys.readouterr().err
    (row,) = offbench.normalize()
    assert row["score"] is not None  # the dataset's own references, of the environment that the user names


def test_another_environment_is_another_run(pendulum: str, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text('env_id = "InvertedPendulum-v5"\n[env_kwargs]\nmax_episode_steps = 50\n')
    offbench.train("bc", pendulum, **SMALL)
    with pytest.raises(OffbenchError, match="was evaluated in another environment"):
        offbench.train("bc", pendulum, env=str(tmp_path / "short.toml"), **SMALL | {"steps": 6})
    with pytest.raises(OffbenchError, match=r"has observations \(4,\).*--env RECIPE"):
        offbench.train("bc", pendulum, env="hopper", runs=tmp_path / "other", **SMALL)


def test_a_run_stays_with_its_environment_or_without_one(pendulum: str, home: Path) -> None:
    change(pendulum, env_spec=None, eval_env_spec=None)
    longer = SMALL | {"steps": 6}
    offbench.train("bc", pendulum, **SMALL)
    with pytest.raises(
        OffbenchError, match=r"evaluated in another environment .*\(none, not .*the same --env as before"
    ):
        offbench.train("bc", pendulum, env="inverted-pendulum", **longer)
    offbench.train("bc", pendulum, **longer)
    offbench.train("bc", pendulum, env="inverted-pendulum", runs="evaluated", **SMALL)
    with pytest.raises(OffbenchError, match=r"evaluated in another environment .*, not none\)"):
        offbench.train("bc", pendulum, runs="evaluated", **longer)
    (run,) = offbench.train("bc", pendulum, env="inverted-pendulum", runs="evaluated", **longer)
    assert sorted(Run(run).evaluations()) == [2, 4, 6]
