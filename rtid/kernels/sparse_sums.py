"""Sparse information sums of rows that touch many blocks, each with a fading memory.

A whitened or filtered row is N_k d_k, where every column's state obeys

    d_{k+1} = M_k (d_k + increment)          (increment = 0 while its block is closed)

so all closed blocks decay by the same product of M_k.  With `ring` = that product as local
columns, d_closed(k) = ring(k) d_hat with constant d_hat, and what a closed block shares with any
other column follows from the products of the ring with that column:

* with an open block, from ring x open, kept with the open block when it closes (`through`);
* with another closed block, from W = ring x ring since the later one closed.  It begins anew at
  each closing: W since a late one is small, and would be a difference of two nearly equal sums.

Both are settled when the ring begins anew (`rebase`), or when a block is entered again.  Blocks
that rang all the time since the last rebase are settled as one product of matrices, those that
closed since (the young) one by one.  This is exact: the normal equations of the dense rows, at a
cost per sample and per change of block that does not depend on the number of blocks.

All arguments named e, item, closed, blocks and pairs are records or record arrays of `layout` and
are changed in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import OPEN, RINGING, TERMS, YOUNG
from rtid.kernels.local import clear_open, set_open
from rtid.kernels.recent import add_tile, admit, release, spread
from rtid.plain import FloatArray

# Rebase before the ring columns lose digits: at det ring = 1e-3 they lose three of sixteen.
RING_DET_LIMIT = 1e-3


# --- products of one block ---


@inlined
def _ring_ring(e: Any, s: int, r: int) -> float:
    """W[s, r] since the last closing."""
    ring = e.ring
    return e.gram[ring + max(s, r), ring + min(s, r)]


@inlined
def _read_through(e: Any, k: int, sign: float, out: FloatArray) -> None:
    """out (states, 6) = sign * ring x open block k."""
    ring, first = e.ring, e.first + TERMS * k
    for s in range(e.n_state):
        for i in range(TERMS):
            out[s, i] = sign * e.gram[first + i, ring + s]


@inlined
def _add_own(e: Any, closed: Any, blocks: Any, k: int) -> None:
    """Products of open block k with itself and the shared columns."""
    p, first = e.open_recent[k], e.first + TERMS * k
    item, block = closed[p], blocks[e.open_slot[k]]
    for i in range(TERMS):
        for j in range(1 + e.n_shared):
            block.shared[i, j] += e.gram[first + i, j]
        for j in range(TERMS):
            item.gram[i, TERMS * p + j] += e.gram[first + max(i, j), first + min(i, j)]


@inlined
def _add_open_pair(e: Any, closed: Any, k: int, other: int) -> None:
    """Products of two open blocks."""
    a, b = max(k, other), min(k, other)
    item, at = closed[e.open_recent[a]], TERMS * e.open_recent[b]
    first, second = e.first + TERMS * a, e.first + TERMS * b
    for i in range(TERMS):
        for j in range(TERMS):
            item.gram[i, at + j] += e.gram[first + i, second + j]


@part
def _weigh(e: Any, item: Any) -> None:
    """What a closed block's columns share with the ring's origin, while open and since.

    e.own = (W since it closed) d,  e.left = through + e.own.
    """
    for s in range(e.n_state):
        for i in range(TERMS):
            e.own[s, i] = 0.0
        for r in range(e.n_state):
            w = _ring_ring(e, s, r) - item.w_start[s, r]
            for i in range(TERMS):
                e.own[s, i] += w * item.d[r, i]
        for i in range(TERMS):
            e.left[s, i] = item.through[s, i] + e.own[s, i]


@part
def _add_shared(e: Any, item: Any, block: Any) -> None:
    """Products of a closed block with y and the shared columns since it closed."""
    ring = e.ring
    for s in range(e.n_state):
        for j in range(1 + e.n_shared):
            value = e.gram[ring + s, j] - item.shared_start[s, j]
            for i in range(TERMS):
                block.shared[i, j] += item.d[s, i] * value


# --- changes of block ---


@inlined
def _begin_ring_ring(e: Any, closed: Any) -> None:
    """Let W begin anew at a closing; what it was so far stays with the blocks closed before."""
    for s in range(e.n_state):
        for r in range(e.n_state):
            w = _ring_ring(e, s, r)
            for p in range(e.n_recent):
                closed[p].w_start[s, r] -= w
    for s in range(e.n_state):
        for r in range(e.n_state):
            e.gram[e.ring + s, e.ring + r] = 0.0


@part
def close_block(e: Any, closed: Any, blocks: Any, k: int) -> None:
    """Let open block k ring on, its state referred to the ring's origin; clear its columns."""
    p, first, ring = e.open_recent[k], e.first + TERMS * k, e.ring
    item = closed[p]
    _begin_ring_ring(e, closed)
    item.status, item.size = YOUNG, 0.0
    for s in range(e.n_state):
        for i in range(TERMS):
            item.d[s, i] = e.d[s, first + i]
            item.size = max(item.size, abs(item.d[s, i]))
        for r in range(e.n_state):
            item.w_start[s, r] = 0.0
        for j in range(1 + e.n_shared):
            item.shared_start[s, j] = e.gram[ring + s, j]
    _read_through(e, k, 1.0, item.through)
    _refer_to_origin(e, item.d)
    _add_own(e, closed, blocks, k)
    for other in range(e.n_open):
        if other != k:
            _add_open_pair(e, closed, k, other)
            _read_through(e, other, -1.0, e.left)  # `other` will charge it from the beginning
            add_tile(e, item, e.open_recent[other], item.d, e.left)
    clear_open(e, k)
    e.young[e.n_young] = p
    e.n_young += 1
    e.n_closed += 1


@part
def _refer_to_origin(e: Any, b: FloatArray) -> None:
    """b <- ring^-1 b, Gauss elimination with row pivots on a copy of the ring."""
    a, n, ring = e.basis, e.n_state, e.ring
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


@part
def open_block(
    e: Any, closed: Any, blocks: Any, k: int, edge: int, slot: int, iu: int, ip: int
) -> None:
    """Make `slot`, block (iu, ip) of its edge, open block k: a place just closed, or n_open.

    If the block still rings, it goes on from the state it is in; else a position must be free.
    """
    if k == e.n_open:
        set_open(e, k + 1)
        clear_open(e, k)
    e.open_edge[k], e.open_slot[k], e.place[edge] = edge, slot, k
    e.open_cell[k, 0], e.open_cell[k, 1] = iu, ip
    for p in range(e.n_recent):
        if closed[p].slot == slot and closed[p].status >= YOUNG:
            _settle_one(e, closed, blocks, k, p)
            _resume(e, closed[p], k, p)
            return
    e.open_recent[k] = admit(e, closed, slot)


@part
def _settle_one(e: Any, closed: Any, blocks: Any, k: int, p: int) -> None:
    """Settle what closed block p shares with all but open block k; a young one is so no more."""
    item, later = closed[p], 0
    if item.status == YOUNG:
        while e.young[later] != p:
            later += 1
        _settle_young(e, closed, later)
        e.n_young -= 1
        for a in range(later, e.n_young):
            e.young[a] = e.young[a + 1]
    else:
        _weigh(e, item)
        spread(e, item, e.ringing, TERMS * e.n_recent)
    for a in range(later, e.n_young):
        _weigh(e, closed[e.young[a]])
        add_tile(e, closed[e.young[a]], p, e.left, item.d)
    for other in range(e.n_open):
        if other != k:
            _read_through(e, other, 1.0, e.left)
            add_tile(e, item, e.open_recent[other], item.d, e.left)
    _add_shared(e, item, blocks[item.slot])


@inlined
def _resume(e: Any, item: Any, k: int, p: int) -> None:
    """Continue closed block p as open block k."""
    first, ring = e.first + TERMS * k, e.ring
    for s in range(e.n_state):
        for i in range(TERMS):
            e.ringing[s, TERMS * p + i] = 0.0
            for r in range(e.n_state):
                e.d[s, first + i] += e.d[s, ring + r] * item.d[r, i]
    item.status, e.open_recent[k] = OPEN, p
    e.n_closed -= 1


# --- the ring begins anew ---


@part
def rebase(e: Any, closed: Any, blocks: Any, pairs: Any, floor: float) -> None:
    """Settle all products, drop the blocks that fell silent, start the ring anew at I.

    floor: share of its size at closing below which a block is silent; with inf all memory ends,
    and all states are zero.
    """
    for k in range(e.n_open):
        _settle_open(e, closed, blocks, k)
    for i in range(1 + e.n_shared):
        for j in range(1 + e.n_shared):
            e.shared[i, j] += e.gram[max(i, j), min(i, j)]
    _settle_ringing(e, closed, blocks)
    for a in range(e.n_young):
        _settle_young(e, closed, a)
        _add_shared(e, closed[e.young[a]], blocks[closed[e.young[a]].slot])
    e.n_young = 0
    _advance_closed(e, closed, blocks, pairs, floor)
    for i in range(e.width):
        for j in range(e.width):
            e.gram[i, j] = 0.0
    for s in range(e.n_state):
        for j in range(e.width):
            if floor == np.inf or e.ring <= j < e.first:
                e.d[s, j] = 1.0 if j == e.ring + s else 0.0
    e.ring_det = 1.0


@inlined
def _settle_open(e: Any, closed: Any, blocks: Any, k: int) -> None:
    """Products of open block k with itself, the open ones before it and all closed ones."""
    _add_own(e, closed, blocks, k)
    for other in range(k):
        _add_open_pair(e, closed, k, other)
    item = closed[e.open_recent[k]]
    _read_through(e, k, 1.0, e.left)
    spread(e, item, e.ringing, TERMS * e.n_recent)
    for a in range(e.n_young):
        add_tile(e, item, e.young[a], e.left, closed[e.young[a]].d)


@part
def _settle_young(e: Any, closed: Any, a: int) -> None:
    """Products of the a-th young block with itself and all that closed before it."""
    p = e.young[a]
    item = closed[p]
    _weigh(e, item)
    add_tile(e, item, p, e.own, item.d)
    spread(e, item, e.ringing, TERMS * e.n_recent)
    for b in range(a):
        add_tile(e, item, e.young[b], e.left, closed[e.young[b]].d)


@inlined
def _settle_ringing(e: Any, closed: Any, blocks: Any) -> None:
    """d_a' W d_b of those that rang all the time, and their products with the shared columns."""
    first = 0
    while first < e.n_recent and closed[first].status != RINGING:
        first += 1
    if first == e.n_recent:
        return
    for s in range(e.n_state):
        target = e.weighted[s]
        for j in range(TERMS * e.n_recent):
            target[j] = 0.0
        for r in range(e.n_state):
            w, source = _ring_ring(e, s, r) - closed[first].w_start[s, r], e.ringing[r]
            for j in range(TERMS * e.n_recent):
                target[j] += w * source[j]
    for p in range(e.n_recent):
        item = closed[p]
        if item.status == RINGING:
            for s in range(e.n_state):
                for i in range(TERMS):
                    e.left[s, i] = item.d[s, i]
            spread(e, item, e.weighted, TERMS * (p + 1))
            _add_shared(e, item, blocks[item.slot])


@inlined
def _advance_closed(e: Any, closed: Any, blocks: Any, pairs: Any, floor: float) -> None:
    """Refer closed states to now, d <- ring d, with nothing owed; release the silent ones."""
    for p in range(e.n_recent - 1, -1, -1):
        if closed[p].status >= YOUNG:
            closed[p].status = RINGING
            if not _advance_one(e, closed[p], p) > floor * closed[p].size:
                e.n_closed -= 1
                release(e, closed, blocks, pairs, p)


@part
def _advance_one(e: Any, item: Any, p: int) -> float:
    """As above for one block; returns the size of its state."""
    largest, ring = 0.0, e.ring
    for s in range(e.n_state):
        for i in range(TERMS):
            value = 0.0
            for r in range(e.n_state):
                value += e.d[s, ring + r] * item.d[r, i]
            e.ringing[s, TERMS * p + i] = value
            largest = max(largest, abs(value))
    for s in range(e.n_state):
        for i in range(TERMS):
            item.d[s, i], item.through[s, i] = e.ringing[s, TERMS * p + i], 0.0
        for r in range(e.n_state):
            item.w_start[s, r] = 0.0
        for j in range(1 + e.n_shared):
            item.shared_start[s, j] = 0.0
    return largest
