"""Flows and pressures of every chamber over time, measured and modelled, with what is left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from bokeh.plotting import figure

from rtid.compare import Comparison, Simulation
from rtid.plain import FloatArray
from rtid.tell.charts.lines import Column, Lines, Part
from rtid.tell.charts.theme import INK_TAG
from rtid.tell.charts.time_plots import TimePlots
from rtid.tell.colours import BLUE, ORANGE
from rtid.units import KPA, MPA, flow_name, lpm

NAMES = {"identification": "identification", "validation": "held-out"}


def flow_plots(time: TimePlots, view: str, lines: Lines, c: int, title: str) -> list[figure]:
    """Measured and modelled flow of a chamber, and what is left below."""
    made = [time.plot(view, flow_name(), title, False), time.plot(view, flow_name())]
    lines.add(made[0], f"measured {c}", INK_TAG, 1.4)
    lines.add(made[0], f"model {c}", ORANGE, 1.0)
    lines.add(made[1], f"left {c}", BLUE, 0.8)
    return made


def flows_of(part: Comparison) -> Part:
    """Measured and modelled flow of every chamber, and what is left."""

    def columns(c: int) -> dict[str, Column]:
        return {
            f"measured {c}": lambda at: part.measured_m3s[at, c] * lpm(),
            f"model {c}": lambda at: part.modelled_m3s[at, c] * lpm(),
            f"left {c}": lambda at: (part.measured_m3s[at, c] - part.modelled_m3s[at, c]) * lpm(),
        }

    return part.t_s, _of_all(columns, part.measured_m3s.shape[1])


def pressures_of(run: Simulation) -> Part:
    """Measured and simulated pressure of every chamber in MPa; what is left in kPa."""

    def columns(c: int) -> dict[str, Column]:
        def model(at: slice) -> FloatArray:
            return np.where(run.predicted[at], run.simulated_pa[at, c], np.nan)

        return {
            f"measured {c}": lambda at: run.measured_pa[at, c] * MPA,
            f"model {c}": lambda at: model(at) * MPA,
            f"left {c}": lambda at: (run.measured_pa[at, c] - model(at)) * KPA,
        }

    return run.t_s, _of_all(columns, run.measured_pa.shape[1])


def _of_all(columns: Callable[[int], dict[str, Column]], chambers: int) -> dict[str, Column]:
    return {name: column for c in range(chambers) for name, column in columns(c).items()}
