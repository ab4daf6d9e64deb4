"""Products of the maps' columns among themselves.

A block that has been left rings on without anything being added: its state d decays by the
whitener's I - K alone (`evidence`).  So what it shares with an entry s v of row r (s: signs of the
edge, v: six terms) and all that follows from it is

    d_r' M_r s v,   M_r = L_r^-T L_r^-1 + A_r' M_r+1 A_r,   A = I - K,

and the many blocks that ring are met once in a span of rows by the few that move in it.
"""

from __future__ import annotations

import numpy as np

from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import TERMS
from rtid.plain import BoolArray, FloatArray, IntArray


@kernel
def map_products(
    sign: FloatArray,
    start: IntArray,
    block: IntArray,
    terms: FloatArray,
    fresh: BoolArray,
    whiten: FloatArray,
    A: FloatArray,
    span: int,
    quiet: float,
    pairs: FloatArray,
) -> None:
    """Add the products of all columns of the maps to those of pairs of blocks.

    pairs (V (V + 1) / 2, 36): of blocks v >= w at v (v + 1) / 2 + w, six terms of v by six of w.
    What is met together lies together: the rows of a matrix are pages of memory apart.
    sign (V, 2) of the blocks' edges; start (rows + 1,), block (entries,), terms (entries, 6),
    fresh, whiten, A: see `evidence.integrate`.  Rows are taken `span` at a time; a block whose
    whitened state is below `quiet` is forgotten.
    """
    n_v, rows = len(sign), len(whiten)
    M = np.empty((rows, 3))
    _memories(fresh, whiten, A, M)
    # per block: d, what it left behind before the span; what it adds in it, and what that meets
    d, new, felt = np.zeros((n_v, 12)), np.zeros((n_v, 12)), np.zeros((n_v, 12))
    live, moving = np.empty(n_v, np.int64), np.empty(n_v, np.int64)
    is_live, moves = np.zeros(n_v, np.bool_), np.zeros(n_v, np.bool_)
    n_live, r = 0, 0
    way, both = np.empty((2, 2)), np.empty(TERMS)
    while r < rows:
        if fresh[r]:
            for n in range(n_live):
                d[live[n]] = 0.0
                is_live[live[n]] = False
            n_live = 0
        way[0, 0], way[0, 1], way[1, 0], way[1, 1] = 1.0, 0.0, 0.0, 1.0
        n_moving, first = 0, r
        while r < rows and r < first + span and (r == first or not fresh[r]):
            if r > first:
                _carry(A[r - 1], way)
                for n in range(n_moving):
                    _fade(A[r - 1], new[moving[n]])
            for n in range(start[r], start[r + 1]):
                v = block[n]
                if not moves[v]:
                    moves[v] = True
                    moving[n_moving] = v
                    n_moving += 1
                _meet(v, terms[n], sign[v], M[r], way, moving[:n_moving], new, felt, pairs, both)
            r += 1
        for a in range(n_moving):
            _ring(moving[a], felt[moving[a]], live[:n_live], d, pairs)
        if r < rows:
            _carry(A[r - 1], way)
            for n in range(n_live):
                _fade(way, d[live[n]])
            for n in range(n_moving):
                v = moving[n]
                _leave(A[r - 1], new[v], felt[v], d[v])
                if not is_live[v]:
                    is_live[v] = True
                    live[n_live] = v
                    n_live += 1
            n_live = _loud(whiten[r], quiet, moves, live, n_live, is_live, d)
            for n in range(n_moving):
                moves[moving[n]] = False


@part
def _memories(fresh: BoolArray, whiten: FloatArray, A: FloatArray, M: FloatArray) -> None:
    """M00, M01, M11 of every row, M (rows, 3)."""
    m00, m01, m11 = 0.0, 0.0, 0.0
    for r in range(len(M) - 1, -1, -1):
        i0, half, i1 = whiten[r, 0], whiten[r, 1], whiten[r, 2]
        if r + 1 == len(M) or fresh[r + 1]:
            m00, m01, m11 = 0.0, 0.0, 0.0
        a = A[r]
        ma00, ma01 = m00 * a[0, 0] + m01 * a[1, 0], m00 * a[0, 1] + m01 * a[1, 1]
        ma10, ma11 = m01 * a[0, 0] + m11 * a[1, 0], m01 * a[0, 1] + m11 * a[1, 1]
        l10 = -i1 * half * i0
        m00 = i0 * i0 + l10 * l10 + a[0, 0] * ma00 + a[1, 0] * ma10
        m01 = l10 * i1 + a[0, 0] * ma01 + a[1, 0] * ma11
        m11 = i1 * i1 + a[0, 1] * ma01 + a[1, 1] * ma11
        M[r, 0], M[r, 1], M[r, 2] = m00, m01, m11


@inlined
def _carry(a: FloatArray, way: FloatArray) -> None:
    """way <- a way, 2 x 2, in place."""
    for j in range(2):
        w0, w1 = way[0, j], way[1, j]
        way[0, j] = a[0, 0] * w0 + a[0, 1] * w1
        way[1, j] = a[1, 0] * w0 + a[1, 1] * w1


@inlined
def _fade(a: FloatArray, d: FloatArray) -> None:
    """A block's state d (12,), six terms per chamber, <- a d, in place."""
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    for j in range(TERMS):
        d0, d1 = d[j], d[TERMS + j]
        d[j] = a00 * d0 + a01 * d1
        d[TERMS + j] = a10 * d0 + a11 * d1


@inlined
def _leave(a: FloatArray, new: FloatArray, felt: FloatArray, d: FloatArray) -> None:
    """What a block added in a span is left behind at the next row."""
    _fade(a, new)
    for j in range(2 * TERMS):
        d[j] += new[j]
        new[j] = 0.0
        felt[j] = 0.0


@inlined
def _place(v: int, w: int) -> int:
    """Where the pair of a block v and one w <= v lies."""
    return v * (v + 1) // 2 + w


@inlined
def _outer(pair: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """pair (36,) += a b' of six terms each."""
    b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
    for p in range(TERMS):
        f, j = a[p], TERMS * p
        pair[j] += f * b0
        pair[j + 1] += f * b1
        pair[j + 2] += f * b2
        pair[j + 3] += f * b3
        pair[j + 4] += f * b4
        pair[j + 5] += f * b5


@part
def _meet(
    v: int,
    t: FloatArray,
    s: FloatArray,
    M: FloatArray,
    way: FloatArray,
    moving: IntArray,
    new: FloatArray,
    felt: FloatArray,
    pairs: FloatArray,
    both: FloatArray,
) -> None:
    """Products of one entry with what blocks have added since the span began, and with itself.

    both (6,) is scratch.
    """
    m0, m1 = M[0] * s[0] + M[1] * s[1], M[1] * s[0] + M[2] * s[1]
    for n in range(len(moving)):
        w = moving[n]
        for p in range(TERMS):
            both[p] = m0 * new[w, p] + m1 * new[w, TERMS + p]
        if w < v:
            _outer(pairs[_place(v, w)], t, both)
        elif w > v:
            _outer(pairs[_place(w, v)], both, t)
        else:
            half = 0.5 * (m0 * s[0] + m1 * s[1])
            for p in range(TERMS):
                both[p] += half * t[p]
            _outer(pairs[_place(v, v)], t, both)
            _outer(pairs[_place(v, v)], both, t)
    f0, f1 = way[0, 0] * m0 + way[1, 0] * m1, way[0, 1] * m0 + way[1, 1] * m1
    for p in range(TERMS):
        felt[v, p] += f0 * t[p]
        felt[v, TERMS + p] += f1 * t[p]
        new[v, p] += s[0] * t[p]
        new[v, TERMS + p] += s[1] * t[p]


@part
def _ring(v: int, f: FloatArray, live: IntArray, d: FloatArray, pairs: FloatArray) -> None:
    """Products of what block v added in a span with what others had left behind before it."""
    for n in range(len(live)):
        w = live[n]
        d_w = d[w]
        if w <= v:
            _twice(pairs[_place(v, w)], f, d_w)
        if w >= v:
            _twice(pairs[_place(w, v)], d_w, f)


@inlined
def _twice(pair: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """pair (36,) += a' b of two states (12,)."""
    b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
    c0, c1, c2, c3, c4, c5 = b[6], b[7], b[8], b[9], b[10], b[11]
    for p in range(TERMS):
        f, g, j = a[p], a[TERMS + p], TERMS * p
        pair[j] += f * b0 + g * c0
        pair[j + 1] += f * b1 + g * c1
        pair[j + 2] += f * b2 + g * c2
        pair[j + 3] += f * b3 + g * c3
        pair[j + 4] += f * b4 + g * c4
        pair[j + 5] += f * b5 + g * c5


@part
def _loud(
    whiten: FloatArray,
    quiet: float,
    moves: BoolArray,
    live: IntArray,
    n_live: int,
    is_live: BoolArray,
    d: FloatArray,
) -> int:
    """Keep the blocks that still ring, in place; their number."""
    kept = 0
    for n in range(n_live):
        v = live[n]
        loud = moves[v]
        for j in range(TERMS):
            first = whiten[0] * d[v, j]
            second = whiten[2] * (d[v, TERMS + j] - whiten[1] * first)
            loud = loud or abs(first) > quiet or abs(second) > quiet
        if loud:
            live[kept] = v
            kept += 1
        else:
            is_live[v] = False
            d[v] = 0.0
    return kept


@kernel
def laid_out(pairs: FloatArray, first: IntArray, gram: FloatArray) -> None:
    """Products of pairs as of `map_products` become the lower triangle of gram (n, n).

    first (V + 1,): place of each block's first term; those behind its last one are left out.
    """
    for v in range(len(first) - 1):
        of_v = _place(v, 0)
        for p in range(first[v + 1] - first[v]):
            row = gram[first[v] + p]
            for w in range(v + 1):
                pair, at = pairs[of_v + w], first[w]
                for q in range(first[w + 1] - at):
                    row[at + q] = pair[TERMS * p + q]
