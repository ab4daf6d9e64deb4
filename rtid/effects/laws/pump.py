"""A finite pump: what is drawn from the supply lowers its pressure by D.

    dD/dt = s (Q - min(Q_p, D / R)),   D >= 0

R: droop of the pump's characteristic, Q_p: the most that it delivers, s: stiffness of the line and
its accumulator.  Q: the flow drawn by the chambers that are being fed, A v + V / beta dP/dt: what
moves the piston and what the oil takes, or gives back.  Over each interval it is the whole of both,
not a smooth rate: D is an integral, in which the noise of x and P stays as small as it is.
"""

from __future__ import annotations

import math

import numpy as np

from rtid.effects.laws.timing import SUPPLY, Psi, of_law
from rtid.effects.record_view import RecordView
from rtid.kernels.jit import kernel
from rtid.model import Chamber
from rtid.plain import BoolArray, FloatArray


def demand(view: RecordView) -> FloatArray:
    """What is drawn from the supply from each sample to the next (n,), m3/s, noise and all.

    Of a view without compliances what moves the piston alone.
    """

    def rise(values: FloatArray) -> FloatArray:
        return np.diff(values, append=values[-1]) / view.step_s

    drawn = np.zeros(view.n)
    for c, chamber in enumerate(view.model.chambers):
        taken = chamber.sign * chamber.area_m2 * rise(view.x_m)
        if len(view.compliance):
            taken += view.volume(c) * view.compliance[c] * rise(view.pressure(c))
        drawn += np.where(_is_fed(view, chamber), taken, 0.0)
    return drawn


def usual_demand(view: RecordView) -> FloatArray:
    """What moving pistons draw at each sample (n,), m3/s, next to no noise: for what is usual."""
    total, v_mps = np.zeros(view.n), view.smooth(view.x_m, 1)
    for chamber in view.model.chambers:
        swept = np.maximum(chamber.sign * chamber.area_m2 * v_mps, 0.0)
        total += np.where(_is_fed(view, chamber), swept, 0.0)
    return total


def _is_fed(view: RecordView, chamber: Chamber) -> BoolArray:
    """Where a command opens a chamber to the supply (n,)."""
    is_fed = np.zeros(view.n, bool)
    for edge in view.model.edges:
        if edge.source == view.supply_name and edge.sign(chamber) > 0:
            w_v = edge.direction * view.signal(edge.command)
            is_fed |= view.may_open(edge) & (w_v > max(0.0, edge.safe_band_v))
    return is_fed


def drawn_down(drawn: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """D (n,) in Pa for a demand (n,) in m3/s, psi = (R, Q_p, s)."""
    droop = np.empty(len(drawn))
    _draw_down(np.ascontiguousarray(drawn), dt_s, *psi, droop)
    return droop


def delivered(drawn: FloatArray, dt_s: float, psi: Psi) -> float:
    """The most that the pump gives in a record, m3/s; drawn (n,) in m3/s, psi = (R, Q_p, s)."""
    r, q_p, _ = psi
    return min(q_p, float(drawn_down(drawn, dt_s, psi).max()) / r)


@kernel
def _draw_down(
    drawn: FloatArray, dt_s: float, r: float, q_p: float, s: float, droop: FloatArray
) -> None:
    """Exact over each interval for a demand that is held."""
    d = 0.0
    for k in range(len(drawn)):
        droop[k] = d
        d = max(0.0, _step(d, drawn[k], dt_s, r, q_p, s))


@kernel
def _step(d: float, q: float, dt_s: float, r: float, q_p: float, s: float) -> float:
    """D after an interval: straight above the corner R Q_p, exponential below, from one to other.

    A pump that is exactly at its corner is on the straight branch where more is drawn than Q_p.
    """
    corner = r * q_p
    if d > corner or (d == corner and q > q_p):
        left_s = dt_s if q >= q_p else min(dt_s, (d - corner) / (s * (q_p - q)))
        d += left_s * s * (q - q_p)
        dt_s -= left_s
        if dt_s <= 0.0:
            return d
        d = corner
    end = r * q + (d - r * q) * math.exp(-dt_s * s / r)
    if end <= corner:
        return end
    over_s = dt_s - math.log((r * q - d) / (r * q - corner)) * r / s
    return corner + over_s * s * (q - q_p)


FLOW = "pump_flow"
PUMP = of_law("pump", drawn_down, ("resistance", FLOW, "stiffness"), where=SUPPLY)
