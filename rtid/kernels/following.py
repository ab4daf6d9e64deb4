"""What a map says along a record: flow, its slopes and its standard deviation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.kernels.engine import SHUT, home_of, remember
from rtid.kernels.increments import mean_terms
from rtid.kernels.jit import kernel, part
from rtid.kernels.layout import PROPORTIONAL, TERMS
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
) -> None:
    """Means over intervals of what a map says along a record; outputs changed in place.

    engine (1,), cells: a freshly built state, or as the samples before the first left it; theta
    (cells, 6) m3/s, cov (cells, 6, 6) its covariance, or empty.  along (m, edges, 5), of the
    intervals that end with sample `first` and the m - 1 next ones, NaN for the one before sample 0:
    opening command w in V, Q in m3/s, dQ/dw in m3/s/V, dQ/ddp in m3/s/Pa, standard deviation of Q;
    all but w are 0 where shut, all NaN where the record has a gap or the point is off the grid.
    cell (m, edges): grid cell or -1.
    """
    e = engine[0]
    for k in range(first, first + len(along)):
        whole, joined, _ = take(e, chunk, k)
        if joined:
            _map_at(e, theta, cov, along[k - first], cell[k - first])
            remember(e, e.sample)
            continue
        along[k - first] = np.nan
        cell[k - first] = SHUT
        resume(e, e.sample, whole)


@part
def _map_at(e: Any, theta: FloatArray, cov: FloatArray, along: FloatArray, cell: IntArray) -> None:
    """Q and its slopes at the mean working point of each edge, by the terms of its block."""
    for i in range(e.n_edges):
        e.cell[i, 0], e.cell[i, 1] = home_of(e, i)
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
