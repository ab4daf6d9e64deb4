"""What a map says along a record: flow, its slopes and its standard deviation.

The slope by the command says what a lag takes.  Within a block it is that of its terms; where the
working point has left another block, or opens or shuts, by what the whole map rises at this drop,

    dQ/dw = (Q(w, dp) - Q(w before, dp)) / (w - w before),

so that it holds the step from one polynomial to the next: of all lags a little off some have a
sample on this side of a border and some on the other.  On ramps through half a block a sample the
terms alone sent a lag of 2 ms to 1.9, of 4.84, where chi2 fell by 3,000 on the other side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.kernels.engine import SHUT, home_of, remember
from rtid.kernels.increments import mean_terms
from rtid.kernels.jit import kernel, part
from rtid.kernels.layout import PROPORTIONAL, TAYLOR, TERMS
from rtid.kernels.taking import resume, take
from rtid.plain import FloatArray, IntArray


@kernel
def follow_map(
    engine: Any,
    cells: Any,
    theta: FloatArray,
    cov: FloatArray,
    chunk: FloatArray,
    first: int,
    along: FloatArray,
    cell: IntArray,
    was: FloatArray,
) -> None:
    """Means over intervals of what a map says along a record; outputs changed in place.

    engine (1,), cells: a freshly built state, or as the samples before the first left it; theta
    (cells, 6) m3/s, cov (cells, 6, 6) its covariance, or empty.  along (m, edges, 5), of the
    intervals that end with sample `first` and the m - 1 next ones, NaN for the one before sample 0:
    opening command w in V, Q in m3/s, dQ/dw in m3/s/V, dQ/ddp in m3/s/Pa, standard deviation of Q;
    all but w are 0 where shut, all NaN where the record has a gap or the point is off the grid.
    cell (m, edges): grid cell or -1.  was (edges, 2): mean w in V and interval of the grid, or
    SHUT, of the sample before `first`; NaN where there is none.
    """
    e = engine[0]
    for k in range(first, first + len(along)):
        whole, joined, _ = take(e, chunk, k)
        if joined:
            _map_at(e, theta, cov, along[k - first], cell[k - first], was)
            remember(e, e.sample)
            continue
        along[k - first] = np.nan
        cell[k - first] = SHUT
        was[:] = np.nan
        resume(e, e.sample, whole)


@part
def _map_at(
    e: Any,
    theta: FloatArray,
    cov: FloatArray,
    along: FloatArray,
    cell: IntArray,
    was: FloatArray,
) -> None:
    """Q and its slopes at the mean working point of each edge, by the terms of its block."""
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = home_of(e, i)
        along[i] = 0.0
        along[i, 0] = e.direction[i] * e.values[e.command[i]]
        cell[i] = SHUT
        if e.cell[i, 0] == SHUT:
            along[i, 2] = _risen(e, theta, i, 0.5 * (e.start_v[i] + e.w_v[i]), 0.0, was[i], 0.0)
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
            if len(cov) > 0:
                for m in range(TERMS):
                    variance += phi[j] * cov[at, j, m] * phi[m]
        along[i, 0] = e.moments[i, 0]
        along[i, 1] = q
        along[i, 2] = hu * (th[1] + 2.0 * th[3] * phi[1] + th[5] * phi[2])
        if e.map_basis[i] == PROPORTIONAL:
            along[i, 2] = q / e.moments[i, 0] if e.moments[i, 0] != 0.0 else 0.0
        along[i, 3] = hp * (th[2] + 2.0 * th[4] * phi[2] + th[5] * phi[1])
        along[i, 4] = math.sqrt(max(0.0, variance))
        along[i, 2] = _risen(e, theta, i, along[i, 0], q, was[i], along[i, 2])


@part
def _risen(
    e: Any, theta: FloatArray, i: int, w: float, q: float, was: FloatArray, slope: float
) -> float:
    """What the map of edge i rises per volt to w, where it is q, from another block; else slope.

    was (2,) becomes this sample's.
    """
    before, left = was[0], was[1]
    was[0], was[1] = w, e.cell[i, 0]
    if left == e.cell[i, 0] or not abs(w - before) > 0.0 or e.map_basis[i] != TAYLOR:
        return slope
    q_before = 0.0
    if left != SHUT:
        iu, ip = int(left), e.cell[i, 1]
        at = e.first_cell[i] + iu * e.n_dp[i] + ip
        e.moments[i, 0], e.moments[i, 1], e.moments[i, 2] = before, before * before, 0.0
        mean_terms(e, i, iu, ip)
        is_known = False
        for j in range(TERMS):
            q_before += e.phi[j] * theta[at, j]
            is_known = is_known or theta[at, j] != 0.0
        if not is_known:
            return slope
    return (q - q_before) / (w - before)
