"""What recent blocks share: a dense matrix, which moves to the tables when a block falls silent.

A block is recent while it is open or rings.  It keeps its position p in `closed`; the entry of two
blocks is the sum of both tiles, closed[p].gram[:, of q] + closed[q].gram[:, of p]'; the diagonal
tile is its own.  All arguments named e, item, closed, blocks and pairs are records or record arrays
of `layout` and are changed in place.
"""

from __future__ import annotations

from typing import Any

from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import FREE, OPEN, TERMS
from rtid.plain import FloatArray


@part
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


@kernel
def move_pairs(engine: Any, pairs: Any, larger: Any) -> None:
    """Enter all records of pairs into the empty table larger, which is changed in place."""
    e = engine[0]
    e.n_pairs = 0
    for p in range(len(pairs)):
        if pairs[p].key != 0:
            low, high = (pairs[p].key >> 32) - 1, (pairs[p].key & 0xFFFFFFFF) - 1
            target = larger[find_pair(e, larger, low, high)]
            for i in range(TERMS):
                for j in range(TERMS):
                    target.gram[i, j] = pairs[p].gram[i, j]


@part
def admit(e: Any, closed: Any, slot: int) -> int:
    """Position for a block that is now open; one must be free."""
    p = 0
    while p < e.n_recent and closed[p].status != FREE:
        p += 1
    e.n_recent = max(e.n_recent, p + 1)
    closed[p].status, closed[p].slot = OPEN, slot
    return p


@part
def hand_over(e: Any, closed: Any, blocks: Any, pairs: Any, p: int) -> None:
    """Move what recent block p shares with itself and all others to the tables."""
    item = closed[p]
    block = blocks[item.slot]
    for i in range(TERMS):
        for j in range(TERMS):
            block.gram[i, j] += item.gram[i, TERMS * p + j]
            item.gram[i, TERMS * p + j] = 0.0
    for q in range(e.n_recent):
        if closed[q].status != FREE and q != p:
            a, b = (p, q) if item.slot < closed[q].slot else (q, p)
            pair = pairs[find_pair(e, pairs, closed[a].slot, closed[b].slot)]
            for i in range(TERMS):
                for j in range(TERMS):
                    pair.gram[i, j] += closed[a].gram[i, TERMS * b + j]
                    pair.gram[i, j] += closed[b].gram[j, TERMS * a + i]
                    closed[a].gram[i, TERMS * b + j] = 0.0
                    closed[b].gram[j, TERMS * a + i] = 0.0


@part
def release(e: Any, closed: Any, blocks: Any, pairs: Any, p: int) -> None:
    """Let block p be no longer recent: its sums go to the tables, its position is free."""
    hand_over(e, closed, blocks, pairs, p)
    closed[p].status = FREE
    for s in range(e.n_state):
        for j in range(TERMS * p, TERMS * p + TERMS):
            e.ringing[s, j] = 0.0
    while e.n_recent > 0 and closed[e.n_recent - 1].status == FREE:
        e.n_recent -= 1


@part
def spread(e: Any, item: Any, right: FloatArray, count: int) -> None:
    """item.gram[:, :count] += e.left' right[:, :count], (states, 6) and (states, m), scaled."""
    for i in range(TERMS):
        target = item.gram[i]
        for s in range(0, e.n_state - 1, 2):  # by twos: one pass over target for both chambers
            a, b, first, second = e.left[s, i], e.left[s + 1, i], right[s], right[s + 1]
            for j in range(count):
                target[j] += a * first[j] + b * second[j]
        if e.n_state == 1:
            a, first = e.left[0, i], right[0]
            for j in range(count):
                target[j] += a * first[j]


@inlined
def add_tile(e: Any, item: Any, p: int, a: FloatArray, b: FloatArray) -> None:
    """item.gram[:, of p] += a' b, both (states, 6), scaled as the gram is."""
    for s in range(e.n_state):
        for i in range(TERMS):
            for j in range(TERMS):
                item.gram[i, TERMS * p + j] += a[s, i] * b[s, j]
