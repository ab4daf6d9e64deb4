"""Flows and pressures of every chamber over time, measured and modelled, with what is left."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure

from rtid.compare import Simulation
from rtid.plain import FloatArray
from rtid.tell.charts.lines import Columns, Lines
from rtid.tell.charts.theme import INK_TAG
from rtid.tell.charts.time_plots import TimePlots
from rtid.tell.colours import BLUE, ORANGE
from rtid.units import KPA, MPA, flow_name, lpm

NAMES = {"identification": "identification", "validation": "held-out"}


def flow_plots(
    time: TimePlots, view: str, lines: Lines, c: int, title: str, is_last: bool = True
) -> list[figure]:
    """Measured and modelled flow of a chamber, and what is left below."""
    made = [time.plot(view, flow_name(), title, False), time.plot(view, flow_name(), "", is_last)]
    lines.add(made[0], f"measured {c}", INK_TAG, 1.4)
    lines.add(made[0], f"model {c}", ORANGE, 1.0)
    lines.add(made[1], f"left {c}", BLUE, 0.8)
    return made


def flows_of(
    t_s: FloatArray, measured: FloatArray, residual: FloatArray
) -> tuple[FloatArray, Columns]:
    """Times (n,) and, per chamber, measured, modelled and what is left, from (n, chambers) m3/s."""
    columns = {"measured": measured, "model": measured - residual, "left": residual}
    return t_s, {f"{k} {c}": v[:, c] * lpm() for k, v in columns.items() for c in range(v.shape[1])}


def pressures_of(run: Simulation) -> tuple[FloatArray, Columns]:
    """Times (n,), s, and the same (n,) of simulated pressures in MPa; what is left in kPa."""
    model = np.where(run.predicted[:, None], run.simulated_pa, np.nan)
    columns = {
        "measured": run.measured_pa * MPA, "model": model * MPA, "left": run.error_pa * KPA
    }  # fmt: skip
    return run.t_s, {f"{k} {c}": v[:, c] for k, v in columns.items() for c in range(v.shape[1])}
