"""The simulated machine: a single-rod cylinder between metering valves; SI, absolute pressures.

    V_c(x) dP_c/dt = beta (sum of the flows into c - s_c A_c v),   V_A = V0_A + A_A x,
                                                                   V_B = V0_B + A_B (stroke - x)
    m dv/dt        = P_A A_A - P_B A_B - gravity(x) - load(t) - friction(v)
    Q              = K(w) g(dp),   g(dp) = dp / (dp^2 + dp_lam^2)^(1/4)   (odd, smooth, ~ sqrt)
    K(w)           = gain (r + curve r^2 + ripple (cos(phase) - cos(rate r + phase)) / rate)

w is the opening voltage of a valve behind its first-order lag, r(w) the voltage above the dead
band with a corner that is rounded over `corner_v` (twice continuously differentiable).  K is
strictly increasing above the dead band while |ripple| < 1 and curve >= 0.  That is an orifice;
other laws are in `rtid.sim.valve_laws`.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rtid.plain import FloatArray
from rtid.sim.compiled import compiled
from rtid.sim.extra_physics import NONE, Extra, Planted
from rtid.sim.valve_laws import JUMP, LAWS, NOTCH, OVERLAP, law_flow

EDGES = ("pa", "at", "pb", "bt", "ab")  # supply->A, A->tank, supply->B, B->tank, A->B
PA, AT, PB, BT, AB = range(5)
GAIN, DEADBAND, CORNER, CURVE, RIPPLE, RATE, PHASE, LAW, LAW_A, LAW_B = range(
    10
)  # columns of `SimulatedPlant.valve_table`


class Constants(NamedTuple):
    """The machine besides its valves, SI; the defaults are of the rig's size."""

    area_a_m2: float = 1.9635e-3
    area_b_m2: float = 0.94562e-3
    stroke_m: float = 0.5
    v0_a_m3: float = 6e-4
    v0_b_m3: float = 6e-4
    beta_pa: float = 850e6
    mass_kg: float = 400.0
    gravity_n: float = 4500.0  # load in the middle of the stroke, against extension
    gravity_slope_npm: float = -2000.0
    coulomb_n: float = 250.0
    coulomb_width_mps: float = 4e-3  # the Coulomb friction is coulomb_n * tanh(v / width)
    viscous_nspm: float = 3500.0
    dp_laminar_pa: float = 3e4


class Controller(NamedTuple):
    """u = deadband compensation + volts_per_mps (v_ref + kp (x_ref - x)) + dither."""

    kp_1ps: float = 5.0
    volts_per_mps: float = 26.0
    deadband_v: float = 1.6
    blend_mps: float = 4e-3  # the compensation is deadband_v * tanh(demand / blend_mps)
    limit_v: float = 10.0


@dataclass(frozen=True)
class Valve:
    """One flow gain K(w); field order is the column order of `SimulatedPlant.valve_table`."""

    gain: float = 3.8e-8  # m3/s / sqrt(Pa) / V
    deadband_v: float = 1.8
    corner_v: float = 0.15
    curve_1pv: float = 0.015
    ripple: float = 0.0
    ripple_rate_radpv: float = 1.5
    ripple_phase_rad: float = 0.0
    law: str = "orifice"  # and its numbers, see `rtid.sim.valve_laws`
    law_a: float = 0.0
    law_b: float = 0.0

    def row(self) -> tuple[float, ...]:
        """Its row of the valve table."""
        return astuple(replace(self, law=LAWS.index(self.law)))  # type: ignore[arg-type]


DEFAULT_VALVES = (  # in the order of EDGES; one type, with the scatter of a series
    Valve(gain=3.6e-8, deadband_v=1.70, ripple=0.12, ripple_phase_rad=0.5),
    Valve(gain=4.1e-8, deadband_v=1.85, ripple=0.15, ripple_phase_rad=2.0),
    Valve(gain=3.5e-8, deadband_v=1.75, ripple=0.10, ripple_phase_rad=3.5),
    Valve(gain=3.9e-8, deadband_v=1.80, ripple=0.14, ripple_phase_rad=5.0),
    Valve(gain=1.2e-8, deadband_v=1.80, ripple=0.10, ripple_phase_rad=1.0),
)


@compiled
def above_deadband(valve: FloatArray, w_v: float) -> float:
    """r(w) in V: 0 below the dead band, w - deadband above it, the corner rounded.

    valve (columns,): a row of the valve table.
    """
    corner: float = valve[CORNER]
    r: float = w_v - valve[DEADBAND]
    if r <= -0.5 * corner:
        return 0.0
    if r >= 0.5 * corner:
        return r
    t = r / corner + 0.5
    return corner * t**3 * (1.0 - 0.5 * t)


@compiled
def overlapped_gain(valve: FloatArray, w_v: float) -> float:
    """K(w) of valve (columns,) whose overlap leaks before it ends, m3/s/sqrt(Pa)."""
    open_ = 1.0 + (w_v - valve[DEADBAND]) / valve[LAW_B]
    if open_ <= 0.0:
        return 0.0
    r = above_deadband(valve, w_v)
    k: float = valve[GAIN] * (valve[LAW_A] * min(open_, 1.0) ** 2 + r + valve[CURVE] * r * r)
    return k


@compiled
def flow_gain(valve: FloatArray, w_v: float) -> float:
    """K(w) in m3/s/sqrt(Pa) of valve (columns,), a row of the valve table."""
    if valve[LAW] == OVERLAP:
        return overlapped_gain(valve, w_v)
    r = above_deadband(valve, w_v)
    if r == 0.0:
        return 0.0
    phase, rate = valve[PHASE], valve[RATE]
    wave: float = valve[RIPPLE] * (math.cos(phase) - math.cos(rate * r + phase)) / rate
    rise: float = r + valve[CURVE] * r * r + wave
    if valve[LAW] == NOTCH:
        end = valve[LAW_A]
        rise *= 0.5 * r / end if r < end else (valve[LAW_B] * (r - end) + 0.5 * end) / r
    elif valve[LAW] == JUMP:
        rise += valve[LAW_A]
    k: float = valve[GAIN] * rise
    return k


@compiled
def metered_flow(valve: FloatArray, gain: float, dp_pa: float, dp_laminar_pa: float) -> float:
    """Q in m3/s of a flow gain K by the law of valve (columns,), a row of the valve table."""
    q: float = law_flow(
        valve[LAW], valve[LAW_A], valve[LAW_B], valve[GAIN], gain, dp_pa, dp_laminar_pa
    )
    return q


@compiled
def flow_points(
    valve: FloatArray, w_v: FloatArray, dp_pa: FloatArray, dp_laminar_pa: float, q_m3s: FloatArray
) -> None:
    """Fill q_m3s (n,) in place with the flow at the points w_v (n,), dp_pa (n,)."""
    for i in range(len(q_m3s)):
        q_m3s[i] = metered_flow(valve, flow_gain(valve, w_v[i]), dp_pa[i], dp_laminar_pa)


@dataclass(frozen=True)
class SimulatedPlant:
    """One machine: what is true of it.  The defaults are a neutral machine of the rig's size.

    A valve opens with w = direction * u; direction 0 keeps it shut (the cross-port, by default).
    """

    constants: Constants = field(default_factory=Constants)
    controller: Controller = field(default_factory=Controller)
    valves: tuple[Valve, ...] = DEFAULT_VALVES
    directions: tuple[int, ...] = (1, -1, -1, 1, 0)
    lag_s: float = 1.3e-3
    p_supply_pa: float = 7e6
    p_tank_pa: float = 1e5
    extra: Extra = NONE  # physics besides the equations above, see `rtid.sim.hidden`
    hidden: tuple[Planted, ...] = ()

    @property
    def beta_pa(self) -> float:
        """Bulk modulus, the inverse of the theta_beta to be found."""
        return self.constants.beta_pa

    @property
    def edges(self) -> tuple[str, ...]:
        """Names of the edges that this machine can open."""
        return tuple(e for e, direction in zip(EDGES, self.directions, strict=True) if direction)

    def valve_table(self) -> FloatArray:
        """The five valves as rows, float64 (5, columns), SI."""
        return np.array([valve.row() for valve in self.valves])

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """True Q(w, dp) of an edge in m3/s; w_v and dp_pa broadcast against each other."""
        w, dp = np.broadcast_arrays(np.asarray(w_v, float), np.asarray(dp_pa, float))
        q = np.empty(w.size)
        valve = self.valve_table()[EDGES.index(edge)]
        flow_points(valve, w.ravel(), dp.ravel(), self.constants.dp_laminar_pa, q)
        return q.reshape(w.shape)

    def gravity_n(self, x_m: float) -> float:
        """Load of the boom at the position x."""
        c = self.constants
        return c.gravity_n + c.gravity_slope_npm * (x_m - 0.5 * c.stroke_m)


def smooth_plant() -> SimulatedPlant:
    """The default machine without dead band: every K(w) is a quadratic for w >= 0."""
    valve = Valve(deadband_v=0.0, corner_v=0.0, curve_1pv=0.03)
    return SimulatedPlant(valves=(valve,) * 5, controller=Controller(deadband_v=0.0))
