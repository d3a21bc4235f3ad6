"""One line for any exception, those of third parties' algorithms included."""

from __future__ import annotations

import os
import sys
import traceback
import types
from collections.abc import Callable

from offbench.common.errors import SHOW_TRACEBACK, OffbenchError, rendering_variable
from offbench.common.files import OPEN_FILES, READ_REMEDIES, is_out_of_memory
from offbench.training.registry import algorithm_packages


def describe_failure(error: BaseException, write_traceback: Callable[[str], object] | None = None) -> str:
    """Describe any exception in one line: what went wrong and what to do about it.

    Args:
        write_traceback: receives the traceback (None: it goes to stderr) if $OFFBENCH_TRACEBACK is set, or if the
            error arose in a third party's algorithm, whose author needs it.
    """
    expected = isinstance(error, OffbenchError | OSError) or is_out_of_memory(error)
    algorithm = None if expected else _third_party(error.__traceback__)
    if algorithm or os.environ.get("OFFBENCH_TRACEBACK"):
        (write_traceback or sys.stderr.write)("".join(traceback.format_exception(error)))
    if isinstance(error, OffbenchError):
        return str(error)
    if is_out_of_memory(error):
        return f"not enough memory ({str(error) or 'for this command'}); close other programs, or ask for less"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        remedies = READ_REMEDIES if error.filename else OPEN_FILES
        remedy = f"; {remedies[error.errno]}" if error.errno in remedies else ""
        return f"{where}{error.strerror or error}{remedy} ({SHOW_TRACEBACK})"
    if not algorithm and (variable := rendering_variable(error)):
        return f"MuJoCo does not load with {variable} ({type(error).__name__}: {error}); unset it or choose another"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    what = f"{type(error).__name__}: {error} (at {frame.filename}:{frame.lineno})"
    if algorithm:
        return f"an error in {algorithm}: {what}; see the traceback above"
    return f"this is a bug in offbench: {what}; please report it; {SHOW_TRACEBACK}"


def _third_party(trace: types.TracebackType | None) -> str | None:
    """Return the package or module of an algorithm, not offbench's own, that a traceback leads through.

    A script's or notebook's own frames count once offbench has called them.
    """
    packages, in_offbench = algorithm_packages() - {"offbench"}, False
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
        in_offbench = in_offbench or package == "offbench"
        if package in packages or (package == "__main__" and in_offbench):
            return "your script" if package == "__main__" else package
        trace = trace.tb_next
    return None
