"""Dense normal equations of the joint regression, read out of the sparse sums.

Unknowns in the order [shared (n_shared) | 6 terms of slot 0 | 6 terms of slot 1 | ...].
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtid.kernels.jit import inlined, kernel
from rtid.kernels.layout import TERMS

FloatArray = NDArray[np.float64]


@kernel
def assemble(engine: Any, blocks: Any, pairs: Any, gram: FloatArray, right: FloatArray) -> float:
    """Fill gram (n, n) and right (n,), changed in place; returns y'y.  The sums must be settled."""
    e = engine[0]
    ns = e.n_shared
    for i in range(ns):
        right[i] = e.shared[1 + i, 0]
        for j in range(ns):
            gram[i, j] = e.shared[1 + i, 1 + j]
    for s in range(e.n_slots):
        at = ns + TERMS * s
        for i in range(TERMS):
            right[at + i] = blocks[s].shared[i, 0]
            for j in range(ns):
                gram[at + i, j] = blocks[s].shared[i, 1 + j]
                gram[j, at + i] = blocks[s].shared[i, 1 + j]
            for j in range(TERMS):
                gram[at + i, at + j] = blocks[s].gram[i, j]
    for p in range(len(pairs)):
        if pairs[p].key != 0:
            _place(pairs[p], ns, gram)
    return float(e.shared[0, 0])


@inlined
def _place(pair: Any, ns: int, gram: FloatArray) -> None:
    low = ns + TERMS * ((pair.key >> 32) - 1)
    high = ns + TERMS * ((pair.key & 0xFFFFFFFF) - 1)
    for i in range(TERMS):
        for j in range(TERMS):
            gram[low + i, high + j] = pair.gram[i, j]
            gram[high + j, low + i] = pair.gram[i, j]


@kernel
def mirror(matrix: FloatArray, scale: FloatArray) -> None:
    """matrix (n, n) <- scale_i scale_j upper_ij, both triangles, from its upper one; in place."""
    n = len(matrix)
    for i in range(n):
        for j in range(i, n):
            value = matrix[i, j] * scale[i] * scale[j]
            matrix[i, j] = value
            matrix[j, i] = value
