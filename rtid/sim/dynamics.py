"""The plain machine's equations and one step of their integration, with extra physics if any.

`plant` states the equations; the state is y = (P_A, P_B, x, v), longer with extra physics (see
`extra_flows`), which replaces the valve flows and the pressure rates.
"""

from __future__ import annotations

import math
from typing import Any

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.extra_flows import extra_rates, extra_valve_flows
from rtid.sim.simulated_plant import AB, AT, BT, PA, PB, Constants, metered_flow


@compiled
def flows(
    c: Constants,
    valves: FloatArray,
    gains: FloatArray,
    y: FloatArray,
    p_s: float,
    p_t: float,
    q: FloatArray,
) -> None:
    """Fill q (5,) in place with the flow of valves (5, columns), whose gains are (5,)."""
    q[PA] = metered_flow(valves[PA], gains[PA], p_s - y[0], c.dp_laminar_pa)
    q[AT] = metered_flow(valves[AT], gains[AT], y[0] - p_t, c.dp_laminar_pa)
    q[PB] = metered_flow(valves[PB], gains[PB], p_s - y[1], c.dp_laminar_pa)
    q[BT] = metered_flow(valves[BT], gains[BT], y[1] - p_t, c.dp_laminar_pa)
    q[AB] = metered_flow(valves[AB], gains[AB], y[0] - y[1], c.dp_laminar_pa)


@compiled
def rates(c: Constants, q: FloatArray, y: FloatArray, load_n: float, dy: FloatArray) -> None:
    """Fill dy (4,) in place with the time derivative of the plain machine for the flows q."""
    x, v = y[2], y[3]
    volume_a = c.v0_a_m3 + c.area_a_m2 * x
    volume_b = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x)
    dy[0] = c.beta_pa * (q[PA] - q[AT] - q[AB] - c.area_a_m2 * v) / volume_a
    dy[1] = c.beta_pa * (q[PB] - q[BT] + q[AB] + c.area_b_m2 * v) / volume_b
    gravity = c.gravity_n + c.gravity_slope_npm * (x - 0.5 * c.stroke_m)
    friction = c.coulomb_n * math.tanh(v / c.coulomb_width_mps) + c.viscous_nspm * v
    force = y[0] * c.area_a_m2 - y[1] * c.area_b_m2 - gravity - load_n - friction
    dy[2] = v
    dy[3] = force / c.mass_kg


@compiled
def runge_kutta(
    c: Constants,
    e: Any,
    valves: FloatArray,
    gains: FloatArray,
    inputs: FloatArray,
    h_s: float,
    y: FloatArray,
    slopes: FloatArray,
    trial: FloatArray,
    q: FloatArray,
    net: FloatArray,
) -> None:
    """One step of the classical fourth-order rule; y (s,) is changed in place.

    valves (5, columns); gains (3, 5) and inputs (3, 5) hold at the start, middle and end of the
    step; slopes (4, s), trial (s,), q (5,) and net (2,) are work space.
    """
    for stage in range(4):
        at = (stage + 1) // 2
        reach = h_s if stage == 3 else 0.5 * h_s
        for i in range(len(y)):
            trial[i] = y[i] + reach * slopes[stage - 1, i] if stage > 0 else y[i]
        now, dy = inputs[at], slopes[stage]
        if e is None:
            flows(c, valves, gains[at], trial, now[0], now[1], q)
            rates(c, q, trial, now[2], dy)
        else:
            extra_valve_flows(c, e, valves, gains[at], now, trial, q)
            rates(c, q, trial, now[2], dy)
            extra_rates(c, e, now, trial, q, net, dy)
    for i in range(len(y)):
        bend = slopes[1, i] + slopes[2, i]
        y[i] += h_s / 6.0 * (slopes[0, i] + 2.0 * bend + slopes[3, i])
