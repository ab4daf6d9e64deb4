"""Whitened rows of every column at once, for the diagnosis of a record.

Columns stand in the order

    [ y | theta_beta per chamber | given series | 6 terms per block that still rings ]

A *given* column is any flow, integrated per interval beforehand.  Rows are means over m = `group`
measured positions.  An increment that comes after i of them is in the mean with the share
a = (m - i) / m, and the rest of it is added after the row.  So the flow noise q of an interval
enters the row and the gap alike, and the whitener of `rows` becomes one with correlated noise:

    S = P + sum a^2 q + R / m,  K = (P + sum a q) S^-1,  P <- P + sum q - K S K',  d <- d - K d

with row = L^-1 d as before; for m = 1 it is the same.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtid.kernels.engine import (
    GAP_FLAG,
    ROW_FLAG,
    SHUT,
    acceptable,
    commanded,
    remember,
    set_step,
    step_s,
    working_points,
)
from rtid.kernels.increments import flow_noise, mean_terms
from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import TERMS
from rtid.kernels.rows import position_noise, start_whitener

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

IN_GROUP, N_LOCAL, N_ROWS, N_HEAD = range(4)  # entries of `counts`
# entries of `noise`: P, the flow noise since the last row times 1, a and a^2, and the last row's S
GAP, PLAIN, SHARED, SQUARED, LAST = range(5)


@kernel
def collect(
    engine: Any,
    cells: Any,
    chunk: FloatArray,
    first: int,
    last: int,
    group: int,
    series: FloatArray,
    source: IntArray,
    sign: FloatArray,
    soft: FloatArray,
    d: FloatArray,
    later: FloatArray,
    place: IntArray,
    cell_of: IntArray,
    counts: IntArray,
    noise: FloatArray,
    rows: FloatArray,
) -> int:
    """Rows of the samples first <= k < last of chunk (n, 2 + signals); returns where it stopped.

    engine (1,), cells: a freshly built state.  series (n - 1, s): volumes per interval, m3; given
    column j takes sign[j, c] times series source[j, c] in chamber c.  soft (n, chambers): white
    variance of a row at each sample beyond that of the declared model, m6.  d, later (chambers,
    width):
    state of the columns and what is due after the next row; place (cells,): local place of a cell's
    block or -1; cell_of (places,): the inverse; counts, noise (5, 2, 2): see above; rows (most,
    chambers, width): whitened rows.  All of these are changed in place.  Stops early when places
    or rows run out.
    """
    e = engine[0]
    for k in range(first, last):
        if counts[N_ROWS] >= len(rows) or counts[N_LOCAL] + e.n_edges > len(cell_of):
            return k
        whole, joined, dt = _take(e, chunk, k)
        sample, flags = e.sample, int(e.sample[1])
        if joined:
            share = (group - counts[IN_GROUP]) / group
            _add_head(e, sample, dt, share, series[k - 1], source, sign, d, later)
            _add_blocks(e, cells, dt, share, d, later, place, cell_of, counts)
            _count_noise(e, share, noise)
            remember(e, sample)
            if (flags & ROW_FLAG) != 0:
                counts[IN_GROUP] += 1
                if counts[IN_GROUP] == group:
                    _whiten(e, soft[k], d, later, counts, noise, rows)
        else:
            e.running = 0
            if whole and (flags & ROW_FLAG) != 0:
                _begin(e, sample, group, soft[k], d, later, counts, noise)
    return last


@inlined
def _take(e: Any, chunk: FloatArray, k: int) -> tuple[bool, bool, float]:
    """Sample k into e.sample: (it can be used, it continues the last one on the grids, step)."""
    for j in range(2 + e.n_signals):
        e.sample[j] = chunk[k, j]
    sample, flags, dt = e.sample, int(e.sample[1]), step_s(e, e.sample[0])
    whole = acceptable(e, sample)
    joined = whole and e.running and 0.0 < dt <= e.max_gap_s and (flags & GAP_FLAG) == 0
    if joined:
        if dt != e.dt_s:
            set_step(e, dt)
        joined = working_points(e, sample, dt)[0]
    return whole, joined, dt


@inlined
def _begin(
    e: Any,
    sample: FloatArray,
    group: int,
    soft: FloatArray,
    d: FloatArray,
    later: FloatArray,
    counts: IntArray,
    noise: FloatArray,
) -> None:
    """Start at one measured position, which has `group` times the white noise of a row."""
    remember(e, sample)
    e.running = 1
    for i in range(e.n_edges):
        e.w_v[i] = commanded(e, i)
        e.cell[i, 0] = SHUT
    start_whitener(e)
    noise[:] = 0.0
    for c in range(e.n_chambers):
        for b in range(e.n_chambers):
            noise[GAP, c, b] = group * (e.cov[c, b] + (soft[c] if b == c else 0.0))
            noise[LAST, c, b] = noise[GAP, c, b]
            e.cov[c, b] = 0.0
    counts[IN_GROUP] = 0
    d[:] = 0.0
    later[:] = 0.0


@inlined
def _add_head(
    e: Any,
    sample: FloatArray,
    dt: float,
    share: float,
    series: FloatArray,
    source: IntArray,
    sign: FloatArray,
    d: FloatArray,
    later: FloatArray,
) -> None:
    """What the interval adds to y, -V dP and the given columns."""
    x0, x1, given = e.values[e.x_column], sample[2 + e.x_column], 1 + e.n_chambers
    for c in range(e.n_chambers):
        dx = e.area_m2[c] * (x1 - x0)
        v = e.v0_m3[c] + 0.5 * e.area_m2[c] * (x0 + x1)
        dp = -e.compliance[c] * v * (sample[2 + e.p_column[c]] - e.values[e.p_column[c]])
        d[c, 0] += share * dx
        later[c, 0] += (1.0 - share) * dx
        d[c, 1 + c] += share * dp
        later[c, 1 + c] += (1.0 - share) * dp
        for j in range(len(source)):
            if sign[j, c] != 0.0:
                value = sign[j, c] * series[source[j, c]]
                d[c, given + j] += share * value
                later[c, given + j] += (1.0 - share) * value
        e.cov[c, c] += e.q_floor[c] * dt


@part
def _add_blocks(
    e: Any,
    cells: Any,
    dt: float,
    share: float,
    d: FloatArray,
    later: FloatArray,
    place: IntArray,
    cell_of: IntArray,
    counts: IntArray,
) -> None:
    """What the interval adds to the terms of the blocks that the working points are in."""
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = e.target[i, 0], e.target[i, 1]
        if e.cell[i, 0] == SHUT:
            continue
        at = e.first_cell[i] + e.cell[i, 0] * e.n_dp[i] + e.cell[i, 1]
        if place[at] < 0:
            place[at] = counts[N_LOCAL]
            cell_of[counts[N_LOCAL]] = at
            counts[N_LOCAL] += 1
        mean_terms(e, i, e.cell[i, 0], e.cell[i, 1])
        column = counts[N_HEAD] + TERMS * place[at]
        for c in range(e.n_chambers):
            flow = e.sign[i, c] * e.scale_m3s[i] * dt
            for j in range(TERMS):
                d[c, column + j] += share * flow * e.phi[j]
                later[c, column + j] += (1.0 - share) * flow * e.phi[j]
        flow_noise(e, i, cells[at].slope, cells[at].missed, dt)


@inlined
def _count_noise(e: Any, share: float, noise: FloatArray) -> None:
    """Move the flow noise of one interval from e.cov to where the next row finds it."""
    for c in range(e.n_chambers):
        for b in range(e.n_chambers):
            q = e.cov[c, b]
            noise[PLAIN, c, b] += q
            noise[SHARED, c, b] += share * q
            noise[SQUARED, c, b] += share * share * q
            e.cov[c, b] = 0.0


@part
def _whiten(
    e: Any,
    soft: FloatArray,
    d: FloatArray,
    later: FloatArray,
    counts: IntArray,
    noise: FloatArray,
    rows: FloatArray,
) -> None:
    """One whitened row of all columns, then d <- d - K d + what was due later."""
    n, row = counts[N_HEAD] + TERMS * counts[N_LOCAL], rows[counts[N_ROWS]]
    s00 = noise[GAP, 0, 0] + noise[SQUARED, 0, 0] + position_noise(e, 0, 0) + soft[0]
    c00 = noise[GAP, 0, 0] + noise[SHARED, 0, 0]
    i0, noise[LAST, 0, 0] = 1.0 / math.sqrt(s00), s00
    if e.n_chambers == 1:
        keep = 1.0 - c00 / s00
        for j in range(n):
            row[0, j] = i0 * d[0, j]
            d[0, j] = keep * d[0, j] + later[0, j]
        noise[GAP, 0, 0] += noise[PLAIN, 0, 0] - c00 * c00 / s00
    else:
        s01 = noise[GAP, 0, 1] + noise[SQUARED, 0, 1] + position_noise(e, 0, 1)
        s11 = noise[GAP, 1, 1] + noise[SQUARED, 1, 1] + position_noise(e, 1, 1) + soft[1]
        c01 = noise[GAP, 0, 1] + noise[SHARED, 0, 1]
        c11 = noise[GAP, 1, 1] + noise[SHARED, 1, 1]
        half, noise[LAST, 1, 1] = s01 * i0, s11
        i1 = 1.0 / math.sqrt(s11 - half * half)
        det = 1.0 / (s00 * s11 - s01 * s01)
        k00, k01 = (c00 * s11 - c01 * s01) * det, (c01 * s00 - c00 * s01) * det
        k10, k11 = (c01 * s11 - c11 * s01) * det, (c11 * s00 - c01 * s01) * det
        for j in range(n):
            d0, d1 = d[0, j], d[1, j]
            row[0, j] = i0 * d0
            row[1, j] = i1 * (d1 - half * i0 * d0)
            d[0, j] = d0 - k00 * d0 - k01 * d1 + later[0, j]
            d[1, j] = d1 - k10 * d0 - k11 * d1 + later[1, j]
        noise[GAP, 0, 0] += noise[PLAIN, 0, 0] - k00 * c00 - k01 * c01
        noise[GAP, 1, 1] += noise[PLAIN, 1, 1] - k10 * c01 - k11 * c11
        noise[GAP, 0, 1] += noise[PLAIN, 0, 1] - 0.5 * (
            k00 * c01 + k01 * c11 + k10 * c00 + k11 * c01
        )
        noise[GAP, 1, 0] = noise[GAP, 0, 1]
    noise[PLAIN:LAST] = 0.0
    later[:, :n] = 0.0
    counts[IN_GROUP] = 0
    counts[N_ROWS] += 1


@kernel
def follow_map(
    engine: Any,
    cells: Any,
    theta: FloatArray,
    cov: FloatArray,
    chunk: FloatArray,
    along: FloatArray,
    cell: IntArray,
) -> None:
    """Means over each interval of what a map says along a record; outputs changed in place.

    engine (1,), cells: a freshly built state; theta (cells, 6) m3/s, cov (cells, 6, 6) its
    covariance.  along (n - 1, edges, 5): opening command w in V, Q in m3/s, dQ/dw in m3/s/V, dQ/ddp
    in m3/s/Pa, standard deviation of Q; all but w are 0 where shut, all NaN where the record has a
    gap or the point is off the grid.  cell (n - 1, edges): grid cell or -1.
    """
    e = engine[0]
    for k in range(len(chunk)):
        whole, joined, _ = _take(e, chunk, k)
        sample, flags = e.sample, int(e.sample[1])
        if joined:
            _map_at(e, theta, cov, along[k - 1], cell[k - 1])
            remember(e, sample)
            continue
        if k > 0:
            along[k - 1] = np.nan
            cell[k - 1] = SHUT
        e.running = 0
        if whole and (flags & ROW_FLAG) != 0:
            remember(e, sample)
            e.running = 1
            for i in range(e.n_edges):
                e.w_v[i] = commanded(e, i)
                e.cell[i, 0] = SHUT


@part
def _map_at(e: Any, theta: FloatArray, cov: FloatArray, along: FloatArray, cell: IntArray) -> None:
    """Q and its slopes at the mean working point of each edge, by the terms of its block."""
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = e.target[i, 0], e.target[i, 1]
        along[i] = 0.0
        along[i, 0] = e.direction[i] * e.values[e.command[i]]
        cell[i] = SHUT
        if e.cell[i, 0] == SHUT:
            continue
        iu, ip = e.cell[i, 0], e.cell[i, 1]
        at = e.first_cell[i] + iu * e.n_dp[i] + ip
        cell[i] = at
        mean_terms(e, i, iu, ip)
        th, phi = theta[at], e.phi
        hu = 2.0 / (e.u_border[i, iu + 1] - e.u_border[i, iu])
        hp = 2.0 / (e.dp_border[i, ip + 1] - e.dp_border[i, ip])
        q, variance = 0.0, 0.0
        for j in range(TERMS):
            q += phi[j] * th[j]
            for m in range(TERMS):
                variance += phi[j] * cov[at, j, m] * phi[m]
        along[i, 0] = e.moments[i, 0]
        along[i, 1] = q
        along[i, 2] = hu * (th[1] + 2.0 * th[3] * phi[1] + th[5] * phi[2])
        along[i, 3] = hp * (th[2] + 2.0 * th[4] * phi[2] + th[5] * phi[1])
        along[i, 4] = math.sqrt(max(0.0, variance))


@kernel
def add_products(total: FloatArray, columns: IntArray, gram: FloatArray) -> None:
    """Lower triangle of total[columns, columns] += gram, in place."""
    for i in range(len(columns)):
        at = columns[i]
        row, own = total[at], gram[i]
        for j in range(len(columns)):
            if columns[j] <= at:
                row[columns[j]] += own[j]
