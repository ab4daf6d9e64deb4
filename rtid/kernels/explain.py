"""Hold a fitted model against a trace: modelled flow, whitened innovations, filtered residual.

The model is given per grid cell, so that any map (estimated, calibrated, data sheet) can be held
against any trace.  Same holds, lag and block assignment as in `engine`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.kernels.engine import ROW_FLAG, SHUT, remember
from rtid.kernels.holds import second_order
from rtid.kernels.increments import flow_noise, mean_terms, mean_windowed, term_rates
from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import TAYLOR, TERMS
from rtid.kernels.rows import fade, innovations
from rtid.kernels.taking import bent_noise, resume, take
from rtid.plain import FloatArray

MEASURED, MODELLED = 0, 1


@kernel
def explain(
    engine: Any,
    cells: Any,
    theta: FloatArray,
    compliance: FloatArray,
    chunk: FloatArray,
    flow: FloatArray,
    cell: Any,
    innovation: FloatArray,
) -> None:
    """Rates over each interval and innovations at each row.  All outputs are changed in place.

    engine (1,), cells: a freshly built state (the engine is used up; its term_theta holds the
    coefficients of the shared terms); theta (cells, 6) m3/s in the basis of the state,
    compliance (chambers,) 1/Pa, chunk (n, 2 + signals).  flow (n - 1, chambers, 2): measured
    s A v and modelled right-hand side of (14), mean over the interval, m3/s; NaN where the trace
    has a gap or the point is off the grid.  cell (n - 1, edges): grid cell, -1 shut.
    innovation (n - 1, chambers): whitened, unit variance for a perfect model; NaN where no row.
    """
    e = engine[0]
    gap, work = np.zeros(2), np.zeros((2, 2))
    for k in range(len(chunk)):
        whole, joined, dt = take(e, chunk, k)
        sample, flags = e.sample, int(e.sample[1])
        if k > 0:
            flow[k - 1] = np.nan
            innovation[k - 1] = np.nan
            cell[k - 1] = SHUT
        if joined:
            _one(e, cells, theta, compliance, chunk, k, dt, flow[k - 1], cell[k - 1], gap)
            remember(e, sample)
            if (flags & ROW_FLAG) != 0:
                _innovate(e, gap, work, innovation[k - 1])
        else:
            gap[:] = 0.0
            resume(e, sample, whole)


@inlined
def _one(
    e: Any,
    cells: Any,
    theta: FloatArray,
    compliance: FloatArray,
    chunk: FloatArray,
    k: int,
    dt: float,
    flow: FloatArray,
    cell: Any,
    gap: FloatArray,
) -> None:
    """The interval to sample k, whose working points are on the grids."""
    sample = e.sample
    x0, x1 = e.values[e.x_column], sample[2 + e.x_column]
    for c in range(e.n_chambers):
        rate = (sample[2 + e.p_column[c]] - e.values[e.p_column[c]]) / dt
        v = e.v0_m3[c] + 0.5 * e.growth_m2[c] * (x0 + x1)
        flow[MEASURED + 2 * c] = e.area_m2[c] * (x1 - x0) / dt
        flow[MODELLED + 2 * c] = -v * rate * compliance[c]
        for j in range(e.n_terms):
            start, end = term_rates(e, j, sample, dt)
            flow[MODELLED + 2 * c] += e.term_sign[j, c] * e.term_theta[j] * 0.5 * (start + end)
        e.cov[c, c] += e.q_floor[c] * dt
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = e.target[i, 0], e.target[i, 1]
        if e.cell[i, 0] != SHUT:
            at = e.first_cell[i] + e.home[i, 0] * e.n_dp[i] + e.home[i, 1]
            cell[i] = at
            q = _mapped(e, theta, i, at) if e.map_basis[i] == TAYLOR else _windowed(e, theta, i)
            for c in range(e.n_chambers):
                flow[MODELLED + 2 * c] += e.sign[i, c] * q
            flow_noise(e, i, cells[at].slope, cells[at].missed, dt)
            bent_noise(e, chunk, k, i, cells[at].slope, dt)
    for c in range(e.n_chambers):
        gap[c] += (flow[MEASURED + 2 * c] - flow[MODELLED + 2 * c]) * dt


@inlined
def _mapped(e: Any, theta: FloatArray, i: int, at: int) -> float:
    """Mean flow of edge i over the interval, Taylor terms of its cell `at`."""
    mean_terms(e, i, e.home[i, 0], e.home[i, 1])
    q = 0.0
    for j in range(TERMS):
        q += e.phi[j] * theta[at, j]
    return q


@part
def _windowed(e: Any, theta: FloatArray, i: int) -> float:
    """The same for up to two by two windows that overlap."""
    u, p, q = e.target[i, 0], e.target[i, 1], 0.0
    for a in range(u, min(u + 2, e.n_u[i])):
        for b in range(p, min(p + 2, e.n_dp[i])):
            mean_windowed(e, i, a, b)
            for j in range(TERMS):
                q += e.phi[j] * theta[e.first_cell[i] + a * e.n_dp[i] + b, j]
    return q


@inlined
def _innovate(e: Any, gap: FloatArray, work: FloatArray, out: FloatArray) -> None:
    """Whitened innovation L^-1 gap, and the whitener's update P <- R S^-1 P, column by column.

    work (chambers, chambers) is scratch.
    """
    first, second = innovations(e, gap, 0.0, 0.0)
    out[0] = first
    if e.n_chambers == 2:
        out[1] = second
    fade(e, gap)
    for c in range(e.n_chambers):
        for k in range(e.n_chambers):
            work[c, k] = e.cov[k, c]
        fade(e, work[c])
    for c in range(e.n_chambers):
        for k in range(e.n_chambers):
            e.cov[k, c] = 0.5 * (work[c, k] + work[k, c])


@kernel
def filter_rows(
    t_s: FloatArray, rate: FloatArray, wn: float, zeta: float, period_s: float, out: FloatArray
) -> int:
    """Pass interval rates (n - 1, m), held over each interval, through H_f; sample every period_s.

    t_s (n,) instants.  out (rows, 1 + m) = [t, outputs] is changed in place; returns the number of
    rows.  A NaN interval restarts the filter; rows wait until it has settled again.
    """
    m, rows = rate.shape[1], 0
    a, b = np.empty((2, 2)), np.empty((2, 2))
    state = np.zeros((2, m))
    step, due, settle = 0.0, t_s[0], 6.0 / (zeta * wn)
    ready = t_s[0] + settle
    for k in range(len(rate)):
        dt = t_s[k + 1] - t_s[k]
        if dt != step:
            step = dt
            second_order(wn, zeta, dt, a, b)
        if not np.isfinite(rate[k]).all():
            state[:] = 0.0
            ready = t_s[k + 1] + settle
            continue
        for j in range(m):
            x0, x1 = state[0, j], state[1, j]
            state[0, j] = a[0, 0] * x0 + a[0, 1] * x1 + (b[0, 0] + b[0, 1]) * rate[k, j]
            state[1, j] = a[1, 0] * x0 + a[1, 1] * x1 + (b[1, 0] + b[1, 1]) * rate[k, j]
        if t_s[k + 1] > due - 0.5 * dt:
            due += period_s * max(1.0, math.ceil((t_s[k + 1] - due) / period_s))
            if t_s[k + 1] >= ready and rows < len(out):
                out[rows, 0] = t_s[k + 1]
                for j in range(m):
                    out[rows, 1 + j] = state[0, j]
                rows += 1
    return rows
