"""A finite pump: what is drawn from the supply lowers its pressure by D.

    dD/dt = s (Q - min(Q_p, D / R)),   D >= 0

R: droop of the pump's characteristic, Q_p: the most that it delivers, s: stiffness of the line and
its accumulator.  Q: the flow drawn, by the measured motion of the chambers that are being fed.
"""

from __future__ import annotations

import math

import numpy as np

from rtid.diagnose.timing import SUPPLY, Psi, Timing
from rtid.diagnose.view import View
from rtid.kernels.jit import kernel
from rtid.model import FloatArray


def demand(view: View) -> FloatArray:
    """What is drawn from the supply at each sample (n,), m3/s."""
    total, v_mps = np.zeros(view.n), view.smooth(view.x_m, 1)
    for chamber in view.model.chambers:
        is_fed = np.zeros(view.n, bool)
        for edge in view.model.edges:
            if edge.source == view.supply_name and edge.sign(chamber) > 0:
                w_v = edge.direction * view.signal(edge.command)
                is_fed |= w_v > max(0.0, edge.safe_band_v)
        swept = chamber.sign * chamber.area_m2 * v_mps
        total += np.where(is_fed, np.maximum(swept, 0.0), 0.0)
    return total


def drawn_down(drawn: FloatArray, dt_s: float, psi: Psi) -> FloatArray:
    """D (n,) in Pa for a demand (n,) in m3/s, psi = (R, Q_p, s)."""
    droop = np.empty(len(drawn))
    _draw_down(np.ascontiguousarray(drawn), dt_s, *psi, droop)
    return droop


@kernel
def _draw_down(
    drawn: FloatArray, dt_s: float, r: float, q_p: float, s: float, droop: FloatArray
) -> None:
    """Exact over each interval on either branch, held at the corner between them."""
    fade, d = math.exp(-dt_s * s / r), 0.0
    for k in range(len(drawn)):
        droop[k] = d
        end = r * drawn[k] + (d - r * drawn[k]) * fade
        if end > r * q_p:
            end = d + dt_s * s * (drawn[k] - q_p) if d >= r * q_p else r * q_p
        d = max(0.0, end)


PUMP = Timing(
    "supply_sag", ("resistance", "pump_flow", "stiffness"), ("Pa s/m3", "m3/s", "Pa/m3"),
    ((1e9, 3e-4, 1e9),), (1e6, 1e-6, 1e7), (1e12, 1e-1, 1e14), drawn_down, where=SUPPLY,
)  # fmt: skip
