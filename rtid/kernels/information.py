"""Sparse information sums of rows that touch many blocks, each with a fading memory.

A whitened or filtered row is N_k d_k, where every column's state obeys

    d_{k+1} = M_k (d_k + increment)          (increment = 0 while its block is closed)

so all closed blocks decay by the same product of M_k.  With `ring` = that product as local
columns, d_closed(k) = ring(k) d_hat with constant d_hat, and what a closed block shares with any
other column follows from the products of the ring with that column:

* with an open block, from ring x open, kept with the open block when it closes (`through`);
* with another closed block, from ring x ring since the later one closed.

Both are settled once per rebase of the ring, or when a block is entered again.  This is exact: it
gives the normal equations of the dense rows, at a cost per sample and per change of block that does
not depend on the number of blocks.

Local products stand in the upper triangle of e.gram.  All arguments named e, item, closed, blocks
and pairs are records or record arrays of `layout` and are changed in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rtid.kernels.layout import MAX_LOCAL, TERMS

FloatArray = NDArray[np.float64]

# Rebase before the ring columns lose digits: at det ring = 1e-3 they lose about five of sixteen.
RING_DET_LIMIT = 1e-3
LANES = 4  # rows of the local products are padded to whole vectors


@njit(cache=True)
def first_ring(e: Any) -> int:
    """Local index of the first ring column."""
    return int(1 + e.n_shared)


@njit(cache=True)
def first_open(e: Any, k: int) -> int:
    """Local index of the first column of open block k."""
    return int(1 + e.n_shared + e.n_state + TERMS * k)


@njit(cache=True)
def local_width(e: Any) -> int:
    """Number of local columns in use, padded; the padding is kept at zero."""
    n = first_open(e, e.n_open)
    return min(MAX_LOCAL, (n + LANES - 1) // LANES * LANES)


@njit(cache=True)
def add_products(e: Any, n_rows: int) -> None:
    """gram += row' row over the n_rows local rows: the only work that every row costs."""
    gram, row, n = e.gram, e.row, local_width(e)
    if n_rows == 1:
        for i in range(n):
            a = row[0, i]
            for j in range(i - i % LANES, n):
                gram[i, j] += a * row[0, j]
    else:
        for i in range(n):
            a, b = row[0, i], row[1, i]
            for j in range(i - i % LANES, n):
                gram[i, j] += a * row[0, j] + b * row[1, j]


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
    return int(at)


@njit(cache=True)
def move_pairs(e: Any, pairs: Any, larger: Any) -> None:
    """Enter all records of pairs into the empty table larger, which is changed in place."""
    for p in range(len(pairs)):
        if pairs[p].key != 0:
            low, high = (pairs[p].key >> 32) - 1, (pairs[p].key & 0xFFFFFFFF) - 1
            larger[find_pair(e, larger, low, high)].gram[:] = pairs[p].gram


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
    for s in range(0, n - 1, 2):  # by twos: one pass over target for both chambers
        for i in range(TERMS):
            a, b = left[s, i], left[s + 1, i]
            for j in range(TERMS):
                target[i, j] += a * right[s, j] + b * right[s + 1, j]
    for s in range(n - n % 2, n):
        for i in range(TERMS):
            a = left[s, i]
            for j in range(TERMS):
                target[i, j] += a * right[s, j]


@njit(cache=True)
def close_block(e: Any, closed: Any, blocks: Any, pairs: Any, k: int) -> None:
    """Let open block k ring on: its state, referred to the ring's origin, joins the closed ones.

    Its own columns are flushed and cleared; `closed` must have room.
    """
    item, ring, first = closed[e.n_closed], first_ring(e), first_open(e, k)
    item.slot, item.size = e.open_slot[k], 0.0
    for s in range(e.n_state):
        for i in range(TERMS):
            item.d[s, i] = e.d[s, first + i]
            item.through[s, i] = e.gram[ring + s, first + i]
            item.size = max(item.size, abs(item.d[s, i]))
        for r in range(e.n_state):
            item.w_start[s, r] = e.gram[ring + min(s, r), ring + max(s, r)]
        for j in range(1 + e.n_shared):
            item.shared_start[s, j] = e.gram[j, ring + s]
    _refer_to_origin(e, item, ring)
    _flush_own(e, blocks, k)
    for other in range(e.n_open):
        if other != k:
            _flush_open_pair(e, pairs, k, other)
            _owe_less(e, pairs, item, other)
    _clear(e, first, TERMS)
    if item.size > 0.0:
        e.n_closed += 1


@njit(cache=True)
def _owe_less(e: Any, pairs: Any, item: Any, other: int) -> None:
    """Take back what open block `other` will charge this block for the time before it closed."""
    ring, first = first_ring(e), first_open(e, other)
    for s in range(e.n_state):
        for i in range(TERMS):
            e.owed[s, i] = -e.gram[ring + s, first + i]
    add_pair(e, pairs, item.slot, e.open_slot[other], item.d, e.owed)


@njit(cache=True)
def _refer_to_origin(e: Any, item: Any, ring: int) -> None:
    """item.d <- ring^-1 item.d, Gauss elimination with row pivots on a copy of the ring."""
    a, b, n = e.basis, item.d, e.n_state
    for i in range(n):
        for j in range(n):
            a[i, j] = e.d[i, ring + j]
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
def _flush_own(e: Any, blocks: Any, k: int) -> None:
    """Products of open block k with itself and the shared columns."""
    block, first = blocks[e.open_slot[k]], first_open(e, k)
    for i in range(TERMS):
        for j in range(TERMS):
            block.gram[i, j] += e.gram[first + min(i, j), first + max(i, j)]
        for j in range(1 + e.n_shared):
            block.shared[i, j] += e.gram[j, first + i]


@njit(cache=True)
def _flush_open_pair(e: Any, pairs: Any, k: int, other: int) -> None:
    """Products of two open blocks."""
    a, b = min(k, other), max(k, other)
    first, second = first_open(e, a), first_open(e, b)
    slot_a, slot_b = e.open_slot[a], e.open_slot[b]
    target = pairs[find_pair(e, pairs, min(slot_a, slot_b), max(slot_a, slot_b))].gram
    for i in range(TERMS):
        for j in range(TERMS):
            value = e.gram[first + i, second + j]
            if slot_a < slot_b:
                target[i, j] += value
            else:
                target[j, i] += value


@njit(cache=True)
def _clear(e: Any, first: int, count: int) -> None:
    """Zero local columns first .. first + count, states and products."""
    n = local_width(e)
    for j in range(first, first + count):
        for s in range(e.n_state):
            e.d[s, j] = 0.0
        for i in range(n):
            e.gram[i, j] = 0.0
            e.gram[j, i] = 0.0


@njit(cache=True)
def open_block(e: Any, closed: Any, blocks: Any, pairs: Any, k: int, edge: int, slot: int) -> None:
    """Make `slot` open block k: a place just closed, or n_open to append.

    If the block still rings, it goes on from the state it is in.
    """
    if k == e.n_open:
        e.n_open += 1
        _clear(e, first_open(e, k), TERMS)
    e.open_edge[k], e.open_slot[k], e.place[edge] = edge, slot, k
    for c in range(e.n_closed):
        if closed[c].slot == slot:
            _resume(e, closed, blocks, pairs, c, k)
            break


@njit(cache=True)
def _resume(e: Any, closed: Any, blocks: Any, pairs: Any, at: int, k: int) -> None:
    """Settle what closed block `at` shares with all others, and continue it as open block k."""
    item, ring = closed[at], first_ring(e)
    _settle_closed(e, closed, blocks, pairs, at)
    for c in range(at + 1, e.n_closed):
        _owed(e, closed[c])
        add_pair(e, pairs, item.slot, closed[c].slot, item.d, e.owed)
    for other in range(e.n_open):
        if other != k:
            first = first_open(e, other)
            through = e.gram[ring:, first : first + TERMS]
            add_pair(e, pairs, item.slot, e.open_slot[other], item.d, through)
    first = first_open(e, k)
    for s in range(e.n_state):
        for i in range(TERMS):
            for r in range(e.n_state):
                e.d[s, first + i] += e.d[s, ring + r] * item.d[r, i]
    for c in range(at, e.n_closed - 1):
        closed[c] = closed[c + 1]
    e.n_closed -= 1


@njit(cache=True)
def _owed(e: Any, item: Any) -> None:
    """e.owed: what a closed block's columns share with the ring's origin, while open and since.

    through + (ring x ring since it closed) d.
    """
    ring = first_ring(e)
    for s in range(e.n_state):
        for j in range(TERMS):
            e.owed[s, j] = item.through[s, j]
        for r in range(e.n_state):
            w = e.gram[ring + min(s, r), ring + max(s, r)] - item.w_start[s, r]
            for j in range(TERMS):
                e.owed[s, j] += w * item.d[r, j]


@njit(cache=True)
def _settle_closed(e: Any, closed: Any, blocks: Any, pairs: Any, at: int) -> None:
    """Add the products of closed block `at` with the shared columns, itself, and earlier ones."""
    item, ring = closed[at], first_ring(e)
    block = blocks[item.slot]
    for s in range(e.n_state):
        for j in range(1 + e.n_shared):
            shared = e.gram[j, ring + s] - item.shared_start[s, j]
            for i in range(TERMS):
                block.shared[i, j] += item.d[s, i] * shared
        for r in range(e.n_state):
            w = e.gram[ring + min(s, r), ring + max(s, r)] - item.w_start[s, r]
            for i in range(TERMS):
                for j in range(TERMS):
                    block.gram[i, j] += item.d[s, i] * w * item.d[r, j]
    _owed(e, item)
    for c in range(at):
        add_pair(e, pairs, closed[c].slot, item.slot, closed[c].d, e.owed)


@njit(cache=True)
def rebase(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """Settle all products, drop the blocks that fell silent, start the ring anew at I."""
    ring, n = first_ring(e), local_width(e)
    for k in range(e.n_open):
        _flush_own(e, blocks, k)
        for other in range(k + 1, e.n_open):
            _flush_open_pair(e, pairs, k, other)
        first = first_open(e, k)
        through = e.gram[ring:, first : first + TERMS]
        for c in range(e.n_closed):
            add_pair(e, pairs, closed[c].slot, e.open_slot[k], closed[c].d, through)
    for i in range(1 + e.n_shared):
        for j in range(1 + e.n_shared):
            e.shared[i, j] += e.gram[min(i, j), max(i, j)]
    for c in range(e.n_closed):
        _settle_closed(e, closed, blocks, pairs, c)
    _advance_closed(e, closed, ring)
    for i in range(n):
        for j in range(n):
            e.gram[i, j] = 0.0
    for s in range(e.n_state):
        for r in range(e.n_state):
            e.d[s, ring + r] = 1.0 if s == r else 0.0
    e.ring_det = 1.0


@njit(cache=True)
def _advance_closed(e: Any, closed: Any, ring: int) -> None:
    """Refer closed states to now, d <- ring d, with nothing owed; keep those that still ring."""
    kept = 0
    for c in range(e.n_closed):
        item, largest = closed[c], 0.0
        for s in range(e.n_state):
            for i in range(TERMS):
                e.owed[s, i] = item.d[s, i]
        for s in range(e.n_state):
            for i in range(TERMS):
                item.d[s, i], item.through[s, i] = 0.0, 0.0
                for r in range(e.n_state):
                    item.d[s, i] += e.d[s, ring + r] * e.owed[r, i]
                largest = max(largest, abs(item.d[s, i]))
            item.w_start[s, :] = 0.0
            item.shared_start[s, :] = 0.0
        if largest > e.ring_floor * item.size:
            closed[kept] = item
            kept += 1
    e.n_closed = kept


@njit(cache=True)
def remove_open(e: Any, k: int) -> None:
    """Take the closed and cleared block k out of the open ones; the last one takes its place."""
    e.place[e.open_edge[k]] = -1
    last = e.n_open - 1
    if k < last:
        to, source, gram = first_open(e, k), first_open(e, last), e.gram
        for i in range(TERMS):
            for s in range(e.n_state):
                e.d[s, to + i] = e.d[s, source + i]
            for j in range(to):
                gram[j, to + i] = gram[j, source + i]
            for j in range(to + TERMS, source):
                gram[to + i, j] = gram[j, source + i]
            for j in range(TERMS):
                gram[to + i, to + j] = gram[source + i, source + j]
        e.open_edge[k], e.open_slot[k] = e.open_edge[last], e.open_slot[last]
        e.place[e.open_edge[k]] = k
    _clear(e, first_open(e, last), TERMS)
    e.n_open = last


@njit(cache=True)
def forget(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """End all memory: settle every product and set all states to zero (a gap, a restart)."""
    rebase(e, closed, blocks, pairs)
    e.n_closed = 0
    ring, n = first_ring(e), local_width(e)
    for s in range(e.n_state):
        for j in range(n):
            if j < ring or j >= ring + e.n_state:
                e.d[s, j] = 0.0
