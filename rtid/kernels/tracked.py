"""The learned machine under a position controller that has a map: what its tracking error will be.

The chambers follow (14) as in a free run, and the piston follows its load.  With signed areas a,
M dP/dt = f - a v of the chambers and the force F(t) = a'P that the record tells,

    a' dP/dt = dF/dt   =>   v = (a' M^-1 f - dF/dt) / (a' M^-1 a)               (no mass declared)
    m dv/dt  = a'P - g(x, v) - L(t),  L = F - m d2x/dt2 - g of the record       (mass declared)

with the gravity and friction g that are declared.

The controller reads pressures and position with their noise, looks its own tables up backwards for
the flows that it wants, and its commands hold over the next interval.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rtid.kernels.control_law import RobustLaw, wanted_flows
from rtid.kernels.engine import remember, set_step
from rtid.kernels.free_run import sides, solved, spools
from rtid.kernels.jit import kernel, part
from rtid.kernels.layout import MAX_EDGES, MAX_SIGNALS, NOTHING
from rtid.kernels.look_up import opening
from rtid.kernels.map_point import foot_width
from rtid.plain import FloatArray, IntArray

SUBSTEPS = 8  # of Runge-Kutta's fourth order in every interval of the record
INSANE_PA = 1e9
# Which edge carries a wanted flow: into and out of each chamber.  Those that drain come first, so
# that where one command moves both, the edge that feeds decides.
ROLES = ("out of a", "out of b", "into a", "into b")


class Tables(NamedTuple):
    """What the controller has, by ROLES: w_v (nu,), s (ns,), flow (nu, ns), m3/s, rising with w.

    edge (4,): of the model, -1 where there is none.
    """

    edge: IntArray
    w_v: tuple[FloatArray, ...]
    s: tuple[FloatArray, ...]
    flow_m3s: tuple[FloatArray, ...]


class Steering(NamedTuple):
    """The controller's numbers, SI; rate: of a command, its unit per second."""

    kp_1ps: float
    ki_1ps2: float
    rate_1ps: float
    is_robust: bool
    law: RobustLaw
    position: int  # column of the position among the signals


@kernel
def track(
    engine: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    steering: Steering,
    tables: Tables,
    samples: FloatArray,
    ref: FloatArray,
    load_n: FloatArray,
    noise: FloatArray,
    steps: FloatArray,
    state: FloatArray,
) -> int:
    """How many of n samples were run before a pressure ran away; state is filled.

    engine (1,): freshly built, used up; theta (cells, 6) m3/s, theta_beta (chambers,) 1/Pa, overlap
    as of `free_run`; samples (n, 2 + signals) SI, whose commands and position are overwritten;
    ref (n, 4): x, v, a, jerk; load_n (n,); noise, steps (n, signals), (signals,): of the sensors;
    state (n, 4): P_a, P_b, x, v, its first row the start.
    """
    e = engine[0]
    y, now = state[0].copy(), np.zeros(MAX_SIGNALS + 1)
    foot, scratch, summed = np.zeros(MAX_EDGES), np.zeros((3, 4)), 0.0
    for i in range(e.n_edges):
        foot[i] = foot_width(e, i, overlap)
    for k in range(len(samples)):
        sample = samples[k]
        for j in range(2 + e.n_signals):
            e.sample[j] = sample[j]
        if k > 0:
            dt = sample[0] - e.t_s
            set_step(e, dt)
            spools(e, dt)
            e.sample[2 + steering.position] = y[2]
            load, rise = load_n[k - 1], load_n[k] - load_n[k - 1]
            _step(e, theta, theta_beta, overlap, foot, steering, load, rise, dt, y, now, scratch)
            if not (abs(y[0]) < INSANE_PA and abs(y[1]) < INSANE_PA):
                return k
        state[k] = y
        for c in range(e.n_chambers):
            e.sample[2 + e.p_column[c]] = y[c]
        e.sample[2 + steering.position] = y[2]
        for j in range(e.n_signals):
            now[j] = _quantised(e.sample[2 + j] + noise[k, j], steps[j])
        now[NOTHING] = 0.0
        dt = samples[min(k + 1, len(samples) - 1), 0] - sample[0]
        summed += dt * (ref[k, 0] - now[steering.position])
        _command(e, steering, tables, ref[k], summed, y[3], dt, now, steps)
        remember(e, e.sample)
        e.running = 1
    return len(samples)


@part
def _quantised(value: float, step: float) -> float:
    return value if step == 0.0 else step * math.floor(value / step + 0.5)


@part
def _command(
    e: Any,
    steering: Steering,
    tables: Tables,
    ref: FloatArray,
    summed: float,
    v: float,
    dt: float,
    now: FloatArray,
    steps: FloatArray,
) -> None:
    """Set the commands in e.sample by what the controller sees, now (signals + 1,).

    summed: integral of the position's error, m s; v: speed, m/s.
    """
    x = now[steering.position]
    if steering.is_robust:
        q0, q1 = wanted_flows(steering.law, x, v, now[e.p_column[0]], now[e.p_column[1]], ref)
    else:
        speed = ref[1] + steering.kp_1ps * (ref[0] - x) + steering.ki_1ps2 * summed
        q0, q1 = e.area_m2[0] * speed, e.area_m2[1] * speed
    for i in range(e.n_edges):
        e.sample[2 + e.command[i]] = 0.0
    for role in range(4):
        i, q = tables.edge[role], (q0 if role % 2 == 0 else q1)
        wanted = q if role > 1 else -q
        if i < 0 or not wanted > 0.0:
            continue
        dp = now[e.source[i]] - now[e.sink[i]]
        w = opening(tables.w_v[role], tables.s[role], tables.flow_m3s[role], wanted, dp)
        e.sample[2 + e.command[i]] = _quantised(e.direction[i] * w, steps[e.command[i]])
    most = steering.rate_1ps * dt
    for j in range(e.n_signals):
        for i in range(e.n_edges):
            if e.command[i] == j and e.running == 1:
                low, high = e.values[j] - most, e.values[j] + most
                e.sample[2 + j] = min(max(e.sample[2 + j], low), high)


@part
def _step(
    e: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    foot: FloatArray,
    steering: Steering,
    load: float,
    rise: float,
    dt: float,
    y: FloatArray,
    now: FloatArray,
    scratch: FloatArray,
) -> None:
    """Move y (4,) = (P_a, P_b, x, v) over dt seconds, in place; the load rises by `rise`, N."""
    h = dt / SUBSTEPS
    slope, total, trial = scratch[0], scratch[1], scratch[2]
    for n in range(SUBSTEPS):
        for j in range(4):
            total[j], trial[j] = 0.0, y[j]
        for stage in range(4):
            s = (n + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / SUBSTEPS
            _slopes(
                e, theta, theta_beta, overlap, foot, steering, load, rise, dt, s, trial, now, slope
            )
            weight, ahead = (1.0 if stage in (0, 3) else 2.0), (1.0 if stage == 2 else 0.5)
            for j in range(4):
                total[j] += weight * slope[j]
                trial[j] = y[j] + ahead * h * slope[j]
        for j in range(4):
            y[j] += h / 6.0 * total[j]
    if steering.law.c.mass_kg == 0.0:
        y[3] = slope[2]


@part
def _slopes(
    e: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    foot: FloatArray,
    steering: Steering,
    load: float,
    rise: float,
    dt: float,
    s: float,
    y: FloatArray,
    now: FloatArray,
    out: FloatArray,
) -> None:
    """out (4,) = dy/dt at the time s in [0, 1] of the interval."""
    f0, f1, m00, m01, m10, m11, _ = sides(e, theta, theta_beta, overlap, foot, y[2], dt, s, y, now)
    a0, a1 = e.area_m2[0], e.area_m2[1]
    if steering.law.c.mass_kg > 0.0:
        v, c = y[3], steering.law.c
        known = c.gravity_n + c.gravity_slope_npm * (y[2] - 0.5 * c.stroke_m)
        known += c.coulomb_n * math.tanh(v / c.coulomb_width_mps) + c.viscous_nspm * v
        out[3] = (a0 * y[0] + a1 * y[1] - known - load - s * rise) / c.mass_kg
    else:
        free0, free1 = solved(m00, m01, m10, m11, f0, f1)
        by0, by1 = solved(m00, m01, m10, m11, a0, a1)
        v = (a0 * free0 + a1 * free1 - rise / dt) / (a0 * by0 + a1 * by1)
        out[3] = 0.0
    out[0], out[1] = solved(m00, m01, m10, m11, f0 - a0 * v, f1 - a1 * v)
    out[2] = v
