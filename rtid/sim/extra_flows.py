"""The pressure equations of a machine with extra physics; each term is zero by default.

V_c(x) dP_c/dt / beta_c(P_c) = s (valve flows or hose flow) + leaks - s_c A_c v - side flows
gap      q = k dp (1 + (mean pressure - 3 MPa) / 20 MPa)    a gap that pressure widens
orifice  q = K dp / sqrt(|dp| + dp_t)                       sharp edge, laminar at small dp
relief   q = k (d + sqrt(d^2 + w^2)) / 2, d = P - P_open    a poppet with a soft knee
mixture  1 / beta_c = (V_gas / (kappa P) + V_oil / beta) / (V_gas + V_oil),
         V_gas = share (p0 / P)^(1/kappa), V_oil = (1 - share) exp(-(P - p0) / beta)
oil      beta (1 + s P) in place of beta
hose     pi section: (V_h / 2 beta) dP_port/dt = valves - q,  I dq/dt = P_port - P_c - R q - r q|q|
pump     P_s = P_set - D,  C(P_s) dD/dt = flow drawn - Q_p tanh(D / (R Q_p)), C of an accumulator
"""

from __future__ import annotations

import math
from typing import Any

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.simulated_plant import AB, AT, BT, PA, PB, Constants, metered_flow
from rtid.sim.valve_laws import root_flow

# the state of a machine with extra physics; the first four are the plain machine's
P_A, P_B, X, V, PORT_A, PORT_B, LINE_A, LINE_B, DEAD_A, DEAD_B, HOSE_A, HOSE_B = range(12)
SUPPLY, DROOP, BRANCH, BRANCH_FLOW = range(12, 16)
STATES = 16
SUPPLY_IN, TANK_IN, BURST_IN = 0, 1, 4  # columns of the inputs

ATMOSPHERE_PA = 1.013e5
GAP_MEAN_PA, GAP_WIDENS_PA = 3e6, 20e6
TRANSITION_PA = 3e4  # between laminar and turbulent in a leak
SEAT_LAMINAR_PA = 1e5  # a seat's gap is finer than a metering edge
KNEE_PA = 0.1e6  # width of the knee of a relief or make-up valve
GROOVE_SHIFT_M, GROOVE_M = 0.01, 0.02  # from the middle of the stroke; half length
GROOVE_SPEED_MPS = 0.01
POLYTROPIC = 1.15
DEAD_LAG_S = 2e-3  # of the pressure in a dead volume, behind its port
HOSE_LAG_S = 1e-3
HOSE_MEAN_PA, HOSE_STIFF_PA = 4e6, 8e6  # a hose is half as soft at 12 MPa as at 4 MPa
HOSE_BORE_M, OIL_KGPM3, OIL_PAS = 13e-3, 870.0, 0.04
HOSE_AREA_M2 = math.pi / 4 * HOSE_BORE_M**2
INERTANCE_KGPM5 = OIL_KGPM3 / HOSE_AREA_M2  # per metre of hose
RESISTANCE_PASPM4 = 128 * OIL_PAS / (math.pi * HOSE_BORE_M**4)
TURBULENT_PAS2PM7 = 0.02 * OIL_KGPM3 / (2 * HOSE_BORE_M * HOSE_AREA_M2**2)
COMPENSATED_PA, COMPENSATED_CORNER_PA = 2e6, 2e5
PUMP_M3S, SUPPLY_LAG_S, ACCUMULATOR = 6e-4, 0.4, 1.8  # exponent of C(P)
BRANCH_RADPS, BRANCH_DAMPING = 2 * math.pi * 9.0, 0.1


@compiled
def gap_flow(k: float, p1_pa: float, p2_pa: float) -> float:
    """Laminar leak from p1 to p2, m3/s; k (m3/s/Pa) at a mean pressure of 3 MPa."""
    q: float = k * (p1_pa - p2_pa) * (1 + (0.5 * (p1_pa + p2_pa) - GAP_MEAN_PA) / GAP_WIDENS_PA)
    return q


@compiled
def orifice_flow(k: float, dp_pa: float) -> float:
    """Leak through a sharp edge, m3/s; k in m3/s/sqrt(Pa); none costs no root."""
    if k == 0.0:
        return 0.0
    return k * dp_pa / math.sqrt(abs(dp_pa) + TRANSITION_PA)


@compiled
def knee(d_pa: float) -> float:
    """0 far below zero, d far above, smooth between; Pa."""
    return 0.5 * (d_pa + math.sqrt(d_pa * d_pa + KNEE_PA * KNEE_PA))


@compiled
def groove_opening(x_m: float, stroke_m: float) -> float:
    """0..1: a bump of the leak in the worn part of the stroke."""
    s = (x_m - 0.5 * stroke_m - GROOVE_SHIFT_M) / GROOVE_M
    return math.exp(-0.5 * s * s)


@compiled
def crossing_flow(c: Constants, e: Any, y: FloatArray) -> float:
    """All leaks from A to B past the piston, m3/s, at the state y (STATES,)."""
    p_a, p_b = y[P_A], y[P_B]
    k = e.whole.internal_laminar
    if e.whole.groove + e.whole.groove_one_way > 0.0:
        one_way = 0.5 * (1.0 + math.tanh(y[V] / GROOVE_SPEED_MPS)) * e.whole.groove_one_way
        k += groove_opening(y[X], c.stroke_m) * (e.whole.groove + one_way)
    return gap_flow(k, p_a, p_b) + orifice_flow(e.whole.internal_turbulent, p_a - p_b)


@compiled
def outward_flow(r: Any, p_pa: float, p_tank_pa: float) -> float:
    """All flows from one chamber to tank, m3/s; negative where more is made up."""
    leak = gap_flow(r.external_laminar, p_pa, p_tank_pa)
    leak += orifice_flow(r.external_turbulent, p_pa - p_tank_pa)
    if r.relief > 0.0:
        leak += r.relief * knee(p_pa - r.relief_open_pa)
    if r.makeup > 0.0:
        leak -= r.makeup * knee(r.makeup_open_pa - p_pa)
    return leak


@compiled
def extra_flows(c: Constants, e: Any, inputs: FloatArray, y: FloatArray, net: FloatArray) -> None:
    """Fill net (2,) in place: what flows into A and B past valves and hoses, m3/s."""
    crossing, p_tank_pa = crossing_flow(c, e, y), inputs[TANK_IN]
    net[0] = e.whole.burst_m3s * inputs[BURST_IN] - crossing - outward_flow(e.a, y[P_A], p_tank_pa)
    net[1] = crossing - outward_flow(e.b, y[P_B], p_tank_pa)


@compiled
def edge_flow(
    c: Constants,
    valve: FloatArray,
    seat: float,
    compensated: float,
    gain: float,
    dp_pa: float,
) -> float:
    """Flow of valve (columns,) with its seat leak and its pressure compensator, m3/s.

    The seat's gap adds to the opening like two sides of a right angle: K = hypot(K(w), K_seat).
    """
    q: float = metered_flow(valve, gain, dp_pa, c.dp_laminar_pa)
    if compensated > 0.0:
        flat = math.sqrt(COMPENSATED_PA) * math.tanh(dp_pa / COMPENSATED_CORNER_PA)
        q = (1.0 - compensated) * q + compensated * gain * flat
    if seat > 0.0:
        q += root_flow(math.hypot(gain, seat) - gain, dp_pa, SEAT_LAMINAR_PA)
    return q


@compiled
def tie_nodes(e: Any, p_supply_pa: float, y: FloatArray) -> None:
    """Set the pressures of y (STATES,) at the valves that follow from others, Pa."""
    y[SUPPLY] = p_supply_pa - y[DROOP]
    if e.whole.branch_kgpm4 == 0.0:
        y[BRANCH] = y[SUPPLY]
    if e.a.line_m == 0.0:
        y[PORT_A] = y[P_A]
    if e.b.line_m == 0.0:
        y[PORT_B] = y[P_B]


@compiled
def extra_valve_flows(
    c: Constants,
    e: Any,
    valves: FloatArray,
    gains: FloatArray,
    inputs: FloatArray,
    y: FloatArray,
    q: FloatArray,
) -> None:
    """Fill q (5,), m3/s, of valves (5, columns) for gains (5,); ties y's pressures."""
    tie_nodes(e, inputs[SUPPLY_IN], y)
    w, p_tank_pa = e.whole, inputs[TANK_IN]
    port_a, port_b, p_s = y[PORT_A], y[PORT_B], y[SUPPLY]
    q[PA] = edge_flow(c, valves[PA], w.seat_pa, w.compensated_pa, gains[PA], y[BRANCH] - port_a)
    q[AT] = edge_flow(c, valves[AT], w.seat_at, w.compensated_at, gains[AT], port_a - p_tank_pa)
    q[PB] = edge_flow(c, valves[PB], w.seat_pb, w.compensated_pb, gains[PB], p_s - port_b)
    q[BT] = edge_flow(c, valves[BT], w.seat_bt, w.compensated_bt, gains[BT], port_b - p_tank_pa)
    q[AB] = edge_flow(c, valves[AB], w.seat_ab, w.compensated_ab, gains[AB], port_a - port_b)


@compiled
def compressibility(c: Constants, e: Any, r: Any, p_pa: float) -> float:
    """1 / beta_c of oil with free and released gas at the absolute pressure, 1/Pa."""
    oil = 1.0 / (c.beta_pa * (1.0 + e.whole.stiffening * p_pa))
    if e.whole.air_share > 0.0:
        gas = e.whole.air_share * (ATMOSPHERE_PA / p_pa) ** (1.0 / POLYTROPIC)
        liquid = (1.0 - e.whole.air_share) * math.exp(-(p_pa - ATMOSPHERE_PA) * oil)
        oil = (gas / (POLYTROPIC * p_pa) + liquid * oil) / (gas + liquid)
    if r.released > 0.0 and p_pa < r.release_pa:
        below = 1.0 - p_pa / r.release_pa
        oil += 2.0 * r.released * below / r.release_pa
    return oil


@compiled
def chamber_rates(
    c: Constants,
    e: Any,
    r: Any,
    chamber: int,
    valves: float,
    net: float,
    y: FloatArray,
    dy: FloatArray,
) -> None:
    """Fill in place the rates of one chamber, its hose, its dead volume and its soft hose wall.

    r: the chamber's numbers; valves: net flow through its metering edges; net: its extra flows,
    m3/s; y, dy (STATES,): the state and its rate, SI.
    """
    p = y[P_A + chamber]
    line_m3 = r.line_m * HOSE_AREA_M2
    volume = c.v0_a_m3 + c.area_a_m2 * y[X] + 0.5 * line_m3
    area = c.area_a_m2
    if chamber == 1:
        volume = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - y[X]) + 0.5 * line_m3
        area = -c.area_b_m2
    into = valves
    if line_m3 > 0.0:
        into = y[LINE_A + chamber]
        port, length = y[PORT_A + chamber], r.line_m
        soft = 0.5 * line_m3 * compressibility(c, e, r, port)
        dy[PORT_A + chamber] = (valves - into) / soft
        loss = (RESISTANCE_PASPM4 + TURBULENT_PAS2PM7 * abs(into)) * length * into
        dy[LINE_A + chamber] = (port - p - loss) / (INERTANCE_KGPM5 * length)
    if r.dead_volume_m3 > 0.0:
        dy[DEAD_A + chamber] = (p - y[DEAD_A + chamber]) / DEAD_LAG_S
        into -= r.dead_volume_m3 / c.beta_pa * dy[DEAD_A + chamber]
    if r.hose_m3ppa > 0.0:
        dy[HOSE_A + chamber] = (p - y[HOSE_A + chamber]) / HOSE_LAG_S
        softness = 1.0 / (1.0 + (y[HOSE_A + chamber] - HOSE_MEAN_PA) / HOSE_STIFF_PA)
        into -= r.hose_m3ppa * softness * dy[HOSE_A + chamber]
    room = volume * compressibility(c, e, r, p)
    dy[P_A + chamber] = (into + net - area * y[V]) / room


@compiled
def supply_rates(e: Any, q: FloatArray, p_set_pa: float, y: FloatArray, dy: FloatArray) -> None:
    """Fill the supply's rates dy (STATES,): pump, accumulator, branch to pa; q (5,) in m3/s."""
    to_pa: float = q[PA]
    if e.whole.branch_kgpm4 > 0.0:
        capacity = 1.0 / (BRANCH_RADPS**2 * e.whole.branch_kgpm4)
        resistance = 2.0 * BRANCH_DAMPING * BRANCH_RADPS * e.whole.branch_kgpm4
        dy[BRANCH] = (y[BRANCH_FLOW] - q[PA]) / capacity
        dy[BRANCH_FLOW] = (
            y[SUPPLY] - y[BRANCH] - resistance * y[BRANCH_FLOW]
        ) / e.whole.branch_kgpm4
        to_pa = y[BRANCH_FLOW]
    if e.whole.sag_pasm3 > 0.0:
        delivered = PUMP_M3S * math.tanh(y[DROOP] / (e.whole.sag_pasm3 * PUMP_M3S))
        capacity = SUPPLY_LAG_S / e.whole.sag_pasm3 * (p_set_pa / y[SUPPLY]) ** ACCUMULATOR
        dy[DROOP] = (to_pa + q[PB] - delivered) / capacity


@compiled
def extra_rates(
    c: Constants,
    e: Any,
    inputs: FloatArray,
    y: FloatArray,
    q: FloatArray,
    net: FloatArray,
    dy: FloatArray,
) -> None:
    """Replace the pressure rates of dy (STATES,) for the flows q (5,); fill net (2,), m3/s."""
    extra_flows(c, e, inputs, y, net)
    dy[PORT_A:] = 0.0
    chamber_rates(c, e, e.a, 0, q[PA] - q[AT] - q[AB], net[0], y, dy)
    chamber_rates(c, e, e.b, 1, q[PB] - q[BT] + q[AB], net[1], y, dy)
    supply_rates(e, q, inputs[SUPPLY_IN], y, dy)
