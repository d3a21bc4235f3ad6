"""`offbench video`: the videos where MuJoCo can render, the error messages everywhere."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from offbench.common.errors import OffbenchError
from offbench.envs.environments import env_spec
from offbench.envs.recipes import recipes_folder
from offbench.evaluation import renderer, video
from tests.commands import refusal

Cli = Callable[..., subprocess.CompletedProcess[str]]
POLICY = next((recipes_folder() / "inverted-pendulum" / "behaviour" / "policies").glob("*.safetensors"))


@pytest.fixture(scope="module")
def draws() -> None:
    """Skip where MuJoCo cannot render."""
    if renderer.working_backend() is None:
        pytest.skip("neither EGL nor OSMesa works here: no video was recorded")


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as film:
        frames = []
        for place in range(film.n_frames):
            film.seek(place)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    return frames


@pytest.mark.usefixtures("draws")
def test_a_gif_shows_the_episode_with_step_and_return(offbench_cli: Cli, home: Path) -> None:
    words = ("--seconds", "1", "--fps", "10", "--size", "120", "--out", "film.gif")
    done = offbench_cli("video", str(POLICY), *words)
    assert done.returncode == 0, done.stderr
    frames = frames_of(home / "film.gif")
    # 25 steps a second in InvertedPendulum (dt 0.04): every 2nd is drawn, the first and the last too
    assert [frame.shape for frame in frames] == [(120, 120, 3)] * 14
    assert np.abs(frames[0][:20] - frames[-1][:20]).max() > 100  # the text has changed
    assert frames[0].std() > 10  # something is drawn
    assert not list(home.glob(".film*"))


@pytest.mark.usefixtures("draws")
def test_an_mp4_is_a_film_of_its_frames(home: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: no mp4 was recorded")
    made = video.video("inverted-pendulum:expert", out="film.mp4", episodes=2, seconds=0.8, fps=25, size=96)
    frames, seconds = ffmpeg.count_frames_and_secs(str(made))
    assert frames == 21  # 20 steps and the first frame: --seconds counts for the whole film
    assert seconds == pytest.approx(21 / 25, abs=0.05)


@pytest.mark.usefixtures("draws")
def test_an_mp4_that_lacks_frames_is_an_error(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the disk is full when the encoder writes the end; an earlier video stays."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: no mp4 was recorded")
    made = video.video(POLICY, out="film.mp4", seconds=0.4, size=64)
    before, write = made.read_bytes(), ffmpeg.write_frames

    def generator(path: str, *words: object, **options: object) -> object:
        inner = write(path, *words, **options)

        class Cut:
            def send(self, frame: object) -> None:
                inner.send(frame)

            def close(self) -> None:
                inner.close()
                os.truncate(path, Path(path).stat().st_size // 2)

        return Cut()

    monkeypatch.setattr(ffmpeg, "write_frames", generator)
    with pytest.raises(OffbenchError, match=r"film.mp4: the encoder wrote \d+ of \d+ frames"):
        video.video(POLICY, out="film.mp4", seconds=0.6, size=64)
    assert made.read_bytes() == before
    assert not list(home.glob(".film*"))


@pytest.mark.parametrize("fps", [12.5, 30.0, 48.0])
def test_a_gif_runs_in_real_time(fps: float, home: Path) -> None:
    frames = [Image.new("RGB", (8, 8), (index, 0, 0)) for index in range(60)]
    video._gif(home / "x.gif", iter(frames), fps)
    durations = []
    with Image.open(home / "x.gif") as film:
        for index in range(film.n_frames):
            film.seek(index)
            durations.append(film.info["duration"])
    assert sum(durations) == pytest.approx(1000 * 60 / fps, abs=10)
    assert min(durations) >= 20


@pytest.mark.usefixtures("draws")
def test_a_gif_has_no_frames_that_browsers_slow_down(home: Path) -> None:
    """Hopper takes 125 steps a second: more than 50 frames would be less than 0.02 s each."""
    made = video.video("hopper:random", out="film.gif", seconds=0.4, fps=125, size=64)
    with Image.open(made) as film:
        assert film.info["duration"] >= 20


@pytest.mark.usefixtures("draws")
def test_a_film_of_a_run_plays_its_environment(medium: str, home: Path) -> None:
    import offbench

    (run,) = offbench.train("bc", medium, steps=2, eval_every=2, eval_episodes=1, hidden=(8,), workers=1)
    made = video.video(run, out=home / "run.gif", seconds=0.2, size=64)
    assert len(frames_of(made)) == 6


def test_without_a_renderer_the_packages_are_named(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    monkeypatch.setattr(video, "working_backend", lambda: None)
    with pytest.raises(OffbenchError, match=r"libegl1 .*libosmesa6"):
        video.video(POLICY, out="film.gif")
    assert not (home / "film.gif").exists()


def test_a_backend_that_cannot_draw_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    monkeypatch.setattr(renderer, "BACKENDS", ("no-such-one",))
    assert renderer.working_backend.__wrapped__() is None


def test_the_users_choice_of_backend_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with renderer.rendering_with("egl"):
        assert os.environ["MUJOCO_GL"] == "egl"
    assert os.environ["MUJOCO_GL"] == "glfw"
    monkeypatch.delenv("MUJOCO_GL")
    with renderer.rendering_with("osmesa"):
        pass
    assert "MUJOCO_GL" not in os.environ


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["hopper:medium", "--out", "film.avi"], ".gif or .mp4"),
        (["hopper:medium-expert", "--out", "a.gif"], "not of one policy"),
        (["hopper:medium-replay", "--out", "a.gif"], "not of one policy"),
        (["hopper:mediun", "--out", "a.gif"], "did you mean 'medium'"),
        (["hoper:medium", "--out", "a.gif"], "did you mean 'hopper'"),
        (["./swimmer.toml:medium", "--out", "a.gif"], "no ladder"),
        (["nothing", "--out", "a.gif"], "no run or policy file"),
        ([str(POLICY), "--out", "new/a.gif"], "cannot write new/a.gif: there is no folder new"),
        ([str(POLICY), "--env", "hopper", "--out", "a.gif"], "--env RECIPE"),
        ([str(POLICY), "--seconds", "0", "--out", "a.gif"], "more than 0"),
        ([str(POLICY), "--seconds", "nan", "--out", "a.gif"], "finite"),
        ([str(POLICY), "--seconds", "inf", "--out", "a.gif"], "finite"),
        ([str(POLICY), "--fps", "0", "--out", "a.gif"], "whole number from 1"),
    ],
)
def test_bad_input_is_one_line(words: list[str], text: str, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "swimmer.toml").write_text('env_id = "Swimmer-v5"')
    assert text in refusal(["video", *words], capsys)
    assert not list(home.glob("*.gif"))


TANK = """
import gymnasium as gym
import numpy as np


class Tank(gym.Env):
    def __init__(self, **options):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,))
        self.action_space = gym.spaces.Box(-3.0, 3.0, (1,))
        MODE

    def reset(self, *, seed=None, options=None):
        return np.zeros(4, np.float32), {}

    def step(self, action):
        return np.zeros(4, np.float32), 0.0, False, False, {}


gym.register("Tank-v0", "tank:Tank", max_episode_steps=5)
"""


@pytest.mark.parametrize("mode", ["assert not options, options", "self.render_mode = options.get('render_mode')"])
def test_an_environment_that_does_not_draw_is_one_line(mode: str, home: Path, offbench_cli: Cli) -> None:
    (home / "tank.py").write_text(TANK.replace("MODE", mode))
    (home / "tank.toml").write_text('env_id = "tank:Tank-v0"\n')
    done = offbench_cli("video", str(POLICY), "--env", "./tank.toml")
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("offbench: Tank-v0 cannot be rendered")
    if "render_mode" in mode:
        assert line.endswith("it has no rgb_array rendering")
    assert not list(home.glob("*.gif"))


@pytest.mark.parametrize(
    ("failure", "remedy"),
    [
        ("raise gym.error.DependencyNotInstalled('run `pip install pygame`')", "pip install pygame"),
        ("import no_such_renderer", "no_such_renderer"),
        ("raise RuntimeError", "RuntimeError"),
    ],
)
def test_an_environment_without_its_renderer_is_one_line(
    failure: str, remedy: str, home: Path, offbench_cli: Cli
) -> None:
    code = TANK.replace("MODE", "self.render_mode = options.get('render_mode')")
    (home / "tank.py").write_text(
        code.replace("    def step(", f"    def render(self):\n        {failure}\n\n    def step(")
    )
    (home / "tank.toml").write_text('env_id = "tank:Tank-v0"\n')
    done = offbench_cli("video", str(POLICY), "--env", "./tank.toml")
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("offbench: Tank-v0 cannot be rendered")
    assert remedy in line
    assert not list(home.glob("*.gif"))


def test_mp4_without_its_encoder_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(OffbenchError, match=r"offbench\[video\]"):
        video.video(POLICY, out="film.mp4")


@pytest.mark.usefixtures("draws")
def test_a_camera_that_the_environment_names_is_used() -> None:
    """Hopper's model has one that follows, number 0; -1 is MuJoCo's free one."""
    for chosen, camera in (({}, 0), ({"camera_id": -1}, -1)):
        env: Any = video._renderable(env_spec("Hopper-v5", **chosen), renderer.working_backend())
        assert env.unwrapped.mujoco_renderer.camera_id == camera
        env.close()
