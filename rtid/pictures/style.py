"""One quiet style for all pictures: few colours that every eye can tell apart, no ornament."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtid.colours import GREY, INK, PALE
from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID
from rtid.model import FloatArray

FILL = {VALID: "#b9d9ec", LEARNING: "#f6e3b4", EXTRAPOLATED: "white", PRIOR: "white", SHUT: PALE}
LABELS = {
    VALID: "valid",
    LEARNING: "learning",
    EXTRAPOLATED: "no data: extrapolated",
    PRIOR: "no data: rated value",
    SHUT: "shut",
}

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 6,
    "axes.labelsize": 9,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "hatch.linewidth": 0.6,
    "svg.hashsalt": "rtid",
    "figure.constrained_layout.use": True,
}


def panels(count: int, width: float = 9.0, height: float = 3.2) -> tuple[Figure, list[Axes]]:
    """A figure of `count` axes in at most two columns, axes shared; sizes in inches per row."""
    columns = min(2, count)
    rows = -(-count // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width * columns / 2, height * rows + 0.5))
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    axes = list(grid.ravel())
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def label_outer(axes: Sequence[Axes], x: str, y: str) -> None:
    """Axis labels on the outer panels only."""
    for axis in axes:
        spec = axis.get_subplotspec()
        axis.set_xlabel(x if spec is None or spec.is_last_row() else "")
        axis.set_ylabel(y if spec is None or spec.is_first_col() else "")


def save(figure: Figure, path: Path) -> Path:
    """Write the picture in the format that the suffix names (.png, .svg), without a date."""
    with mpl.rc_context(STYLE):
        dated: dict[str, str | None] | None = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, dpi=160, metadata=dated)
    return path


def thin(t: FloatArray, y: FloatArray, bins: int = 1500) -> tuple[FloatArray, FloatArray]:
    """Least and largest value of each of `bins` equal runs, in their order: no spike is lost."""
    n = len(y)
    if n <= 2 * bins:
        return t, y
    size = -(-n // bins)
    padded = np.concatenate([y, np.full(-n % size, y[-1])]).reshape(-1, size)
    start = size * np.arange(len(padded))
    at = np.sort(np.stack([start + padded.argmin(axis=1), start + padded.argmax(axis=1)]), axis=0)
    chosen = np.unique(np.minimum(at.T.ravel(), n - 1))
    return t[chosen], y[chosen]
