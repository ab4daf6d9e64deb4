"""One sample of a whole record at a time, for the passes that hold a model against it.

A pressure is no line over a long step.  Its mean over one, of h s, is off the chord by

    b = -1/h int s (h - s) / 2 P'' ds  =  -(h^2 / 12) P''

for the second derivative that the neighbouring steps tell of: the parabola, or for even steps the
integral of the cubic through four samples.  A bend within one instant, as behind a jump of the
command, is anywhere in its step, and takes h^2 x (1 - x) / 2 of its slope's change: the mean over x
is that of the rule, 1/12, and the variance 1/720, a fifth of its square, which is noise of the row.
What has not come yet nobody knows on board: there pressures are lines, at the rates of controllers.
"""

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
from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import NOTHING
from rtid.kernels.rows import start_whitener
from rtid.plain import FloatArray

# FOLLOWED: the spools are, and no row has begun; OUTSIDE: the point is off a grid
AWAY, RUNNING, FOLLOWED, OUTSIDE = 0, 1, 2, 3
STRAIGHT_S = 1.5e-3  # step up to which rows are those of the sums on board: b has h^2
EACH = 1.01  # steps within which pressures come that each sample has measured
UNSURE = 0.2  # variance of a bend, of its square


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
    if inside and _is_long(e, dt):
        for i in range(e.n_edges):
            off = bend(e, chunk, k, i)
            e.dp_pa[i, 0] += off
            e.dp_pa[i, 1] += off
    joined = inside and e.running == RUNNING and e.t_s > e.ready_s - 0.5 * dt
    if not joined:
        e.running = FOLLOWED if inside else OUTSIDE
    return whole, joined, dt


@inlined
def _is_long(e: Any, dt: float) -> bool:
    """True for a step over which pressures bend that were measured at both its ends."""
    return bool(dt > STRAIGHT_S and e.p_column[0] != NOTHING and e.p_period_s < EACH * dt)


@part
def bend(e: Any, chunk: FloatArray, k: int, i: int) -> float:
    """How far the drop of edge i is off its chord in the step to sample k, on average, Pa.

    chunk (n, 2 + signals), SI; 0 where a neighbouring step is not there.
    """
    if k < 2 or k + 1 >= len(chunk) or not (_joins(e, chunk, k - 1) and _joins(e, chunk, k + 1)):
        return 0.0
    bent, h = 0.0, chunk[k, 0] - chunk[k - 1, 0]
    for side in range(2):
        j = e.source[i] if side == 0 else e.sink[i]
        if j == NOTHING:
            continue
        for row in (k - 2, k + 1):
            if not e.minimum[j] <= chunk[row, 2 + j] <= e.maximum[j]:
                return 0.0
        turn = _slope(chunk, k + 1, j) - _slope(chunk, k, j)
        before = _slope(chunk, k, j) - _slope(chunk, k - 1, j)
        curved = turn / (chunk[k + 1, 0] - chunk[k - 1, 0])
        curved += before / (chunk[k, 0] - chunk[k - 2, 0])
        bent -= (1.0 - 2.0 * side) * h * h / 12.0 * curved
    return bent


@inlined
def _joins(e: Any, chunk: FloatArray, k: int) -> bool:
    """True where sample k of chunk (n, 2 + signals) goes on from the one before."""
    dt = chunk[k, 0] - chunk[k - 1, 0]
    return bool(0.0 < dt <= e.max_gap_s and (int(chunk[k, 1]) & GAP_FLAG) == 0)


@inlined
def _slope(chunk: FloatArray, k: int, j: int) -> float:
    """Rate of signal j of chunk (n, 2 + signals) in the step to sample k, its unit per s."""
    return float((chunk[k, 2 + j] - chunk[k - 1, 2 + j]) / (chunk[k, 0] - chunk[k - 1, 0]))


@inlined
def bent_noise(e: Any, chunk: FloatArray, k: int, i: int, slope: float, dt: float) -> None:
    """Add what is unknown of a bend to the random walk of the integral, (m3)^2: e.cov.

    chunk (n, 2 + signals), SI; slope: dQ/ddp of edge i, m3/s/Pa.
    """
    if not _is_long(e, dt):
        return
    missed = slope * bend(e, chunk, k, i) * dt
    for a in range(e.n_chambers):
        for b in range(e.n_chambers):
            e.cov[a, b] += UNSURE * e.sign[i, a] * e.sign[i, b] * missed * missed


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
