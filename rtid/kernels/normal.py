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
def residual(matrix: FloatArray, theta: FloatArray, right: FloatArray) -> FloatArray:
    """right - matrix theta (n,) in twice the precision, rounded once; matrix (n, n) symmetric.

    Products and sums with what they round off: Dot2 of Ogita, Rump and Oishi, SIAM J. Sci. Comput.
    26 (2005), for all rows at once.  Entries of 1e300 overflow; any units that fit.
    """
    total, lost = right.copy(), np.zeros(len(right))
    for j in range(len(right)):
        column, b = matrix[j], -theta[j]
        b_high = SPLIT * b - (SPLIT * b - b)
        b_low = b - b_high
        for i in range(len(right)):
            a = column[i]
            a_high = SPLIT * a - (SPLIT * a - a)
            a_low, p = a - a_high, a * b
            p_lost = ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low
            before = total[i]
            after = before + p
            back = after - before
            total[i] = after
            lost[i] += (before - (after - back)) + (p - back) + p_lost
    return total + lost
