"""Sparse information sums of rows that touch many blocks, each with a fading memory.

A whitened or filtered row is N_k d_k, where every column's state obeys

    d_{k+1} = M_k (d_k + increment)          (increment = 0 while its block is closed)

so all closed blocks decay by the same product of M_k.  With `ring` = that product as local columns,
d_closed(k) = ring(k) d_hat with constant d_hat, and their products with every other column follow
from the products of the ring columns, added once per change of block.  This is exact: it gives the
normal equations of the dense rows (tests/test_information.py), at a cost per sample that does not
depend on the number of blocks.

All arguments named e, closed, blocks, pairs are records or record arrays of `layout` and are changed
in place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rtid.kernels.layout import MAX_LOCAL, TERMS

FloatArray = NDArray[np.float64]

RING_LOG_LIMIT = -4.0  # rebase before the ring columns lose digits to each other
LANES = 4  # rows of the local products are padded to whole vectors


@njit(cache=True)
def first_ring(e: Any) -> int:
    """Local index of the first ring column."""
    return 1 + e.n_shared + TERMS * e.n_open


@njit(cache=True)
def local_width(e: Any) -> int:
    """Number of local columns in use, padded; the padding is kept at zero."""
    n = first_ring(e) + e.n_state
    return min(MAX_LOCAL, (n + LANES - 1) // LANES * LANES)


@njit(cache=True)
def find_pair(e: Any, pairs: Any, low: int, high: int) -> int:
    """Position of the pair's record (created at its first use); the table is never full."""
    key = ((low + 1) << 32) | (high + 1)
    mask = len(pairs) - 1
    mixed = (low * 73856093) ^ (high * 19349663)
    at = (mixed ^ (mixed >> 15)) & mask
    while pairs[at].key != key:
        if pairs[at].key == 0:
            pairs[at].key = key
            e.n_pairs += 1
            break
        at = (at + 1) & mask
    return at


@njit(cache=True)
def add_pair(
    e: Any, pairs: Any, slot_a: int, slot_b: int, left: FloatArray, right: FloatArray
) -> None:
    """Add left' right, the products of the columns of slot_a (rows) and slot_b (columns).

    left, right: (n_state, 6) or more rows, of which the first n_state count.
    """
    if slot_a < slot_b:
        add_outer(pairs[find_pair(e, pairs, slot_a, slot_b)].gram, left, right, e.n_state)
    else:
        add_outer(pairs[find_pair(e, pairs, slot_b, slot_a)].gram, right, left, e.n_state)


@njit(cache=True)
def add_outer(target: FloatArray, left: FloatArray, right: FloatArray, n: int) -> None:
    """target (6, 6) += left[:n]' right[:n], in place."""
    for s in range(n):
        for i in range(TERMS):
            a = left[s, i]
            for j in range(TERMS):
                target[i, j] += a * right[s, j]


@njit(cache=True)
def move_pairs(e: Any, pairs: Any, larger: Any) -> None:
    """Enter all records of pairs into the empty table larger, which is changed in place."""
    for p in range(len(pairs)):
        if pairs[p].key != 0:
            low, high = (pairs[p].key >> 32) - 1, (pairs[p].key & 0xFFFFFFFF) - 1
            larger[find_pair(e, larger, low, high)].gram[:] = pairs[p].gram


@njit(cache=True)
def flush_local(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """Move the local products to the blocks, pairs and the ring's own sums; clear them."""
    gram = e.gram
    n_shared, ring, n_state = 1 + e.n_shared, first_ring(e), e.n_state
    for i in range(n_shared):
        for j in range(n_shared):
            e.shared[i, j] += gram[i, j]
    for i in range(n_state):
        for j in range(n_state):
            e.ring_w[i, j] += gram[ring + i, ring + j]
    for k in range(e.n_open):
        _flush_open(e, blocks, pairs, k)
    for c in range(e.n_closed):
        _flush_closed(e, closed[c], blocks, pairs)
    for i in range(ring + n_state):
        for j in range(ring + n_state):
            gram[i, j] = 0.0


@njit(cache=True)
def _flush_open(e: Any, blocks: Any, pairs: Any, k: int) -> None:
    """Products of open block k with the shared columns, itself and the later open blocks."""
    gram, block = e.gram, blocks[e.open_slot[k]]
    first = 1 + e.n_shared + TERMS * k
    for i in range(TERMS):
        for j in range(1 + e.n_shared):
            block.shared[i, j] += gram[first + i, j]
        for j in range(TERMS):
            block.gram[i, j] += gram[first + i, first + j]
    for other in range(k + 1, e.n_open):
        second = 1 + e.n_shared + TERMS * other
        low, high = e.open_slot[k], e.open_slot[other]
        swap = low > high
        target = pairs[find_pair(e, pairs, min(low, high), max(low, high))].gram
        for i in range(TERMS):
            for j in range(TERMS):
                value = gram[first + i, second + j]
                if swap:
                    target[j, i] += value
                else:
                    target[i, j] += value


@njit(cache=True)
def _flush_closed(e: Any, item: Any, blocks: Any, pairs: Any) -> None:
    """Products of one closed block with the shared columns and the open blocks, via the ring."""
    gram, ring, block = e.gram, first_ring(e), blocks[item.slot]
    for s in range(e.n_state):
        for i in range(TERMS):
            d = item.d[s, i]
            for j in range(1 + e.n_shared):
                block.shared[i, j] += d * gram[ring + s, j]
    for k in range(e.n_open):
        first = 1 + e.n_shared + TERMS * k
        through = gram[ring:, first : first + TERMS]
        add_pair(e, pairs, item.slot, e.open_slot[k], item.d, through)


@njit(cache=True)
def _owed(e: Any, item: Any, since: FloatArray) -> FloatArray:
    """(ring_w - since) d of a closed block: what it owes to every other one; a scratch of e."""
    out = e.owed
    for s in range(e.n_state):
        for j in range(TERMS):
            out[s, j] = 0.0
            for r in range(e.n_state):
                out[s, j] += (e.ring_w[s, r] - since[s, r]) * item.d[r, j]
    return out


@njit(cache=True)
def _flush_ring(e: Any, closed: Any, blocks: Any, pairs: Any, at: int) -> None:
    """Add the products of closed block `at` with itself and every block that closed before it."""
    item = closed[at]
    owed = _owed(e, item, item.w_start)
    add_outer(blocks[item.slot].gram, item.d, owed, e.n_state)
    for c in range(at):
        add_pair(e, pairs, closed[c].slot, item.slot, closed[c].d, owed)


@njit(cache=True)
def rebase(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """Settle the ring: add the closed blocks' products, drop the silent ones, start it at I.

    The local products must have been flushed.
    """
    for c in range(e.n_closed):
        _flush_ring(e, closed, blocks, pairs, c)
    ring, kept = first_ring(e), 0
    for c in range(e.n_closed):
        _advance_closed(e, closed[c], ring)
        if _largest(closed[c].d, e.n_state) > e.ring_floor * closed[c].size:
            closed[kept] = closed[c]
            kept += 1
    e.n_closed = kept
    e.ring_log = 0.0
    for s in range(e.n_state):
        for r in range(e.n_state):
            e.ring_w[s, r] = 0.0
            e.d[s, ring + r] = 1.0 if s == r else 0.0


@njit(cache=True)
def _largest(d: FloatArray, n: int) -> float:
    largest = 0.0
    for s in range(n):
        for i in range(TERMS):
            largest = max(largest, abs(d[s, i]))
    return largest


@njit(cache=True)
def _advance_closed(e: Any, item: Any, ring: int) -> None:
    """Refer the state of a closed block to now: d <- ring d; nothing is owed any more."""
    for s in range(e.n_state):
        for i in range(TERMS):
            e.owed[s, i] = item.d[s, i]
    for s in range(e.n_state):
        for i in range(TERMS):
            item.d[s, i] = 0.0
            for r in range(e.n_state):
                item.d[s, i] += e.d[s, ring + r] * e.owed[r, i]
        for r in range(e.n_state):
            item.w_start[s, r] = 0.0


@njit(cache=True)
def close_block(e: Any, closed: Any, k: int) -> None:
    """Let open block k ring on: its state, referred to the ring's origin, joins the closed ones.

    The local products must have been flushed, and `closed` must have room.
    """
    ring, first, n = first_ring(e), 1 + e.n_shared + TERMS * k, e.n_state
    item = closed[e.n_closed]
    item.slot, item.size = e.open_slot[k], 0.0
    for s in range(n):
        for i in range(TERMS):
            item.d[s, i] = e.d[s, first + i]
            item.size = max(item.size, abs(item.d[s, i]))
        for r in range(n):
            item.w_start[s, r] = e.ring_w[s, r]
    _solve(e.d[:, ring : ring + n].copy(), item.d, n)
    if item.size > 0.0:
        e.n_closed += 1


@njit(cache=True)
def _solve(a: FloatArray, b: FloatArray, n: int) -> None:
    """b (n, 6) <- a^-1 b by Gauss elimination with row pivots; a and b are changed in place."""
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        for j in range(n):
            a[k, j], a[best, j] = a[best, j], a[k, j]
        for j in range(TERMS):
            b[k, j], b[best, j] = b[best, j], b[k, j]
        for i in range(n):
            if i != k:
                factor = a[i, k] / a[k, k]
                for j in range(n):
                    a[i, j] -= factor * a[k, j]
                for j in range(TERMS):
                    b[i, j] -= factor * b[k, j]
    for k in range(n):
        for j in range(TERMS):
            b[k, j] /= a[k, k]


@njit(cache=True)
def _remove_closed(e: Any, closed: Any, at: int) -> None:
    for c in range(at, e.n_closed - 1):
        closed[c] = closed[c + 1]
    e.n_closed -= 1


@njit(cache=True)
def open_block(e: Any, closed: Any, blocks: Any, pairs: Any, edge: int, slot: int) -> None:
    """Append a block to the open ones; if it still rings, it goes on from the state it is in.

    The local products must have been flushed; the ring columns move behind the new block.
    """
    ring, n = first_ring(e), e.n_state
    for s in range(n):
        for r in range(n - 1, -1, -1):
            e.d[s, ring + TERMS + r] = e.d[s, ring + r]
        for i in range(TERMS):
            e.d[s, ring + i] = 0.0
    e.open_edge[e.n_open] = edge
    e.open_slot[e.n_open] = slot
    e.place[edge] = e.n_open
    e.n_open += 1
    for c in range(e.n_closed):
        if closed[c].slot == slot:
            _resume(e, closed, blocks, pairs, c, ring)
            break


@njit(cache=True)
def _resume(e: Any, closed: Any, blocks: Any, pairs: Any, at: int, first: int) -> None:
    """Settle what closed block `at` shares with the others, and make it the open block at first."""
    _flush_ring(e, closed, blocks, pairs, at)
    item = closed[at]
    for c in range(at + 1, e.n_closed):
        owed = _owed(e, item, closed[c].w_start)
        add_pair(e, pairs, item.slot, closed[c].slot, owed, closed[c].d)
    ring = first_ring(e)
    for s in range(e.n_state):
        for i in range(TERMS):
            for r in range(e.n_state):
                e.d[s, first + i] += e.d[s, ring + r] * item.d[r, i]
    _remove_closed(e, closed, at)


@njit(cache=True)
def drop_open(e: Any, k: int) -> None:
    """Take block k out of the open ones (its state was saved); the last one takes its place."""
    ring, first = first_ring(e), 1 + e.n_shared + TERMS * k
    last = ring - TERMS
    for s in range(e.n_state):
        for i in range(TERMS):
            e.d[s, first + i] = e.d[s, last + i]
        for r in range(e.n_state):
            e.d[s, last + r] = e.d[s, ring + r]
        for j in range(last + e.n_state, min(MAX_LOCAL, ring + e.n_state + LANES)):
            e.d[s, j] = 0.0
    e.place[e.open_edge[k]] = -1
    e.n_open -= 1
    if k < e.n_open:
        e.open_edge[k], e.open_slot[k] = e.open_edge[e.n_open], e.open_slot[e.n_open]
        e.place[e.open_edge[k]] = k


@njit(cache=True)
def forget_ring(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """End all memory: settle every product and set all states to zero (a gap, a restart)."""
    flush_local(e, closed, blocks, pairs)
    rebase(e, closed, blocks, pairs)
    e.n_closed = 0
    ring = first_ring(e)
    for s in range(e.n_state):
        for j in range(ring):
            e.d[s, j] = 0.0


@njit(cache=True)
def add_products(e: Any, n_rows: int) -> None:
    """gram += row' row over the n_rows local rows: the only work that every row costs."""
    gram, row, n = e.gram, e.row, local_width(e)
    if n_rows == 1:
        for i in range(n):
            a = row[0, i]
            for j in range(n):
                gram[i, j] += a * row[0, j]
    else:
        for i in range(n):
            a, b = row[0, i], row[1, i]
            for j in range(n):
                gram[i, j] += a * row[0, j] + b * row[1, j]


@njit(cache=True)
def ring_needs_rebase(e: Any) -> bool:
    """True when the ring columns have decayed so far that they start to lose digits."""
    return e.ring_log < RING_LOG_LIMIT and math.isfinite(e.ring_log)
