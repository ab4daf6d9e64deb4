"""A record as rows: what each row holds of y, of -V dP and of the maps, and how rows are whitened.

Rows are means over m = `group` measured positions.  An increment that comes after i of them is in
the mean with the share a = (m - i) / m, and the rest of it is added after the row.  So the flow
noise q of an interval enters the row and the gap alike, and the whitener of `rows` becomes one with
correlated noise:

    S = P + sum a^2 q + R / m,  K = (P + sum a q) S^-1,  P <- P + sum q - K S K'

With b_r what a column adds to row r, its rows are  d_r = A_r-1 d_r-1 + b_r,  L_r^-1 d_r,  with
A = I - K and L L' = S; for m = 1 it is the same as in `rows`.  All of it is known before any column
is: the columns of the maps are kept as they are, six terms per row and block that moved.
"""

from __future__ import annotations

import math
from typing import Any

from rtid.kernels.engine import ROW_FLAG, SHUT, home_of, remember
from rtid.kernels.increments import flow_noise, mean_terms
from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import TERMS
from rtid.kernels.rows import over, position_noise
from rtid.kernels.taking import bent_noise, resume, take
from rtid.plain import BoolArray, FloatArray, IntArray

IN_GROUP, N_ROWS, N_ENTRIES, GROUP_AT = range(4)  # entries of `counts`
# entries of `noise`: P, and the flow noise since the last row times 1, a and a^2
GAP, PLAIN, SHARED, SQUARED = range(4)
NO_ROW = -1


@kernel
def integrate(
    engine: Any,
    cells: Any,
    chunk: FloatArray,
    soft: FloatArray,
    first: int,
    group: int,
    counts: IntArray,
    noise: FloatArray,
    row_of: IntArray,
    share: FloatArray,
    b: FloatArray,
    fresh: BoolArray,
    whiten: FloatArray,
    A: FloatArray,
    start: IntArray,
    cell: IntArray,
    terms: FloatArray,
    later: FloatArray,
) -> int:
    """Rows of the samples k >= first of chunk (n, 2 + signals); returns where it stopped.

    engine (1,), cells: a freshly built state.  soft (n, chambers): white variance of a row at each
    sample beyond that of the declared model, m6.  row_of, share (n - 1,): row of an interval or -1,
    and its share a.  b (rows + 1, 2, 3): y and theta_beta per chamber; fresh (rows,): the row has
    none before it; whiten (rows, 3): 1 / L00, S01 / L00, 1 / L11; A (rows, 2, 2): I - K.  Row r
    has the entries start[r] to start[r + 1] of cell (most,) and terms (most, 6): what a block adds
    to it, m3 into a chamber that the edge feeds; later (most, 6) is due in the next row.
    counts (4,), noise (4, 2, 2): see above.  All of these are changed in place.  Stops early when
    entries run out.
    """
    e = engine[0]
    for k in range(first, len(chunk)):
        begun = counts[N_ENTRIES] - start[counts[N_ROWS]]
        if counts[N_ENTRIES] + begun + 2 * e.n_edges > len(cell):
            return k
        whole, joined, dt = take(e, chunk, k)
        sample, flags = e.sample, int(e.sample[1])
        if joined:
            a, r = (group - counts[IN_GROUP]) / group, counts[N_ROWS]
            row_of[k - 1], share[k - 1] = r, a
            _add_measured(e, sample, dt, a, b[r], b[r + 1])
            _add_blocks(e, cells, chunk, k, dt, a, counts, start[r], cell, terms, later)
            _count_noise(e, a, noise)
            remember(e, sample)
            if (flags & ROW_FLAG) != 0:
                counts[IN_GROUP] += 1
                if counts[IN_GROUP] == group:
                    _close_row(e, soft[k], noise, whiten[r], A[r])
                    counts[IN_GROUP], counts[GROUP_AT] = 0, k
                    counts[N_ROWS] += 1
                    _hand_on(counts, start, r, cell, terms, later)
        elif resume(e, sample, whole):
            row_of[counts[GROUP_AT] : k] = NO_ROW
            _begin_rows(e, soft[k], group, counts, noise, b, fresh, start)
            counts[GROUP_AT] = k
    return len(chunk)


@inlined
def _begin_rows(
    e: Any,
    soft: FloatArray,
    group: int,
    counts: IntArray,
    noise: FloatArray,
    b: FloatArray,
    fresh: BoolArray,
    start: IntArray,
) -> None:
    """Forget a group that was begun; one position has `group` times the white noise of a row."""
    r = counts[N_ROWS]
    counts[IN_GROUP], counts[N_ENTRIES] = 0, start[r]
    noise[:] = 0.0
    for c in range(e.n_chambers):
        for j in range(e.n_chambers):
            noise[GAP, c, j] = group * (e.cov[c, j] + (soft[c] if j == c else 0.0))
            e.cov[c, j] = 0.0
    b[r : r + 2] = 0.0
    if r < len(fresh):
        fresh[r] = True


@inlined
def _add_measured(
    e: Any, sample: FloatArray, dt: float, a: float, now: FloatArray, later: FloatArray
) -> None:
    """What the interval adds to y and -V dP, now and in the next row."""
    x0, x1 = e.values[e.x_column], sample[2 + e.x_column]
    for c in range(e.n_chambers):
        dx = e.area_m2[c] * (x1 - x0)
        v = e.v0_m3[c] + 0.5 * e.growth_m2[c] * (x0 + x1)
        dp = -e.compliance[c] * v * (sample[2 + e.p_column[c]] - e.values[e.p_column[c]])
        now[c, 0] += a * dx
        later[c, 0] += (1.0 - a) * dx
        now[c, 1 + c] += a * dp
        later[c, 1 + c] += (1.0 - a) * dp
        e.cov[c, c] += e.q_floor[c] * dt


@part
def _add_blocks(
    e: Any,
    cells: Any,
    chunk: FloatArray,
    k: int,
    dt: float,
    a: float,
    counts: IntArray,
    first: int,
    cell: IntArray,
    terms: FloatArray,
    later: FloatArray,
) -> None:
    """What the interval to sample k adds to the terms of the blocks that the points are in."""
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = home_of(e, i)
        if e.cell[i, 0] == SHUT:
            continue
        at = e.first_cell[i] + e.cell[i, 0] * e.n_dp[i] + e.cell[i, 1]
        n = first
        while n < counts[N_ENTRIES] and cell[n] != at:
            n += 1
        if n == counts[N_ENTRIES]:
            cell[n] = at
            terms[n] = 0.0
            later[n] = 0.0
            counts[N_ENTRIES] += 1
        mean_terms(e, i, e.cell[i, 0], e.cell[i, 1])
        flow = e.scale_m3s[i] * dt
        for j in range(TERMS):
            terms[n, j] += a * flow * e.phi[j]
            later[n, j] += (1.0 - a) * flow * e.phi[j]
        flow_noise(e, i, cells[at].slope, cells[at].missed, dt)
        bent_noise(e, chunk, k, i, cells[at].slope, dt)


@inlined
def _hand_on(
    counts: IntArray, start: IntArray, r: int, cell: IntArray, terms: FloatArray, later: FloatArray
) -> None:
    """Begin the entries of the row behind r with what is due in it."""
    first, n = start[r], counts[N_ENTRIES]
    start[r + 1] = n
    to = n
    for k in range(first, n):
        if later[k, 0] != 0.0:  # the constant term
            cell[to] = cell[k]
            for j in range(TERMS):
                terms[to, j], later[to, j] = later[k, j], 0.0
            to += 1
    counts[N_ENTRIES] = to


@inlined
def _count_noise(e: Any, a: float, noise: FloatArray) -> None:
    """Move the flow noise of one interval from e.cov to where the next row finds it."""
    for c in range(e.n_chambers):
        for b in range(e.n_chambers):
            q = e.cov[c, b]
            noise[PLAIN, c, b] += q
            noise[SHARED, c, b] += a * q
            noise[SQUARED, c, b] += a * a * q
            e.cov[c, b] = 0.0


@part
def _close_row(
    e: Any, soft: FloatArray, noise: FloatArray, whiten: FloatArray, A: FloatArray
) -> None:
    """L and A of one row, and P behind it."""
    s00 = noise[GAP, 0, 0] + noise[SQUARED, 0, 0] + position_noise(e, 0, 0) + soft[0]
    c00 = noise[GAP, 0, 0] + noise[SHARED, 0, 0]
    i0 = 1.0 / math.sqrt(s00)
    if e.n_chambers == 1:
        whiten[0], A[0, 0] = i0, 1.0 - c00 / s00
        noise[GAP, 0, 0] += noise[PLAIN, 0, 0] - c00 * c00 / s00
    else:
        s01 = noise[GAP, 0, 1] + noise[SQUARED, 0, 1] + position_noise(e, 0, 1)
        s11 = noise[GAP, 1, 1] + noise[SQUARED, 1, 1] + position_noise(e, 1, 1) + soft[1]
        c01 = noise[GAP, 0, 1] + noise[SHARED, 0, 1]
        c11 = noise[GAP, 1, 1] + noise[SHARED, 1, 1]
        half = s01 * i0
        whiten[0], whiten[1], whiten[2] = i0, half, 1.0 / math.sqrt(s11 - half * half)
        det = 1.0 / (s00 * s11 - s01 * s01)
        k00, k01, k10, k11 = over(c00, c01, c11, s00, s01, s11, det)
        A[0, 0], A[0, 1], A[1, 0], A[1, 1] = 1.0 - k00, -k01, -k10, 1.0 - k11
        noise[GAP, 0, 0] += noise[PLAIN, 0, 0] - k00 * c00 - k01 * c01
        noise[GAP, 1, 1] += noise[PLAIN, 1, 1] - k10 * c01 - k11 * c11
        noise[GAP, 0, 1] += noise[PLAIN, 0, 1] - 0.5 * (
            k00 * c01 + k01 * c11 + k10 * c00 + k11 * c01
        )
        noise[GAP, 1, 0] = noise[GAP, 0, 1]
    noise[PLAIN:] = 0.0


@kernel
def condense(
    series: FloatArray,
    row_of: IntArray,
    share: FloatArray,
    fresh: BoolArray,
    out: FloatArray,
) -> None:
    """What a series (n - 1,) per interval adds to each row, out (rows,), in its unit; in place."""
    n, rows, k = len(series), len(out), 0
    out[:] = 0.0
    while k < n:
        r = row_of[k]
        if r < 0 or r >= rows:
            k += 1
            continue
        now, later = 0.0, 0.0
        while k < n and row_of[k] == r:
            now += share[k] * series[k]
            later += (1.0 - share[k]) * series[k]
            k += 1
        out[r] += now
        if r + 1 < rows and not fresh[r + 1]:
            out[r + 1] += later
