"""Measured and simulated pressure of every chamber, with the error below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from rtid.colours import BLUE, GREY, HELD_OUT, INK, ORANGE, SEEN
from rtid.compare import FREE_RUN, Simulation
from rtid.model import FloatArray, Model
from rtid.pictures.style import STYLE, thin
from rtid.units import KPA, MPA


def pressures(
    model: Model, parts: Mapping[str, Mapping[str, Simulation]], name: str = FREE_RUN
) -> Figure:
    """Pressures over time; parts: simulations by name for each part, the first one was seen.

    Both parts on one time axis, shaded apart; the errors on one scale, to be compared.
    """
    runs = {title: found[name] for title, found in parts.items() if name in found}
    chambers = model.chambers
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.1 * len(chambers) + 0.5))
        heights: list[float] = [2.2, 1.0] * len(chambers)
        grid = figure.add_gridspec(2 * len(chambers), 1, height_ratios=heights)
        axes = grid.subplots(sharex=True, squeeze=False)[:, 0]
        for c, chamber in enumerate(chambers):
            upper, lower = axes[2 * c], axes[2 * c + 1]
            for k, (title, run) in enumerate(runs.items()):
                _shade((upper, lower), run, k)
                _part(upper, lower, run, c, title)
            upper.set_title(f"chamber {chamber.name}")
            upper.set_ylabel("pressure in MPa")
            lower.set_ylabel("error in kPa")
            lower.axhline(0.0, color=GREY, lw=0.5)
            _limit(lower, [run.error_pa[:, c] * KPA for run in runs.values()])
        axes[-1].set_xlabel("time in s")
        _legend(figure, axes[0], list(runs), name)
        figure.align_ylabels()
    return figure


def _shade(axes: tuple[Axes, Axes], run: Simulation, k: int) -> None:
    if len(run.t_s):
        for axis in axes:
            colour = SEEN if k == 0 else HELD_OUT
            axis.axvspan(run.t_s[0], run.t_s[-1], color=colour, lw=0, zorder=0)


def _part(upper: Axes, lower: Axes, run: Simulation, c: int, title: str) -> None:
    if not len(run.t_s):
        return
    simulated = np.where(run.predicted, run.simulated_pa[:, c], np.nan)
    _line(upper, run.t_s, run.measured_pa[:, c] * MPA, INK, 1.5)
    _line(upper, run.t_s, simulated * MPA, ORANGE, 0.7)
    _line(lower, run.t_s, run.error_pa[:, c] * KPA, BLUE, 0.5)
    text = f"{title}: fit {run.fit_percent[c]:.1f} %, {run.rms_pa[c] * KPA:.1f} kPa rms"
    middle = 0.5 * (run.t_s[0] + run.t_s[-1])
    place: dict[str, Any] = {
        "transform": lower.get_xaxis_transform(),
        "ha": "center",
        "va": "bottom",
    }
    lower.text(middle, 1.01, text, fontsize=8, **place)


def _line(axis: Axes, t_s: FloatArray, y: FloatArray, colour: str, width: float) -> None:
    """A line with all its spikes, broken where there is nothing."""
    known = np.isfinite(y)
    edges = np.flatnonzero(np.diff(known.astype(int))) + 1
    for piece in np.split(np.arange(len(y)), edges):
        if len(piece) and known[piece[0]]:
            axis.plot(*thin(t_s[piece], y[piece]), color=colour, lw=width)


def _limit(axis: Axes, errors: list[FloatArray]) -> None:
    every = np.abs(np.concatenate([*errors, np.zeros(1)]))
    every = every[np.isfinite(every)]
    most = 1.1 * float(every.max(initial=0.0))
    if most > 0:
        axis.set_ylim(-most, most)


def _legend(figure: Figure, axis: Axes, titles: list[str], name: str) -> None:
    handles: list[Line2D | Patch] = [
        *axis.plot([], [], color=INK, lw=1.5, label="measured"),
        *axis.plot([], [], color=ORANGE, lw=1.2, label=f"simulated, {name}"),
        *axis.plot([], [], color=BLUE, lw=1.0, label="measured minus simulated"),
    ]
    for k, title in enumerate(titles):
        colour = SEEN if k == 0 else HELD_OUT
        label = title if k == 0 else f"{title}: not seen by the fit"
        handles.append(Patch(facecolor=colour, edgecolor=GREY, linewidth=0.4, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
