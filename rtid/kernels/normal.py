"""Dense normal equations of the joint regression, read out of the sparse sums.

Unknowns in the order [shared (n_shared) | 6 terms of block 0 | 6 terms of block 1 | ...].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtid.kernels.jit import inlined, kernel
from rtid.kernels.layout import TERMS
from rtid.plain import FloatArray

SPLIT = 2.0**27 + 1.0  # cuts a double into two halves of 26 bits, whose products are exact
LANES = 8  # partial sums that grow side by side


@kernel
def assemble(
    shared: FloatArray,
    blocks: Any,
    pairs: Any,
    tiles: FloatArray,
    gram: FloatArray,
    right: FloatArray,
) -> None:
    """Fill gram (n, n) and right (n,) in place, in units of the scales of `estimator.sums.Sums`."""
    ns = len(shared) - 1
    for i in range(ns):
        right[i] = shared[1 + i, 0]
        for j in range(ns):
            gram[i, j] = shared[1 + i, 1 + j]
    for s in range(len(blocks)):
        at = ns + TERMS * s
        for i in range(TERMS):
            right[at + i] = blocks[s].shared[i, 0]
            for j in range(ns):
                gram[at + i, j] = blocks[s].shared[i, 1 + j]
                gram[j, at + i] = blocks[s].shared[i, 1 + j]
            for j in range(TERMS):
                gram[at + i, at + j] = blocks[s].gram[i, j]
    for p in range(len(pairs)):
        _place(tiles[p], ns + TERMS * pairs[p, 0], ns + TERMS * pairs[p, 1], gram)


@inlined
def _place(tile: FloatArray, low: int, high: int, gram: FloatArray) -> None:
    for i in range(TERMS):
        for j in range(TERMS):
            gram[low + i, high + j] = tile[i, j]
            gram[high + j, low + i] = tile[i, j]


@kernel
def mirror(matrix: FloatArray, scale: FloatArray) -> None:
    """matrix (n, n) <- scale_i scale_j lower_ij, both triangles scaled by scale (n,); in place."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            value = matrix[i, j] * scale[i] * scale[j]
            matrix[i, j] = value
            matrix[j, i] = value


@kernel
def residual(
    matrix: FloatArray, diagonal: FloatArray, theta: FloatArray, right: FloatArray
) -> FloatArray:
    """right - symmetric matrix theta (n,) in twice the precision, rounded once.

    matrix (n, n): what stands right of its diagonal is read, the rest may be anything; diagonal
    (n,).  Products and sums with what they round off: Dot2 of Ogita, Rump and Oishi, SIAM J. Sci.
    Comput. 26 (2005), for all rows at once, and LANES partial sums of each.  Entries of 1e300
    overflow; any units that fit.
    """
    n, total, lost = len(right), right.copy(), np.zeros(len(right))
    own, own_lost = np.zeros(LANES), np.zeros(LANES)
    high, low = np.empty(n), np.empty(n)
    for j in range(n):
        high[j] = _high(theta[j])
        low[j] = theta[j] - high[j]
    for j in range(n):
        b, b_high, b_low = theta[j], high[j], low[j]
        _take(total, lost, j, diagonal[j], _high(diagonal[j]), b, b_high, b_low)
        row, rest, rest_lost = matrix[j, j + 1 :], total[j + 1 :], lost[j + 1 :]
        x, x_high, x_low = theta[j + 1 :], high[j + 1 :], low[j + 1 :]
        for i in range(len(row)):
            _take(rest, rest_lost, i, row[i], _high(row[i]), b, b_high, b_low)
        whole = len(row) // LANES * LANES
        for i in range(0, whole, LANES):
            for k in range(LANES):
                a = row[i + k]
                _take(own, own_lost, k, a, _high(a), x[i + k], x_high[i + k], x_low[i + k])
        for i in range(whole, len(row)):
            _take(total, lost, j, row[i], _high(row[i]), x[i], x_high[i], x_low[i])
        for k in range(LANES):
            _take(total, lost, j, -1.0, -1.0, own[k], _high(own[k]), own[k] - _high(own[k]))
            lost[j] += own_lost[k]
            own[k] = own_lost[k] = 0.0
    return total + lost


@inlined
def _high(a: float) -> float:
    """The upper 26 bits of a double."""
    return SPLIT * a - (SPLIT * a - a)


@inlined
def _take(
    total: FloatArray, lost: FloatArray, i: int,
    a: float, a_high: float, b: float, b_high: float, b_low: float,
) -> None:  # fmt: skip
    """total[i] -= a b; what rounding loses of product and sum goes to lost[i]."""
    a_low, p = a - a_high, a * b
    p_lost = ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low
    before = total[i]
    after = before - p
    back = after - before
    total[i] = after
    lost[i] += (before - (after - back)) - (p + back) - p_lost
