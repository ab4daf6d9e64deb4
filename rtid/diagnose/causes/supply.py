"""A supply that gives way to what is drawn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.diagnose.candidates import (
    Candidate,
    Cause,
    Shape,
    Volumes,
)
from rtid.diagnose.causes.common import lagged
from rtid.diagnose.view import View
from rtid.kernels.jit import kernel
from rtid.model import FloatArray

SAG_TIMES_S = (0.05, 0.15, 0.4, 1.2)
PUMP_FLOWS = (0.3, 0.5, 0.7, 0.85, 0.95)  # quantiles of the demand that a pump may deliver


def supply(view: View) -> Iterator[Cause]:
    """A supply that gives way to what is drawn, in two forms.

    By a resistance behind a lag, as a pump's characteristic and its line are; or by the volume that
    is drawn beyond a pump's flow, times the stiffness of the line, recovering to the nominal value.
    """
    if not view.supply_name:
        return
    n_e = len(view.model.edges)
    fed = [i for i, e in enumerate(view.model.edges) if e.source == view.supply_name]
    demand = np.sum([_drawn(view, i) for i in fed], axis=0)
    slopes = [view.slope_dp(i) if i in fed else np.zeros(view.n - 1) for i in range(n_e)]
    drawn = demand[demand > 0]
    unmeasured = len(drawn) > 0 and not view.supply_is_measured

    def lowered(sag: FloatArray) -> Volumes:
        return {
            c: -view.into_chamber(c, slopes) * sag * view.dt_s
            for c in range(len(view.model.chambers))
        }

    bank = tuple(float(v) for v in np.quantile(drawn, PUMP_FLOWS)) if len(drawn) else ()

    def make(shape: Shape) -> Volumes:
        missing = np.empty(len(demand))
        draw_down(demand - shape[0], view.dt_s, missing)
        return lowered(missing)

    yield Cause(
        Candidate("supply_sag", view.supply_name, "resistance", "Pa s/m3", 1e12,
                  shape_names=("time_constant",), shape_units=("s",)),
        lambda shape: lowered(lagged(demand, view.step_s, shape[0])), (SAG_TIMES_S,),
        offered=unmeasured,
    )  # fmt: skip
    yield Cause(
        Candidate("supply_sag", view.supply_name, "stiffness", "Pa/m3", 1e12,
                  shape_names=("pump_flow",), shape_units=("m3/s",)),
        make, (bank,), offered=unmeasured,
    )  # fmt: skip


def _drawn(view: View, i: int) -> FloatArray:
    """What edge i draws while it is open, by the measured motion (n - 1,), m3/s."""
    edge = view.model.edges[i]
    c = next(k for k, chamber in enumerate(view.model.chambers) if edge.sign(chamber) > 0)
    chamber = view.model.chambers[c]
    swept = chamber.sign * chamber.area_m2 * view.smooth(view.x_m, 1)[:-1]
    return np.where(view.flow(i) > 0.0, np.maximum(swept, 0.0), 0.0)


@kernel
def draw_down(excess: FloatArray, dt_s: FloatArray, missing: FloatArray) -> None:
    """Volume missing from a line that is drawn from by `excess` m3/s, never below zero, (n,)."""
    level = 0.0
    for k in range(len(excess)):
        after = max(0.0, level + excess[k] * dt_s[k])
        missing[k] = 0.5 * (level + after)
        level = after
