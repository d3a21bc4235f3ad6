"""`video`: episodes of a policy as a video (.mp4 or .gif), rendered off-screen.

    policy -> steps -> every k-th frame (k steps take 1/fps seconds) -> step and return drawn on it -> file

A video runs in real time: k follows from the environment's own frame rate (125 steps per second in Hopper).
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from offbench.agents.ladder import BEHAVIOUR, find_ladder
from offbench.common import seeds
from offbench.common.errors import OffbenchError
from offbench.common.files import output_file, write_bytes, write_errors
from offbench.common.seeds import Purpose, check_seed
from offbench.data.levels import parse_level
from offbench.envs.environments import Env, make_env, spaces_of, time_limit
from offbench.envs.recipes import load_recipe
from offbench.evaluation.evaluate import open_policy
from offbench.evaluation.renderer import NO_RENDERER, rendering_with, working_backend
from offbench.rollouts.policy import Policy, uniform_policy
from offbench.rollouts.rollouts import in_space, reset, step

if TYPE_CHECKING:
    from PIL.Image import Image

ENDINGS = (".gif", ".mp4")
CAMERA_ARGUMENTS = {"camera_id", "camera_name", "default_camera_config"}  # of Gymnasium's MuJoCo environments
COLORS = 64  # colors of a GIF
MAX_GIF_FPS = 50  # browsers show frames that take less than 0.02 s more slowly
STREAM = (int(Purpose.REFERENCE), 3)  # other episodes than those of any measurement


def video(
    path: str | Path,
    *,
    out: str | Path = "video.gif",
    env: str | Path | None = None,
    episodes: int = 1,
    seconds: float | None = None,
    seed: int = 0,
    fps: int = 25,
    size: int = 480,
) -> Path:
    """Record a video of episodes of a run's policy, of a policy file, or of a level.

    Args:
        path: a run folder or a policy file, which act deterministically; or ENV:LEVEL such as `hopper:medium`,
            whose actions are sampled as they are in its dataset.
        out: the video's file, .gif or .mp4.
        env: a recipe, instead of the environment that the run or policy names.
        episodes: how many, one after the other.
        seconds: the longest duration (default: whole episodes).
        seed: seed of the episodes.
        fps: about how many frames per second: videos run in real time, and a frame shows a whole number of steps.
        size: the longer side in pixels.

    Returns:
        The file.

    Raises:
        OffbenchError: no such policy or folder, an environment that cannot be rendered, no renderer, no mp4 encoder.
    """
    target, seed = output_file(out), check_seed(seed)
    if target.suffix.lower() not in ENDINGS:
        raise OffbenchError(f"a video's name must end in {' or '.join(ENDINGS)}, not {target.name!r}")
    if min(episodes, fps, size) < 1 or (seconds is not None and not 0 < seconds < math.inf):
        raise OffbenchError("episodes, seconds, fps and size must be more than 0, and finite")
    encode = _gif if target.suffix.lower() == ".gif" else _encoder()
    backend = working_backend()
    with contextlib.ExitStack() as drawing:
        drawing.enter_context(rendering_with(backend))  # before MuJoCo is loaded, which chooses its renderer then
        policy, spec, sampled = _policy_of(str(path), env)
        world = drawing.enter_context(_renderable(spec, backend))
        if seconds is None and time_limit(world.spec) is None:
            raise OffbenchError(f"{json.loads(spec)['id']} has no time limit (max_episode_steps); give --seconds")
        rate = float(world.metadata.get("render_fps") or fps)
        frame_interval = max(1, round(rate / fps))
        if encode is _gif:
            frame_interval = max(frame_interval, math.ceil(rate / MAX_GIF_FPS))
        max_steps = seconds * rate if seconds else float("inf")
        encode(
            target,
            _frames(world, policy, sampled, seed, episodes, frame_interval, max_steps, size),
            rate / frame_interval,
        )
    return target


def _policy_of(path: str, env: str | Path | None) -> tuple[Policy, str, bool]:
    """Return the policy, its EnvSpec and whether its actions are sampled."""
    name, colon, level = path.rpartition(":")
    if not colon or Path(path).exists():
        policy, _, spec = open_policy(Path(path), env)
        return policy, spec, False
    if env is not None:
        raise OffbenchError(f"{path} names its environment already; leave out --env, or give a policy file")
    recipe = load_recipe(name)
    source, *more = (part.source for part in parse_level(level)[1])
    spec = recipe.env_spec()
    if source == "uniform":
        observations, actions = spaces_of(make_env(spec), recipe.env_id)
        return uniform_policy(actions.low, actions.high, observations.shape[0], recipe.env_id), spec, True
    if source == "replay" or more:
        raise OffbenchError(f"{level} is not of one policy; choose random, medium, expert or a fraction")
    ladder = find_ladder(recipe)
    if ladder is None:
        raise OffbenchError(
            f"no ladder of {name} is shipped or in {BEHAVIOUR}/; give a policy file, or train an agent: "
            f"`offbench behaviour {name}`"
        )
    if source in ("medium", "expert"):
        return ladder.load(ladder.role(source)), spec, True
    rung = ladder.nearest(float(source))
    ladder.announce(rung, float(source))
    return ladder.load(rung), spec, True


def _renderable(env_spec: str, backend: str | None) -> Env:
    """Make the environment for rendering. Raises OffbenchError if it cannot be rendered here."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about an unlisted mode: the first frame shows whether it works
            env = make_env(env_spec, "rgb_array")
    except (Exception, SystemExit) as error:  # a third party's environment may raise anything here
        raise OffbenchError(
            f"{json.loads(env_spec)['id']} cannot be rendered (render_mode rgb_array): {error}"
        ) from error
    world: Any = env.unwrapped
    if hasattr(world, "mujoco_renderer"):
        import mujoco

        if backend is None:
            env.close()
            raise OffbenchError(NO_RENDERER)
        # Gymnasium 1.4 renders from a fixed camera unless told otherwise; the models have one that follows
        is_told = CAMERA_ARGUMENTS & json.loads(env_spec).get("kwargs", {}).keys()
        if not is_told and (camera := mujoco.mj_name2id(world.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")) >= 0:
            world.mujoco_renderer.camera_id = camera
    return env


def _frames(
    env: Env, policy: Policy, sampled: bool, seed: int, episodes: int, frame_interval: int, max_steps: float, size: int
) -> Iterator[Image]:
    """Play up to `max_steps` steps; yield every `frame_interval`-th frame, and the first and last of each episode."""
    noisy, (_, space) = policy.needs_noise(not sampled), spaces_of(env, policy.env_id)
    for index in range(episodes):
        if max_steps <= 0:
            return
        rng = seeds.generator(seed, Purpose.ACTION, *STREAM, index)
        observation = reset(env, seeds.integer(seed, Purpose.RESET, *STREAM, index))
        count, total, done = 0, 0.0, False
        yield _frame(env, count, total, size)
        while not done:
            noise = policy.draw(rng, 1) if noisy else None
            action = in_space(policy.act(observation[None], noise)[0], space)
            observation, reward, terminated, truncated = step(env, action)
            count, total = count + 1, total + reward
            done = terminated or truncated or count >= max_steps
            if done or count % frame_interval == 0:
                yield _frame(env, count, total, size)
        max_steps -= count


def _frame(env: Env, step: int, total: float, size: int) -> Image:
    """Render the environment's current state, with step and return drawn on it."""
    from PIL import Image, ImageDraw, ImageFont

    name = env.spec.id if env.spec else "the environment"
    try:
        pixels = env.render()
    except NotImplementedError:
        raise OffbenchError(f"{name} cannot be rendered: it has no rgb_array rendering") from None
    except (Exception, SystemExit) as error:  # a third party's environment may raise anything here
        lacks = error.name if isinstance(error, ModuleNotFoundError) else None
        hint = f"; install the package that has {lacks}" if lacks else ""  # Gymnasium's own errors say which
        raise OffbenchError(f"{name} cannot be rendered: {str(error) or type(error).__name__}{hint}") from error
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 3:
        raise OffbenchError(f"{name} renders {type(pixels).__name__}, not an image [height, width, 3]")
    image = Image.fromarray(pixels[..., :3].astype(np.uint8))
    scale = size / max(image.size)
    # even sides, which mp4's pixel format needs
    width, height = (max(2, round(side * scale / 2) * 2) for side in image.size)
    image = image.resize((width, height), Image.Resampling.LANCZOS)
    font = ImageFont.load_default(max(10, height // 18))
    text = f"step {step:>4}   return {total:,.0f}"
    draw = ImageDraw.Draw(image)
    draw.text((height // 40 + 2, height // 40), text, "white", font, stroke_width=1, stroke_fill="black")
    return image


def _gif(path: Path, frames: Iterator[Image], fps: float) -> None:
    first, *rest = [frame.quantize(COLORS) for frame in frames]
    data = io.BytesIO()
    # a GIF counts in hundredths of a second: durations differ, so that rounding does not add up
    ends = [round(100 * index / fps) for index in range(len(rest) + 2)]
    durations = [10 * (end - start) for start, end in itertools.pairwise(ends)]
    first.save(data, "GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    write_bytes(path, data.getvalue())


def _encoder() -> Callable[[Path, Iterator[Image], float], None]:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise OffbenchError(
            "mp4 needs imageio-ffmpeg: `pip install 'offbench[video]'`, or give --out video.gif"
        ) from None

    def check_frames(video: Path, expected: int) -> None:
        try:
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
        except (RuntimeError, ValueError):  # no video that ffmpeg can read
            written = 0
        if written != expected:
            raise OSError(f"the encoder wrote {written} of {expected} frames; is the disk full?")

    def mp4(path: Path, frames: Iterator[Image], fps: float) -> None:
        temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
        with write_errors(str(path)):
            try:
                first, count = next(frames), 1
                writing = imageio_ffmpeg.write_frames(
                    str(temporary), first.size, fps=fps, macro_block_size=2, quality=7
                )
                with contextlib.closing(writing) as writer:
                    writer.send(None)
                    writer.send(first.tobytes())
                    for frame in frames:
                        writer.send(frame.tobytes())
                        count += 1
                check_frames(temporary, count)
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    return mp4
