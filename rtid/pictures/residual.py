"""Measured against modelled flow of every chamber over time, with the residual below."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtid.colours import BLUE, GREY, INK, ORANGE
from rtid.compare.comparison import Comparison
from rtid.model import FloatArray, Model
from rtid.pictures.style import STYLE, thin
from rtid.units import LPM


def residual(model: Model, parts: dict[str, Comparison]) -> Figure:
    """One row of panels per chamber; `parts` by title ("identification", "validation")."""
    chambers = model.chambers
    spans = [max(float(np.ptp(part.t_s)), 1.0) if len(part.t_s) else 1.0 for part in parts.values()]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 2.9 * len(chambers) + 0.4))
        heights: list[float] = [2.4, 1.0] * len(chambers)
        grid = figure.add_gridspec(
            2 * len(chambers), len(parts), height_ratios=heights, width_ratios=np.sqrt(spans)
        )
        axes = grid.subplots(sharex="col", sharey="row", squeeze=False)
        for k, (title, part) in enumerate(parts.items()):
            for c, chamber in enumerate(chambers):
                name = f"chamber {chamber.name}, {title}"
                _flows(axes[2 * c, k], part, c, name)
                _residual(axes[2 * c + 1, k], part, c)
            axes[-1, k].set_xlabel("time in s")
        for c in range(len(chambers)):
            axes[2 * c, 0].set_ylabel("flow in L/min")
            axes[2 * c + 1, 0].set_ylabel("residual")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        figure.align_ylabels()
    return figure


def _flows(axis: Axes, part: Comparison, chamber: int, title: str) -> None:
    _line(axis, part.t_s, part.measured_m3s[:, chamber], INK, 1.6, "measured, s A v")
    _line(axis, part.t_s, part.modelled_m3s[:, chamber], ORANGE, 0.8, "modelled")
    axis.set_title(title)


def _residual(axis: Axes, part: Comparison, chamber: int) -> None:
    axis.axhline(0.0, color=GREY, lw=0.5)
    _line(axis, part.t_s, part.residual_m3s[:, chamber], BLUE, 0.5, "residual")
    if len(part.t_s):
        share = 100 * part.residual_share[chamber]
        rms = LPM * part.residual_rms_m3s[chamber]
        axis.set_title(f"{rms:.3g} L/min rms, {share:.2g} % of the flow", fontsize=8, pad=2)


def _line(
    axis: Axes, t_s: FloatArray, q_m3s: FloatArray, colour: str, width: float, label: str
) -> None:
    t, q = thin(t_s, q_m3s * LPM)
    axis.plot(*_with_breaks(t, q), color=colour, lw=width, label=label)


def _with_breaks(t_s: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """No line across a gap: NaN where a step is more than five usual ones."""
    if len(t_s) < 3:
        return t_s, q
    step = np.diff(t_s)
    at = np.flatnonzero(step > 5 * np.median(step)) + 1
    return np.insert(t_s, at, np.nan), np.insert(q, at, np.nan)
