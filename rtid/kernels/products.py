"""Products of whitened rows without the rows: what a column adds meets what others left behind.

Rows are  d_r = A_r-1 d_r-1 + b_r,  row_r = L_r^-1 d_r  (see `evidence`).  The sum over the rows of
the products of two columns is

    G = sum_r b_r' l_r,   l_r = L_r^-T row_r + A_r' l_r+1      (the adjoint of one of them),

so the columns of the maps, of which few move at a time, need l of the others only where they move.
Among themselves: a block that has been left rings on without anything being added, so that what it
shares with an entry s v of row r (s: signs of the edge, v: six terms) is

    d_r' M_r s v,   M_r = L_r^-T L_r^-1 + A_r' M_r+1 A_r.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import TERMS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@kernel
def whitened(columns: FloatArray, fresh: BoolArray, whiten: FloatArray, keep: FloatArray) -> None:
    """What columns add to the rows (rows, chambers, m) becomes their whitened rows, in place."""
    rows, n_c, m = columns.shape
    d = np.zeros((2, m))
    for r in range(rows):
        if fresh[r]:
            d[:] = 0.0
        b, i0, half, i1 = columns[r], whiten[r, 0], whiten[r, 1], whiten[r, 2]
        k00, k01, k10, k11 = _transition(keep, r)
        if n_c == 1:
            for j in range(m):
                d[0, j] = k00 * d[0, j] + b[0, j]
                b[0, j] = i0 * d[0, j]
            continue
        for j in range(m):
            d0, d1 = d[0, j], d[1, j]
            d[0, j] = k00 * d0 + k01 * d1 + b[0, j]
            d[1, j] = k10 * d0 + k11 * d1 + b[1, j]
            b[0, j] = i0 * d[0, j]
            b[1, j] = i1 * (d[1, j] - half * b[0, j])


@inlined
def _transition(keep: FloatArray, r: int) -> tuple[float, float, float, float]:
    """A of the row before; of no meaning for the first."""
    k = keep[r - 1]
    return k[0, 0], k[0, 1], k[1, 0], k[1, 1]


@kernel
def adjoint(rows: FloatArray, fresh: BoolArray, whiten: FloatArray, keep: FloatArray) -> None:
    """Whitened rows (rows, chambers, m) become their adjoint l, in place."""
    n, n_c, m = rows.shape
    for r in range(n - 1, -1, -1):
        row, i0, half, i1 = rows[r], whiten[r, 0], whiten[r, 1], whiten[r, 2]
        rings = r + 1 < n and not fresh[r + 1]
        k, after = keep[r], rows[r + 1] if rings else row
        k00, k01, k10, k11 = k[0, 0], k[0, 1], k[1, 0], k[1, 1]
        for j in range(m):
            if n_c == 1:
                row[0, j] *= i0
                if rings:
                    row[0, j] += k00 * after[0, j]
                continue
            e1 = i1 * row[1, j]
            row[0, j] = i0 * (row[0, j] - half * e1)
            row[1, j] = e1
            if rings:
                row[0, j] += k00 * after[0, j] + k10 * after[1, j]
                row[1, j] += k01 * after[0, j] + k11 * after[1, j]


@kernel
def cross(
    adjoints: FloatArray,
    sign: FloatArray,
    start: IntArray,
    block: IntArray,
    terms: FloatArray,
    fresh: BoolArray,
    out: FloatArray,
) -> None:
    """Products of the columns of the maps with those of which `adjoints` (rows, chambers, m) are.

    sign (V, 2) of the blocks' edges; start (rows + 1,), block (entries,), terms
    (entries, 2, 6): see `evidence.integrate`; out (6 V, m) is changed in place.
    """
    rows, n_c, m = adjoints.shape
    felt = np.empty(m)
    for r in range(rows):
        for part_of in range(2):
            if part_of == 1 and (r == 0 or fresh[r]):
                break
            for n in range(start[r - part_of], start[r - part_of + 1]):
                v, at = block[n], TERMS * block[n]
                for j in range(m):
                    felt[j] = sign[v, 0] * adjoints[r, 0, j]
                if n_c == 2 and sign[v, 1] != 0.0:
                    for j in range(m):
                        felt[j] += sign[v, 1] * adjoints[r, 1, j]
                for p in range(TERMS):
                    t, row = terms[n, part_of, p], out[at + p]
                    for j in range(m):
                        row[j] += t * felt[j]


@kernel
def memory(fresh: BoolArray, whiten: FloatArray, keep: FloatArray, out: FloatArray) -> None:
    """M of every row, out (rows, 2, 2), changed in place."""
    m00, m01, m11 = 0.0, 0.0, 0.0
    for r in range(len(out) - 1, -1, -1):
        i0, half, i1 = whiten[r, 0], whiten[r, 1], whiten[r, 2]
        if r + 1 == len(out) or fresh[r + 1]:
            m00, m01, m11 = 0.0, 0.0, 0.0
        k = keep[r]
        a00, a01 = m00 * k[0, 0] + m01 * k[1, 0], m00 * k[0, 1] + m01 * k[1, 1]
        a10, a11 = m01 * k[0, 0] + m11 * k[1, 0], m01 * k[0, 1] + m11 * k[1, 1]
        l10 = -i1 * half * i0
        m00 = i0 * i0 + l10 * l10 + k[0, 0] * a00 + k[1, 0] * a10
        m01 = l10 * i1 + k[0, 0] * a01 + k[1, 0] * a11
        m11 = i1 * i1 + k[0, 1] * a01 + k[1, 1] * a11
        out[r, 0, 0], out[r, 0, 1], out[r, 1, 0], out[r, 1, 1] = m00, m01, m01, m11


@kernel
def maps(
    sign: FloatArray,
    start: IntArray,
    block: IntArray,
    terms: FloatArray,
    fresh: BoolArray,
    whiten: FloatArray,
    keep: FloatArray,
    span: int,
    quiet: float,
    gram: FloatArray,
) -> None:
    """Lower triangle of the products of all columns of the maps; gram (6 V, 6 V) += , in place.

    Rows are taken `span` at a time: only blocks that move meanwhile meet one another row by row; of
    the others, what they left behind is met once.  One whose rows are below `quiet` is forgotten.
    """
    n_v, rows = len(sign), len(whiten)
    m = np.empty((rows, 2, 2))
    memory(fresh, whiten, keep, m)
    left, new = np.zeros((n_v, 2, TERMS)), np.zeros((n_v, 2, TERMS))
    felt = np.zeros((n_v, 2, TERMS))
    live, n_live = np.empty(n_v, np.int64), 0
    is_live, moving, n_moving = np.zeros(n_v, np.bool_), np.empty(n_v, np.int64), 0
    moves = np.zeros(n_v, np.bool_)
    way = np.empty((2, 2))
    r = 0
    while r < rows:
        if fresh[r]:
            for n in range(n_live):
                left[live[n]] = 0.0
                is_live[live[n]] = False
            n_live = 0
        way[0, 0], way[0, 1], way[1, 0], way[1, 1] = 1.0, 0.0, 0.0, 1.0
        n_moving, first = 0, r
        while r < rows and r < first + span and (r == first or not fresh[r]):
            if r > first:
                _through(keep[r - 1], way)
                for n in range(n_moving):
                    _through(keep[r - 1], new[moving[n]])
            for part_of in range(2):
                if part_of == 1 and (r == 0 or fresh[r]):
                    break
                for n in range(start[r - part_of], start[r - part_of + 1]):
                    v = block[n]
                    if not moves[v]:
                        moves[v] = True
                        moving[n_moving] = v
                        n_moving += 1
                    _meet(
                        v, terms[n, part_of], sign[v], m[r], way, moving, n_moving, new, felt, gram
                    )
            r += 1
        for a in range(n_moving):
            for n in range(n_live):
                _ring(live[n], moving[a], left, felt, gram)
        if r < rows:
            _through(keep[r - 1], way)
            n_live = _go_on(
                way, whiten[r], quiet, keep[r - 1], moves, moving, n_moving, new, felt,
                live, n_live, is_live, left,
            )  # fmt: skip


@inlined
def _through(k: FloatArray, d: FloatArray) -> None:
    """d (2, m) <- k d, in place."""
    for j in range(d.shape[1]):
        d0, d1 = d[0, j], d[1, j]
        d[0, j] = k[0, 0] * d0 + k[0, 1] * d1
        d[1, j] = k[1, 0] * d0 + k[1, 1] * d1


@part
def _meet(
    v: int,
    t: FloatArray,
    s: FloatArray,
    m: FloatArray,
    way: FloatArray,
    moving: IntArray,
    n_moving: int,
    new: FloatArray,
    felt: FloatArray,
    gram: FloatArray,
) -> None:
    """Products of one entry with what blocks have added since the span began, and with itself."""
    m0, m1 = m[0, 0] * s[0] + m[0, 1] * s[1], m[1, 0] * s[0] + m[1, 1] * s[1]
    both = np.empty(TERMS)
    for n in range(n_moving):
        w = moving[n]
        for p in range(TERMS):
            both[p] = m0 * new[w, 0, p] + m1 * new[w, 1, p]
        if w == v:
            own = m0 * s[0] + m1 * s[1]
            for p in range(TERMS):
                for q in range(TERMS):
                    gram[TERMS * v + p, TERMS * v + q] += (
                        both[p] * t[q] + t[p] * both[q] + own * t[p] * t[q]
                    )
        elif w < v:
            for p in range(TERMS):
                for q in range(TERMS):
                    gram[TERMS * v + p, TERMS * w + q] += t[p] * both[q]
        else:
            for p in range(TERMS):
                for q in range(TERMS):
                    gram[TERMS * w + p, TERMS * v + q] += both[p] * t[q]
    f0, f1 = way[0, 0] * m0 + way[1, 0] * m1, way[0, 1] * m0 + way[1, 1] * m1
    for p in range(TERMS):
        felt[v, 0, p] += f0 * t[p]
        felt[v, 1, p] += f1 * t[p]
        new[v, 0, p] += s[0] * t[p]
        new[v, 1, p] += s[1] * t[p]


@part
def _ring(w: int, v: int, left: FloatArray, felt: FloatArray, gram: FloatArray) -> None:
    """Products of what block v added in a span with what w had left behind before it."""
    d, f = left[w], felt[v]
    if w < v:
        for p in range(TERMS):
            for q in range(TERMS):
                gram[TERMS * v + p, TERMS * w + q] += f[0, p] * d[0, q] + f[1, p] * d[1, q]
    elif v < w:
        for p in range(TERMS):
            for q in range(TERMS):
                gram[TERMS * w + p, TERMS * v + q] += d[0, p] * f[0, q] + d[1, p] * f[1, q]
    else:
        for p in range(TERMS):
            for q in range(TERMS):
                gram[TERMS * v + p, TERMS * v + q] += (
                    f[0, p] * d[0, q] + f[1, p] * d[1, q] + d[0, p] * f[0, q] + d[1, p] * f[1, q]
                )


@part
def _go_on(
    way: FloatArray,
    whiten: FloatArray,
    quiet: float,
    last: FloatArray,
    moves: BoolArray,
    moving: IntArray,
    n_moving: int,
    new: FloatArray,
    felt: FloatArray,
    live: IntArray,
    n_live: int,
    is_live: BoolArray,
    left: FloatArray,
) -> int:
    """What is left behind at the next row; returns how many blocks still ring."""
    for n in range(n_live):
        _through(way, left[live[n]])
    for n in range(n_moving):
        v = moving[n]
        _through(last, new[v])
        left[v] += new[v]
        new[v] = 0.0
        felt[v] = 0.0
        if not is_live[v]:
            is_live[v] = True
            live[n_live] = v
            n_live += 1
    kept = 0
    for n in range(n_live):
        v = live[n]
        if moves[v] or _is_loud(left[v], whiten, quiet):
            live[kept] = v
            kept += 1
        else:
            is_live[v] = False
            left[v] = 0.0
    for n in range(n_moving):
        moves[moving[n]] = False
    return kept


@inlined
def _is_loud(d: FloatArray, whiten: FloatArray, quiet: float) -> bool:
    """True where a whitened row of a block's state is above `quiet`."""
    for j in range(TERMS):
        first = whiten[0] * d[0, j]
        if abs(first) > quiet or abs(whiten[2] * (d[1, j] - whiten[1] * first)) > quiet:
            return True
    return False


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
def covariances(inverse: FloatArray, scale: FloatArray, cov: FloatArray) -> None:
    """Diagonal blocks cov (V, 6, 6) of X' X scaled, X (n, n) lower; cov is changed in place."""
    for i in range(len(inverse)):
        row = inverse[i]
        for b in range(i // TERMS + 1):
            for p in range(min(TERMS, i + 1 - TERMS * b)):
                for q in range(p + 1):
                    cov[b, p, q] += row[TERMS * b + p] * row[TERMS * b + q]
    for b in range(len(cov)):
        for p in range(TERMS):
            for q in range(p + 1):
                cov[b, p, q] *= scale[TERMS * b + p] * scale[TERMS * b + q]
                cov[b, q, p] = cov[b, p, q]
