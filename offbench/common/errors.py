"""The error that users see: one line that says what is wrong and what to do."""

from __future__ import annotations

import difflib
import os
import re
import traceback
from collections.abc import Iterable

NEAR = 0.76  # least difflib ratio of similar names: above that of iql and cql, below that of hoper and hopper
# environment variables that MuJoCo and PyOpenGL read when they load
RENDERING_VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
SHOW_TRACEBACK = "OFFBENCH_TRACEBACK=1 shows the traceback"


class OffbenchError(Exception):
    """A problem that the user can fix. The CLI prints its text as one line and exits with code 2."""


class LockedError(OffbenchError):
    """Another process holds the lock, so it is doing this work."""

    @property
    def waiting(self) -> str:
        """The text for a command that waits, without the remedy."""
        return f"{str(self).rpartition('; ')[0]}; waiting for it"


class DamagedError(OffbenchError):
    """The content of a file is invalid, as opposed to an error of the disk, a lock or a permission."""


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """Return the valid name that `name` misspells or is a part of, or None."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=NEAR)
    containing = [candidate for candidate in names if len(name) >= 3 and name in candidate]
    return next(iter(close + containing), None)


def unknown(what: str, name: str, valid: Iterable[str]) -> OffbenchError:
    """Return the error for a `name` that is not among the `valid` ones; it suggests a similar one, or lists all."""
    names = sorted(valid)
    suggestion = nearest(name, names)
    hint = f"did you mean {suggestion!r}?" if suggestion else f"available: {', '.join(names) or 'none'}"
    return OffbenchError(f"unknown {what} {name!r}: {hint}")


def rendering_variable(error: BaseException) -> str | None:
    """Return the environment variable, as NAME=VALUE, that kept MuJoCo or PyOpenGL from loading; None if none did."""
    set_variables = [f"{name}={os.environ[name]}" for name in RENDERING_VARIABLES if os.environ.get(name)]
    modules = {str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)}
    at_fault = any(re.match(r"OpenGL\b|mujoco\..*(gl_context|egl|osmesa|glfw)", name) for name in modules)
    return " and ".join(set_variables) if set_variables and at_fault else None
