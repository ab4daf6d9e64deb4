"""Products of whitened rows without the rows: what a column adds meets what others left behind.

Rows are  d_r = A_r-1 d_r-1 + b_r,  row_r = L_r^-1 d_r  (see `evidence`).  The sum over the rows of
the products of two columns is

    G = sum_r b_r' l_r,   l_r = L_r^-T row_r + A_r' l_r+1      (the adjoint of one of them),

so the columns of the maps, of which few move at a time, need l of the others only where they move.
For what they share among themselves see `ringing`.
"""

from __future__ import annotations

import numpy as np

from rtid.kernels.jit import inlined, kernel
from rtid.plain import BoolArray, FloatArray, IntArray


@kernel
def whitened(columns: FloatArray, fresh: BoolArray, whiten: FloatArray, A: FloatArray) -> None:
    """What columns add to the rows (rows, chambers, m) becomes their whitened rows, in place."""
    rows, n_c, m = columns.shape
    d = np.zeros((2, m))
    for r in range(rows):
        if fresh[r]:
            d[:] = 0.0
        b, i0, half, i1 = columns[r], whiten[r, 0], whiten[r, 1], whiten[r, 2]
        a00, a01, a10, a11 = _transition(A, r)
        if n_c == 1:
            for j in range(m):
                d[0, j] = a00 * d[0, j] + b[0, j]
                b[0, j] = i0 * d[0, j]
            continue
        for j in range(m):
            d0, d1 = d[0, j], d[1, j]
            d[0, j] = a00 * d0 + a01 * d1 + b[0, j]
            d[1, j] = a10 * d0 + a11 * d1 + b[1, j]
            b[0, j] = i0 * d[0, j]
            b[1, j] = i1 * (d[1, j] - half * b[0, j])


@inlined
def _transition(A: FloatArray, r: int) -> tuple[float, float, float, float]:
    """A of the row before; of no meaning for the first."""
    a = A[r - 1]
    return a[0, 0], a[0, 1], a[1, 0], a[1, 1]


@kernel
def adjoint(rows: FloatArray, fresh: BoolArray, whiten: FloatArray, A: FloatArray) -> None:
    """Whitened rows (rows, chambers, m) become their adjoint l, in place."""
    n, n_c, m = rows.shape
    for r in range(n - 1, -1, -1):
        row, i0, half, i1 = rows[r], whiten[r, 0], whiten[r, 1], whiten[r, 2]
        rings = r + 1 < n and not fresh[r + 1]
        a, after = A[r], rows[r + 1] if rings else row
        a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
        for j in range(m):
            if n_c == 1:
                row[0, j] *= i0
                if rings:
                    row[0, j] += a00 * after[0, j]
                continue
            e1 = i1 * row[1, j]
            row[0, j] = i0 * (row[0, j] - half * e1)
            row[1, j] = e1
            if rings:
                row[0, j] += a00 * after[0, j] + a10 * after[1, j]
                row[1, j] += a01 * after[0, j] + a11 * after[1, j]


@kernel
def cross(
    adjoints: FloatArray,
    sign: FloatArray,
    start: IntArray,
    block: IntArray,
    terms: FloatArray,
    first: IntArray,
    out: FloatArray,
) -> None:
    """Products of the columns of the maps with those of which `adjoints` (rows, chambers, m) are.

    sign (V, 2) of the blocks' edges; start (rows + 1,), block (entries,), terms (entries, 6): see
    `evidence.integrate`; first (V + 1,): place of each block's first term in out (n, m), which is
    changed in place.
    """
    rows, n_c, m = adjoints.shape
    felt = np.empty(m)
    for r in range(rows):
        for n in range(start[r], start[r + 1]):
            v, at = block[n], first[block[n]]
            for j in range(m):
                felt[j] = sign[v, 0] * adjoints[r, 0, j]
            if n_c == 2 and sign[v, 1] != 0.0:
                for j in range(m):
                    felt[j] += sign[v, 1] * adjoints[r, 1, j]
            for p in range(first[v + 1] - at):
                t, row = terms[n, p], out[at + p]
                for j in range(m):
                    row[j] += t * felt[j]


@kernel
def scaled(gram: FloatArray, prior: float, scale: FloatArray) -> None:
    """Lower triangle of gram (n, n) + prior, scaled to a unit diagonal; both changed in place."""
    for i in range(len(gram)):
        scale[i] = 1.0 / np.sqrt(gram[i, i] + prior)
        row = gram[i]
        for j in range(i):
            row[j] *= scale[i] * scale[j]
        row[i] = 1.0


@kernel
def variances(inverse: FloatArray) -> FloatArray:
    """Diagonal (n,) of X' X for a lower triangle X (n, n), in any unit."""
    out = np.zeros(len(inverse))
    for i in range(len(inverse)):
        row = inverse[i]
        for j in range(i + 1):
            out[j] += row[j] * row[j]
    return out


@kernel
def covariances(inverse: FloatArray, first: IntArray, scale: FloatArray, cov: FloatArray) -> None:
    """Diagonal blocks cov (V, 6, 6) of X' X scaled, X (n, n) lower; cov is changed in place.

    first (V + 1,): place of each block's first term; what is behind its last one is left as it is.
    """
    for i in range(len(inverse)):
        row = inverse[i]
        for b in range(len(cov)):
            at = first[b]
            if at > i:
                break
            for p in range(min(first[b + 1], i + 1) - at):
                for q in range(p + 1):
                    cov[b, p, q] += row[at + p] * row[at + q]
    for b in range(len(cov)):
        at = first[b]
        for p in range(first[b + 1] - at):
            for q in range(p + 1):
                cov[b, p, q] *= scale[at + p] * scale[at + q]
                cov[b, q, p] = cov[b, p, q]
