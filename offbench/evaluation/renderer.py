"""Off-screen rendering: which of MuJoCo's rendering backends works on this machine."""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Iterator

from offbench.common.processes import environment

BACKENDS = ("egl", "osmesa") if sys.platform == "linux" else ("glfw",)  # MuJoCo has no others there
KEY = "MUJOCO_GL"
TIMEOUT = 60  # seconds that a probe may take
NO_RENDERER = (
    "MuJoCo cannot render: neither EGL nor OSMesa works; install one of them, e.g. `apt-get install libegl1 "
    "libgl1-mesa-dri` or `apt-get install libosmesa6` (conda: mesalib)"
    if sys.platform == "linux"
    else "MuJoCo cannot render: GLFW does not work; run the command in a session with a screen"
)
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any()
"""


@functools.cache
def working_backend() -> str | None:
    """Return the first of the user's MUJOCO_GL, EGL and OSMesa that renders an image, or None.

    Each is tried in its own process: a broken driver may crash it, and MuJoCo chooses a backend once per process.
    """
    own = os.environ.get(KEY)
    return next((name for name in dict.fromkeys([own, *BACKENDS] if own else BACKENDS) if _renders(name)), None)


def _renders(backend: str) -> bool:
    variables = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"} | {KEY: backend}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", PROBE], env=variables, capture_output=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


@contextlib.contextmanager
def rendering_with(backend: str | None) -> Iterator[None]:
    """Let MuJoCo render with `backend`, by its environment variable; None changes nothing.

    PyOpenGL's own variable is left out: MuJoCo refuses to load if it names another renderer.
    """
    with environment({"PYOPENGL_PLATFORM": None, KEY: backend} if backend else {}):
        yield
