"""Two or more models side by side: what each leaves of flow and pressure, on common scales."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rtid.colours import BLUE, GREY, HELD_OUT, INK, SEEN
from rtid.compare import FREE_RUN, Examination
from rtid.model import Model
from rtid.pictures.style import STYLE, thin
from rtid.units import KPA, LPM

LIMIT = 0.998  # quantile of the errors that the common scale shows


def beside(model: Model, studies: Mapping[str, Mapping[str, Examination]]) -> Figure:
    """One column per model, by name: equation residual and free-run error of every chamber.

    studies: examinations by part; the first part was seen by the fit.  The scale of a row is common
    and may cut the largest errors of the worst model.
    """
    chambers = [chamber.name for chamber in model.chambers]
    with mpl.rc_context(STYLE):
        shape = 2 * len(chambers), len(studies)
        figure = Figure(figsize=(5.2 * shape[1], 1.75 * shape[0] + 0.6))
        axes = figure.subplots(*shape, sharex="col", sharey="row", squeeze=False)
        for k, (name, parts) in enumerate(studies.items()):
            for p, found in enumerate(parts.values()):
                for c in range(len(chambers)):
                    colour = SEEN if p == 0 else HELD_OUT
                    _flow(axes[2 * c, k], found, c, colour)
                    _pressure(axes[2 * c + 1, k], found, c, colour)
            axes[0, k].annotate(
                name,
                (0.0, 1.17),
                xycoords="axes fraction",
                fontsize=11,
                fontweight="bold",
                annotation_clip=False,
            )
            axes[-1, k].set_xlabel("time in s")
        for c, chamber in enumerate(chambers):
            axes[2 * c, 0].set_ylabel(f"chamber {chamber}\nflow in L/min")
            axes[2 * c + 1, 0].set_ylabel(f"chamber {chamber}\npressure in kPa")
        for row in axes:
            _scale(row)
        labels = ("identification", "not seen by the fit")
        patches = [
            Patch(facecolor=colour, edgecolor=GREY, linewidth=0.4, label=label)
            for colour, label in zip((SEEN, HELD_OUT), labels, strict=True)
        ]
        figure.legend(handles=patches, loc="outside lower center", ncols=2)
        figure.align_ylabels()
    return figure


def _flow(axis: Axes, found: Examination, c: int, colour: str) -> None:
    part = found.equation
    if len(part.t_s):
        text = f"{100 * part.residual_share[c]:.2g} % of the flow"
        _draw(axis, part.t_s, part.residual_m3s[:, c] * LPM, text, colour)


def _pressure(axis: Axes, found: Examination, c: int, colour: str) -> None:
    run = found.simulations.get(FREE_RUN)
    if run is not None and len(run.t_s):
        text = f"fit {run.fit_percent[c]:.1f} %"
        _draw(axis, run.t_s, run.error_pa[:, c] * KPA, text, colour)


def _draw(axis: Axes, t_s: np.ndarray, y: np.ndarray, text: str, colour: str) -> None:
    axis.axvspan(t_s[0], t_s[-1], color=colour, lw=0, zorder=0)
    axis.axhline(0.0, color=GREY, lw=0.5)
    known = np.isfinite(y)
    axis.plot(*thin(t_s[known], y[known]), color=BLUE, lw=0.5)
    middle = 0.5 * (t_s[0] + t_s[-1])
    place = axis.get_xaxis_transform()
    axis.text(middle, 1.02, text, transform=place, ha="center", fontsize=8, color=INK)


def _scale(row: np.ndarray) -> None:
    lines = [np.abs(np.asarray(line.get_ydata(), float)) for axis in row for line in axis.lines]
    largest = [float(np.quantile(y, LIMIT)) for y in lines if len(y) > 2]
    if largest and max(largest) > 0:
        row[0].set_ylim(-1.15 * max(largest), 1.15 * max(largest))
