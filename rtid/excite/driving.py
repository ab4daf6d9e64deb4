"""The nominal machine under its controller, as one kernel: what a reference would make it do.

    m dv/dt = sum over the chambers of s_c A_c P_c - load(x) - viscous v - coulomb tanh(v / width)
    u       = deadband tanh(demand / blend) + volts_per_mps demand + offset,
    demand  = v_ref + kp (x_ref - x),            u = 0 where the valves are to be shut

The pressures are those of the free run (`kernels.free_run`) between samples, the piston goes on by
the symplectic Euler step: x over the interval from the speed at its start, the speed from the
pressures at its end.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rtid.kernels.engine import remember, set_step
from rtid.kernels.free_run import BEYOND, OFF_GRID, STAGES, interval, spools
from rtid.kernels.jit import kernel
from rtid.kernels.layout import MAX_EDGES, MAX_SIGNALS
from rtid.kernels.map_point import foot_width
from rtid.plain import FloatArray

STEP_S = 1e-3
X_REF, V_REF, OFFSET, SUPPLY, SHUT = range(5)  # columns of a reference


class Piston(NamedTuple):
    """The load on the piston: load_n at x_mid_m, against a growing x; friction; its stops."""

    mass_kg: float
    load_n: float
    load_slope_npm: float
    x_mid_m: float
    viscous_nspm: float
    coulomb_n: float
    width_mps: float = 4e-3
    least_m: float = -math.inf
    most_m: float = math.inf


class Control(NamedTuple):
    """The machine's position controller, see above; the command is cut at +-limit_v."""

    kp_1ps: float
    volts_per_mps: float
    deadband_v: float
    blend_mps: float = 4e-3
    limit_v: float = 10.0


class Places(NamedTuple):
    """Columns of the samples: command, supply and tank (-1: constant), position, chambers."""

    u: int
    supply: int
    tank: int
    x: int
    pressures: tuple[int, int]


@kernel
def drive(
    engine: Any,
    theta: FloatArray,
    compliance: FloatArray,
    overlap: float,
    piston: Piston,
    control: Control,
    places: Places,
    reference: FloatArray,
    start: FloatArray,
    sample: FloatArray,
    signals: FloatArray,
) -> int:
    """Fill signals (n, signals) in place; the number of samples until the map ended, else n.

    engine (1,): freshly built, used up; theta, compliance, overlap as in `free_run`; reference
    (n, 5) and start [P.., x, v] in SI; sample (2 + signals,): values of signals that stay.
    """
    e = engine[0]
    n_c = e.n_chambers
    p, now = np.zeros(2), np.zeros(MAX_SIGNALS + 1)
    slopes, foot = np.zeros((STAGES + 1, 2)), np.ones(MAX_EDGES)
    for i in range(e.n_edges):
        foot[i] = foot_width(e, i, overlap)
    for c in range(n_c):
        p[c] = start[c]
    x, v, h = start[n_c], start[n_c + 1], 1.0
    set_step(e, STEP_S)
    for k in range(len(reference)):
        r = reference[k]
        demand = r[V_REF] + control.kp_1ps * (r[X_REF] - x)
        u = control.deadband_v * math.tanh(demand / control.blend_mps)
        u += control.volts_per_mps * demand + r[OFFSET]
        u = min(max(u, -control.limit_v), control.limit_v)
        sample[0] = k * STEP_S
        sample[2 + places.u] = u if r[SHUT] == 0.0 else 0.0
        sample[2 + places.supply] = r[SUPPLY]
        sample[2 + places.x] = x
        for c in range(n_c):
            sample[2 + places.pressures[c]] = p[c]
        for j in range(e.n_signals):
            signals[k, j] = sample[2 + j]
        remember(e, sample)
        if k + 1 == len(reference):
            break
        sample[2 + places.supply] = reference[k + 1, SUPPLY]
        for j in range(2 + e.n_signals):
            e.sample[j] = sample[j]
        if not spools(e, STEP_S):
            return k
        x1 = x + STEP_S * v
        code, h = interval(e, theta, compliance, overlap, foot, x, x1, STEP_S, p, now, slopes, h)
        if code > BEYOND or code == OFF_GRID:
            return k
        x = x1
        force = -piston.load_n - piston.load_slope_npm * (x - piston.x_mid_m)
        force -= piston.coulomb_n * math.tanh(v / piston.width_mps)
        for c in range(n_c):
            force += e.area_m2[c] * p[c]
        damped = 1.0 + STEP_S * piston.viscous_nspm / piston.mass_kg
        v = (v + STEP_S * force / piston.mass_kg) / damped
        to = x + STEP_S * v
        if (v > 0.0 and to > piston.most_m) or (v < 0.0 and to < piston.least_m):
            v = 0.0
    return len(reference)
