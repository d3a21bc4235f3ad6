"""Matplotlib figures without a display."""

from __future__ import annotations

import io
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbench.common.errors import OffbenchError
from offbench.common.files import output_file, write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")


def default_style(settings: dict[str, Any] | None = None) -> AbstractContextManager[None]:
    """Return a context with matplotlib's default style, not the user's, and some settings of matplotlibrc."""
    from matplotlib.style import context

    return context(["default", settings or {}])


def figure(panels: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure and the axes of its panels, side by side."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(6.4 * panels, 4.0), layout="constrained")
    axes = [fig.add_subplot(1, panels, i + 1) for i in range(panels)]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
    return fig, axes


def picture_file(path: str | Path) -> Path:
    """Return the path of a figure to write. Raises OffbenchError for an unknown ending, or if there is no folder."""
    path = Path(path)
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise OffbenchError(f"a figure's name must end in {', '.join('.' + f for f in FORMATS)}, not {path.name!r}")
    return output_file(path)


def save(fig: Figure, path: Path) -> Path:
    """Write a figure in the format of its name's ending."""
    data = io.BytesIO()
    fig.savefig(data, format=path.suffix.lstrip(".").lower(), dpi=150)
    write_bytes(path, data.getvalue())
    return path
