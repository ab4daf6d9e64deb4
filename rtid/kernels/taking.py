"""One sample of a whole record at a time, for the passes that hold a model against it."""

from __future__ import annotations

from typing import Any

from rtid.kernels.engine import (
    GAP_FLAG,
    ROW_FLAG,
    SHUT,
    acceptable,
    commanded,
    remember,
    set_step,
    step_s,
    working_points,
)
from rtid.kernels.jit import inlined
from rtid.kernels.rows import start_whitener
from rtid.plain import FloatArray

# FOLLOWED: the spools are, and no row has begun; OUTSIDE: the point is off a grid
AWAY, RUNNING, FOLLOWED, OUTSIDE = 0, 1, 2, 3


@inlined
def take(e: Any, chunk: FloatArray, k: int) -> tuple[bool, bool, float]:
    """Sample k of chunk (n, 2 + signals) to e.sample: (usable, joins the last one, step in s)."""
    for j in range(2 + e.n_signals):
        e.sample[j] = chunk[k, j]
    sample, flags, dt = e.sample, int(e.sample[1]), step_s(e, e.sample[0])
    whole = acceptable(e, sample)
    goes_on = whole and e.running != AWAY and 0.0 < dt <= e.max_gap_s and (flags & GAP_FLAG) == 0
    if not goes_on:
        e.running = AWAY
        return whole, False, dt
    if dt != e.dt_s:
        set_step(e, dt)
    inside = working_points(e, sample, dt)[0]
    joined = inside and e.running == RUNNING and e.t_s > e.ready_s - 0.5 * dt
    if not joined:
        e.running = FOLLOWED if inside else OUTSIDE
    return whole, joined, dt


@inlined
def resume(e: Any, sample: FloatArray, whole: bool) -> bool:
    """Behind a sample (2 + signals,), SI, that joins nothing: True where rows begin at it.

    That is at a measured position.  Where spools stood before the first sample, or behind a gap,
    nobody knows: they are taken to be where they are sent, and believed once that has faded.  Off
    the grids they are so too, as in the sums that maps are learned by: they meet the same blocks.
    """
    row = whole and (int(sample[1]) & ROW_FLAG) != 0
    if not whole:
        return False
    if e.running == AWAY:
        e.ready_s = sample[0] + e.settle_s
    remember(e, sample)
    for i in range(e.n_edges):
        if e.running in (AWAY, OUTSIDE):
            e.w_v[i] = commanded(e, i)
        e.cell[i, 0] = SHUT
    e.running = RUNNING if row else FOLLOWED
    if row:
        start_whitener(e)
    return row
