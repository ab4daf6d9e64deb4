"""Free run: the pressures that the model itself predicts, from a measured start.

Per chamber the pressure equation (14), solved for the pressure instead of the flow,

    V_c(x) theta_beta_c dP_c/dt = sum of sigma Q(w, dp) + shared terms - s_c A_c dx/dt,

with the model's own P_c in dp and in the terms; the lagged command, the position and all other
signals are inputs (u held, sensors linear between samples).  Shared terms that are rates of a
pressure make the left side a 2 x 2 matrix.  Q is the published map (`published`).

Integration: Dormand-Prince 5(4) with steps controlled to TOLERANCE_PA inside every interval, so
that a stiff chamber (small dp, wide open valve) takes more steps and not a wrong one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.kernels.engine import GAP_FLAG, acceptable, commanded, remember, set_step, step_s
from rtid.kernels.holds import lagged_moments
from rtid.kernels.increments import shaped
from rtid.kernels.jit import kernel, part
from rtid.kernels.layout import (
    FLOW,
    HINGE,
    INVERSE,
    MAX_EDGES,
    MAX_SIGNALS,
    NOTHING,
    RATE,
    ROOT,
)
from rtid.kernels.map_point import foot_width, map_flow, rise
from rtid.plain import FloatArray

# How the pressure of a sample came about.  BEYOND: a pressure drop was off its grid on the way.
# GAP to RAN_AWAY end a run, which begins anew at that sample; no pressure is predicted there.
START, INSIDE, BEYOND, GAP, OFF_GRID, RAN_AWAY = range(6)
STATUSES = ("start", "inside", "beyond", "gap", "off_grid", "ran_away")

TOLERANCE_PA = 0.01  # error of one step
MOST_STEPS = 500  # in one interval; more: the model is no machine
INSANE_PA = 1e9
SAFETY, SHRINK, GROW = 0.9, 0.2, 4.0

# Dormand and Prince 1980: stages (7, 6), nodes (7,), and the error's weights (7,); row 6 steps on.
A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
NODE = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
ERROR = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
STAGES = 7


@kernel
def free_run(
    engine: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    chunk: FloatArray,
    position: FloatArray,
    period_s: float,
    pressure: FloatArray,
    status: Any,
) -> None:
    """Predicted pressures at all samples; pressure and status are changed in place.

    engine (1,): freshly built, used up; its term_theta holds the coefficients of the shared terms.
    theta (cells, 6) m3/s, Taylor terms; theta_beta (chambers,) 1/Pa; overlap: half the overlap of
    the windows in widths of the narrower neighbour.  chunk (n, 2 + signals), position (n,) smooth.
    period_s: the run begins anew from the measurement so often; inf: only after a stop.
    pressure (n, chambers) Pa, NaN where a run was stopped; status (n,): the codes above.
    """
    e = engine[0]
    p, now = np.zeros(2), np.zeros(MAX_SIGNALS + 1)
    foot, slopes = np.ones(MAX_EDGES), np.zeros((STAGES + 1, 2))
    for i in range(e.n_edges):
        foot[i] = foot_width(e, i, overlap)
    due, h = 0.0, 1.0
    for k in range(len(chunk)):
        for j in range(2 + e.n_signals):
            e.sample[j] = chunk[k, j]
        sample, dt = e.sample, step_s(e, e.sample[0])
        whole = acceptable(e, sample)
        joined = whole and e.running and dt > 0.0 and dt <= e.max_gap_s
        joined = joined and (int(sample[1]) & GAP_FLAG) == 0
        code = GAP
        if joined:
            if dt != e.dt_s:
                set_step(e, dt)
            code = OFF_GRID
            if spools(e, dt):
                x0, x1 = position[k - 1], position[k]
                code, h = interval(
                    e, theta, theta_beta, overlap, foot, x0, x1, dt, p, now, slopes, h
                )
        pressure[k], status[k] = np.nan, code
        e.running = 0
        if whole:
            remember(e, sample)
            e.running = 1
        if whole and not joined:
            for i in range(e.n_edges):
                e.w_v[i] = commanded(e, i)
        restart = whole and (code > BEYOND or sample[0] > due - 0.5 * dt)
        if restart:
            for c in range(e.n_chambers):
                p[c] = e.values[e.p_column[c]]
            due = sample[0] + period_s
            if code <= BEYOND or k == 0:
                status[k] = START
        if status[k] <= BEYOND:
            for c in range(e.n_chambers):
                pressure[k, c] = p[c]


@part
def spools(e: Any, dt: float) -> bool:
    """Move the spools over the interval; False where an open one is off its grid."""
    inside = True
    for i in range(e.n_edges):
        u, n = commanded(e, i), e.n_u[i]
        end, mean, _, _ = lagged_moments(u, e.w_v[i], e.lag_s, e.lag_decay, dt)
        e.held_v[i], e.start_v[i], e.w_v[i] = u, e.w_v[i], end
        if mean > e.safe_v[i]:
            inside = inside and mean >= e.u_border[i, 0] and mean <= e.u_border[i, n]
    return inside


@part
def interval(
    e: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    foot: FloatArray,
    x0: float,
    x1: float,
    dt: float,
    p: FloatArray,
    now: FloatArray,
    slopes: FloatArray,
    h: float,
) -> tuple[int, float]:
    """Integrate p (chambers,), in place, over one interval; its status and the next first step.

    Time runs from 0 to 1 in units of the interval; h: first step to try.  slopes (STAGES + 1, 2)
    and now (signals + 1,) are scratch.
    """
    s, h, code, trial = 0.0, min(1.0, h), INSIDE, slopes[STAGES]
    off = _rates(e, theta, theta_beta, overlap, foot, x0, x1, dt, s, p, now, slopes[0])
    off_first = off
    for _ in range(MOST_STEPS):
        h = min(h, 1.0 - s)
        error = 0.0
        beyond = off_first
        for stage in range(1, STAGES):
            for c in range(e.n_chambers):
                trial[c] = p[c]
                for j in range(stage):
                    trial[c] += h * A[stage, j] * slopes[j, c]
            at = s + NODE[stage] * h
            off = _rates(
                e, theta, theta_beta, overlap, foot, x0, x1, dt, at, trial, now, slopes[stage]
            )
            beyond = beyond or off
        for c in range(e.n_chambers):
            missed = 0.0
            for j in range(STAGES):
                missed += ERROR[j] * slopes[j, c]
            error = max(error, abs(h * missed))
        if not error < INSANE_PA:
            h *= SHRINK
            continue
        factor = SAFETY * (TOLERANCE_PA / max(error, 1e-30)) ** 0.2
        if error <= TOLERANCE_PA:
            s += h
            off_first = off
            if beyond:
                code = BEYOND
            for c in range(e.n_chambers):
                p[c] = trial[c]  # the last stage is the new state, and the next step's first
                slopes[0, c] = slopes[STAGES - 1, c]
                if _is_away(e, c, p[c]):
                    return RAN_AWAY, 1.0
        if s >= 1.0 - 1e-12:
            return code, h * max(1.0, min(GROW, factor))
        h *= max(SHRINK, min(GROW, factor))
    return RAN_AWAY, 1.0


@part
def _is_away(e: Any, c: int, p: float) -> bool:
    """Whether a pressure is further out of its sensor's range than that range is wide."""
    low, high = e.minimum[e.p_column[c]], e.maximum[e.p_column[c]]
    span = high - low
    if span < INSANE_PA:
        return not (p >= low - span and p <= high + span)
    return not abs(p) < INSANE_PA


@part
def _rates(
    e: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    foot: FloatArray,
    x0: float,
    x1: float,
    dt: float,
    s: float,
    p: FloatArray,
    now: FloatArray,
    out: FloatArray,
) -> bool:
    """out (chambers,) = dt dP/dt at the time s in [0, 1]; True where a dp is beyond its grid.

    now (signals + 1,): scratch for the signals at that time.
    """
    x = x0 + s * (x1 - x0)
    f0, f1, m00, m01, m10, m11, beyond = sides(
        e, theta, theta_beta, overlap, foot, x, dt, s, p, now
    )
    f0 -= e.area_m2[0] * (x1 - x0) / dt
    f1 -= e.area_m2[1] * (x1 - x0) / dt
    rate0, rate1 = solved(m00, m01, m10, m11, f0, f1)
    out[0] = dt * rate0
    if e.n_chambers == 2:
        out[1] = dt * rate1
    return beyond


@part
def solved(
    m00: float, m01: float, m10: float, m11: float, f0: float, f1: float
) -> tuple[float, float]:
    """The rates of both pressures, Pa/s, of the flows into both chambers; see `sides`."""
    det = m00 * m11 - m01 * m10
    return (m11 * f0 - m01 * f1) / det, (m00 * f1 - m10 * f0) / det


@part
def sides(
    e: Any,
    theta: FloatArray,
    theta_beta: FloatArray,
    overlap: float,
    foot: FloatArray,
    x: float,
    dt: float,
    s: float,
    p: FloatArray,
    now: FloatArray,
) -> tuple[float, float, float, float, float, float, bool]:
    """Flows into both chambers, m3/s, the piston's not among them, and the matrix M of the rates.

    M (dP_a/dt, dP_b/dt) = flows less area x speed: M as (m00, m01, m10, m11), m3/Pa; whether a dp
    is beyond its grid.  p (chambers,) Pa at the time s in [0, 1] of an interval of dt seconds.
    """
    for j in range(e.n_signals):
        now[j] = e.values[j] + s * (e.sample[2 + j] - e.values[j])
    now[NOTHING] = 0.0
    for c in range(e.n_chambers):
        now[e.p_column[c]] = p[c]
    f0, f1, beyond = 0.0, 0.0, False
    behind = math.exp(-s * dt / e.lag_s) if e.lag_s > 0.0 else 0.0
    for i in range(e.n_edges):
        w = e.held_v[i]
        if e.start_v[i] != w:
            w += (e.start_v[i] - w) * behind
        if w > e.safe_v[i]:
            dp = now[e.source[i]] - now[e.sink[i]]
            q, off = map_flow(e, theta, i, overlap, w, dp)
            q *= rise((w - e.safe_v[i]) / foot[i] - 1.0) if foot[i] > 0.0 else 1.0
            f0, f1 = f0 + e.sign[i, 0] * q, f1 + e.sign[i, 1] * q
            beyond = beyond or off
    m00, m01 = (e.v0_m3[0] + e.growth_m2[0] * x) * theta_beta[0], 0.0
    m10, m11 = 0.0, 1.0
    if e.n_chambers == 2:
        m11 = (e.v0_m3[1] + e.growth_m2[1] * x) * theta_beta[1]
    for k in range(e.n_terms):
        flow, d0, d1 = _term(e, k, now, x, dt)
        f0, f1 = f0 + e.term_sign[k, 0] * flow, f1 + e.term_sign[k, 1] * flow
        m00, m01 = m00 + e.term_sign[k, 0] * d0, m01 + e.term_sign[k, 0] * d1
        m10, m11 = m10 + e.term_sign[k, 1] * d0, m11 + e.term_sign[k, 1] * d1
    return f0, f1, m00, m01, m10, m11, beyond


@part
def _term(e: Any, k: int, now: FloatArray, x: float, dt: float) -> tuple[float, float, float]:
    """Flow of shared term k without the pressures' own rates, and what stands before these."""
    theta, volume = e.term_theta[k] * e.term_scale[k], e.term_volume[k]
    if volume == FLOW:
        return theta * shaped(e, k, now, 0), 0.0, 0.0
    if volume != RATE:
        theta *= e.v0_m3[volume] + e.growth_m2[volume] * x
    z, rate, shape = e.term_constant[k], 0.0, e.term_shape[k]
    by_p0, by_p1 = 0.0, 0.0
    for j in range(e.n_signals):
        weight = e.term_weight[k, j]
        z += weight * now[j]
        if j == e.p_column[0]:
            by_p0 += weight
        elif e.n_chambers == 2 and j == e.p_column[1]:
            by_p1 += weight
        else:
            rate += weight * (e.sample[2 + j] - e.values[j]) / dt
    slope = 1.0
    if shape == ROOT:
        slope = 0.5 / math.sqrt(max(abs(z), 1.0))
    elif shape == HINGE:
        slope = 1.0 if z > 0.0 else 0.0
    elif shape == INVERSE:
        slope = 1.0 / (z * z)
    return -theta * slope * rate, theta * slope * by_p0, theta * slope * by_p1
