"""What is done to the estimator's tables outside the tick: begin, settle, take the sums out.

The records are those of `layout`; all are changed in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtid.kernels.engine import SHUT, needs_room
from rtid.kernels.jit import kernel
from rtid.kernels.layout import FREE, MAX_EDGES, TERMS
from rtid.kernels.local import set_open
from rtid.kernels.recent import hand_over
from rtid.kernels.sparse_sums import rebase


@kernel
def settle(engine: Any, closed: Any, blocks: Any, pairs: Any) -> bool:
    """Bring the tables up to date without ending the memory, so that they can be read.

    False, and nothing is done, when they must be enlarged first.
    """
    e = engine[0]
    if needs_room(e, blocks, pairs):
        return False
    if e.running:
        rebase(e, closed, blocks, pairs, e.ring_floor)
        for p in range(e.n_recent):
            if closed[p].status != FREE:
                hand_over(e, closed, blocks, pairs, p)
    return True


@kernel
def clear_sums(engine: Any, blocks: Any, pairs: Any) -> None:
    """Empty all sums of settled tables; slots and the memory of recent columns stay."""
    e = engine[0]
    e.rows, e.n_pairs = 0.0, 0
    for i in range(1 + e.n_shared):
        for j in range(1 + e.n_shared):
            e.shared[i, j] = 0.0
    for c in range(e.n_chambers):
        e.noise_gram[c] = 0.0
    for s in range(e.n_slots):
        block = blocks[s]
        block.rows, block.dwell_s, block.surprise, block.judged = 0, 0.0, 0.0, 0.0
        for i in range(TERMS):
            block.phi_sum[i] = 0.0
            for j in range(TERMS):
                block.gram[i, j] = 0.0
            for j in range(1 + e.n_shared):
                block.shared[i, j] = 0.0
    for p in range(len(pairs)):
        if pairs[p].key != 0:
            pairs[p].key = 0
            for i in range(TERMS):
                for j in range(TERMS):
                    pairs[p].gram[i, j] = 0.0


@kernel
def clear(engine: Any, cells: Any) -> None:
    """Set the state of a zeroed record (not the configuration) to its beginning."""
    e = engine[0]
    e.running, e.break_due, e.n_slots, e.n_pairs = 0, 0, 0, 0
    e.n_closed, e.n_recent, e.n_young = 0, 0, 0
    e.ring, e.first = 1 + e.n_shared, 1 + e.n_shared + e.n_state
    set_open(e, 0)
    e.dt_s, e.ring_det, e.ready_s = 0.0, 1.0, -np.inf
    for i in range(MAX_EDGES):
        e.place[i] = -1
        e.cell[i, 0], e.cell[i, 1] = SHUT, SHUT
    for s in range(e.n_state):
        e.d[s, e.ring + s] = 1.0
    for c in range(len(cells)):
        cells[c].slot = -1
