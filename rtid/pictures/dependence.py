"""What the residual depends on: its mean over bins of every signal, by direction and over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtid.colours import CHAMBERS, GREY, MARKERS, UNITS
from rtid.compare import Dependence
from rtid.compare.dependence import DIRECTIONS
from rtid.model import Model
from rtid.pictures.style import STYLE
from rtid.units import LPM

Z95 = 1.96
COLUMNS = 3


def dependences(
    model: Model, signals: Sequence[Dependence], direction: Dependence, time: Dependence
) -> Figure:
    """One panel per signal: mean residual with its 95 % error bars, one scale for all panels."""
    panels = [*signals, direction, time]
    with mpl.rc_context(STYLE):
        rows = -(-len(panels) // COLUMNS)
        figure = Figure(figsize=(10.0, 2.4 * rows + 0.5))
        axes = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).ravel()
        for axis, found in zip(axes, panels, strict=False):
            _panel(axis, found, [chamber.name for chamber in model.chambers])
        _name_directions(axes[len(signals)], direction)
        for axis in axes[len(panels) :]:
            axis.remove()
        for axis in axes[: len(panels) : COLUMNS]:
            axis.set_ylabel("residual in L/min")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _panel(axis: Axes, found: Dependence, names: list[str]) -> None:
    unit, factor = UNITS.get(found.unit, (found.unit, 1.0))
    axis.axhline(0.0, color=GREY, lw=0.6)
    by_name = found.signal == "direction"
    x = np.arange(len(found.rows)) if by_name else found.centre * factor
    span = float(np.ptp(x)) if len(x) else 1.0
    shares = []
    for c, name in enumerate(names):
        shift = (c - 0.5 * (len(names) - 1)) * (0.1 if by_name else 0.006 * span)
        mean, error = found.mean_m3s[:, c] * LPM, Z95 * found.error_m3s[:, c] * LPM
        style: dict[str, Any] = {
            "color": CHAMBERS[c],
            "marker": MARKERS[c],
            "ms": 3.5,
            "elinewidth": 1.0,
        }
        line = "" if by_name else "-"
        label = f"chamber {name}, mean ± 95 %"
        axis.errorbar(x + shift, mean, error, ls=line, lw=0.7, capsize=1.5, label=label, **style)
        shares.append(f"{name} {100 * found.explained[c]:.0f} %")
    axis.set_title(f"{found.signal}   explains {', '.join(shares)}", fontsize=8.5)
    if not by_name:
        axis.xaxis.set_major_locator(mpl.ticker.MaxNLocator(5))
    axis.set_xlabel("" if by_name else f"{found.signal} in {unit}")


def _name_directions(axis: Axes, found: Dependence) -> None:
    words = [
        DIRECTIONS[0 if high < 0 else 2 if low > 0 else 1]
        for low, high in zip(found.low, found.high, strict=True)
    ]
    axis.set_xticks(range(len(words)), words)
    axis.set_xlim(-0.5, len(words) - 0.5)
