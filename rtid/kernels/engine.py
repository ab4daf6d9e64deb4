"""The estimator's one hot path: samples in, information sums changed in place.

Per interval [t_k, t_k+1] and chamber c, eq. (14) integrated over it:

    s_c A_c (x_k+1 - x_k) = - V_mid (P_k+1 - P_k) theta_beta_c + sum of sigma int phi dt theta + ...

Replay calls `advance` with a whole trace, the daemon with one sample: same code, same bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtid.kernels.basis import locate_pair, relocate
from rtid.kernels.gate import admitted, forgive
from rtid.kernels.holds import GAUSS, lagged_moments, second_order
from rtid.kernels.increments import (
    block_increments,
    shared_increments,
    soften,
    term_increments,
    windowed_increments,
)
from rtid.kernels.jit import inlined, lean, part
from rtid.kernels.layout import (
    BLOCK,
    BLOCK_CHANGES,
    CELL,
    CLOSED,
    ENGINE,
    INTEGRAL,
    NOT_FINITE,
    OUT_OF_RANGE,
    OUTSIDE_GRID,
    PAIR,
    RECOVERING,
    RESTART,
    RESTART_GAP,
    RESTART_MEMORY,
    SAMPLES,
    TAYLOR,
)
from rtid.kernels.local import remove_open
from rtid.kernels.recent import release
from rtid.kernels.rows import (
    carry_row,
    carry_step,
    integral_row_one,
    integral_row_two,
    start_whitener,
)
from rtid.kernels.sparse_sums import (
    RING_DET_LIMIT,
    close_block,
    open_block,
    rebase,
)
from rtid.plain import FloatArray

ENGINE_BYTES, CELL_BYTES, CLOSED_BYTES = ENGINE.itemsize, CELL.itemsize, CLOSED.itemsize
BLOCK_BYTES = BLOCK.itemsize
ROW_FLAG, GAP_FLAG = 1, 2  # as in firmware_bridge.samples
INSANE = 1e30  # no quantity in SI units is that large, and its square is still a number
SHUT, OUTSIDE = -1, -2  # cell of an edge that passes nothing / whose working point is off the grid


@lean
def advance(memory: Any, chunk: FloatArray) -> int:
    """Take samples, rows of chunk (n, 2 + signals): [t_s, flags, values...], SI units.

    memory: the records of `layout` one after the other as bytes, changed in place (one argument:
    each costs a call from Python as much as the arithmetic of a block).  Returns the number of
    samples that are left: some when blocks or pairs must be enlarged first (see `needs_room`).
    """
    e = memory[:ENGINE_BYTES].view(ENGINE)[0]
    a = ENGINE_BYTES
    b = a + CELL_BYTES * e.n_cells
    c = b + CLOSED_BYTES * e.max_closed
    d = c + BLOCK_BYTES * e.max_blocks
    cell, ringing = memory[a:b].view(CELL), memory[b:c].view(CLOSED)
    block, pair = memory[c:d].view(BLOCK), memory[d:].view(PAIR)
    for k in range(len(chunk)):
        if needs_room(e, block, pair):
            return len(chunk) - k
        for j in range(2 + e.n_signals):  # a view of the row would be counted, atomically
            e.sample[j] = chunk[k, j]
        _take(e, cell, ringing, block, pair)
    return 0


@inlined
def needs_room(e: Any, blocks: Any, pairs: Any) -> bool:
    """True when the next sample could overflow the tables: blocks, or pairs more than 60 % full."""
    recent = e.n_open + e.n_closed + e.max_open
    full = 10 * (e.n_pairs + recent * recent // 2) > 6 * len(pairs)
    return full or e.n_slots + e.max_open > len(blocks)


@inlined
def _take(e: Any, cells: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """One sample: gate it, then integrate the interval that it closes."""
    e.counters[SAMPLES] += 1
    sample, flags = e.sample, int(e.sample[1])
    whole, dt = acceptable(e, sample), step_s(e, sample[0])
    joined = whole and e.running
    broken = (flags & GAP_FLAG) != 0 or dt > e.max_gap_s or dt <= 0.0 or e.break_due != 0
    if joined and broken:
        e.counters[RESTART_GAP] += 1
        joined = False
    if not whole or (e.running and not joined):
        e.ready_s = e.recovery_s + (sample[0] if math.isfinite(sample[0]) else e.t_s)
    inside = joined and _place(e, cells, closed, blocks, pairs, sample, dt)
    if inside:
        _integrate(e, cells, closed, blocks, pairs, sample, dt, (flags & ROW_FLAG) != 0)
    elif e.running:
        _stop(e, closed, blocks, pairs)
    if whole:
        remember(e, sample)
        if not joined and (flags & ROW_FLAG) != 0:
            if sample[0] < e.ready_s:
                e.counters[RECOVERING] += 1
            else:
                _start(e, sample)


@inlined
def step_s(e: Any, t_s: float) -> float:
    """Time since the last sample in whole microseconds: equal steps are equal to the bit."""
    return math.floor((t_s - e.t_s) * 1e6 + 0.5) * 1e-6


@part
def acceptable(e: Any, sample: FloatArray) -> bool:
    """Sample (2 + signals,), SI: finite and sane first (NaN passes none), then in its range."""
    for j in range(2 + e.n_signals):
        if not abs(sample[j]) < INSANE:
            e.counters[NOT_FINITE] += 1
            return False
    for j in range(e.n_signals):
        if sample[2 + j] < e.minimum[j] or sample[2 + j] > e.maximum[j]:
            e.counters[OUT_OF_RANGE] += 1
            return False
    return True


@inlined
def remember(e: Any, sample: FloatArray) -> None:
    """Keep the sample (2 + signals,), SI: it is the start of the next interval."""
    e.t_s = sample[0]
    for j in range(e.n_signals):
        e.values[j] = sample[2 + j]
    if e.n_terms > 0:
        soften(e)


@inlined
def _start(e: Any, sample: FloatArray) -> None:
    """Begin at a measured position: spools at rest, whitener at R, filters at zero."""
    remember(e, sample)
    e.running, e.break_due, e.blind, e.refused = 1, 0, 0, 0
    e.next_row_s = sample[0] + e.row_period_s
    for i in range(e.n_edges):
        e.w_v[i] = commanded(e, i)
    start_whitener(e)


@inlined
def commanded(e: Any, i: int) -> float:
    """Opening command of edge i at the last sample: zero in a mode that keeps it shut."""
    if (e.modes[i] >> int(e.values[e.mode_column])) & 1 == 0:
        return 0.0
    return float(e.direction[i] * e.values[e.command[i]])


@inlined
def _stop(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """End all memory at a break of continuity; learned sums stay."""
    rebase(e, closed, blocks, pairs, np.inf)
    while e.n_open > 0:
        release(e, closed, blocks, pairs, e.open_recent[e.n_open - 1])
        remove_open(e, e.n_open - 1)
    for i in range(e.n_edges):
        e.cell[i, 0] = SHUT
    e.running = 0


@inlined
def _place(
    e: Any, cells: Any, closed: Any, blocks: Any, pairs: Any, sample: FloatArray, dt: float
) -> bool:
    """Find the block of every edge over the interval; False where one is off its grid."""
    if dt != e.dt_s:
        set_step(e, dt)
    inside, moved = working_points(e, sample, dt)
    if not inside:
        e.counters[OUTSIDE_GRID] += 1
    elif moved:
        if e.form == RESTART:
            rebase(e, closed, blocks, pairs, np.inf)
        elif e.n_open + e.n_closed + e.max_open > len(closed):
            _begin_new_memory(e, closed, blocks, pairs)
        _change_blocks(e, cells, closed, blocks)
    return inside


@inlined
def _begin_new_memory(e: Any, closed: Any, blocks: Any, pairs: Any) -> None:
    """Too many blocks ring at once: forget them all.

    Costs one unknown start position per chamber, and bounds the work.
    """
    e.counters[RESTART_MEMORY] += 1
    rebase(e, closed, blocks, pairs, np.inf)
    start_whitener(e)


@inlined
def _integrate(
    e: Any,
    cells: Any,
    closed: Any,
    blocks: Any,
    pairs: Any,
    sample: FloatArray,
    dt: float,
    row: bool,
) -> None:
    """Integrate the columns over [t, t + dt]; make a row where the position was measured."""
    shared_increments(e, sample, dt)
    if e.n_terms > 0:
        term_increments(e, sample, dt)
    for k in range(e.n_open):
        i = e.open_edge[k]
        if e.is_shared[i] != 0:
            _shared_increments(e, cells, blocks, k, sample[0], dt, row)
        elif e.map_basis[i] != TAYLOR:
            windowed_increments(e, cells, blocks, k, i, sample[0], dt, row)
        else:
            block_increments(e, cells, blocks, k, i, sample[0], dt, row)
    if e.form != INTEGRAL:
        carry_step(e)
        remember(e, sample)
        if e.t_s > e.next_row_s - 0.5 * dt:
            e.next_row_s += e.row_period_s * max(
                1.0, math.ceil((e.t_s - e.next_row_s) / e.row_period_s)
            )
            carry_row(e)
    else:
        remember(e, sample)
        _integral_step(e, blocks, row)
    if e.ring_det < RING_DET_LIMIT:
        rebase(e, closed, blocks, pairs, e.ring_floor)


@part
def _shared_increments(
    e: Any, cells: Any, blocks: Any, k: int, t: float, dt: float, row: bool
) -> None:
    """Open block k of a map of several commands: each that is in it adds its own."""
    for i in range(e.n_edges):
        if e.owner[i] == e.open_edge[k] and _covers(e, i, e.open_cell[k, 0], e.open_cell[k, 1]):
            if e.map_basis[i] != TAYLOR:
                windowed_increments(e, cells, blocks, k, i, t, dt, row)
            else:
                block_increments(e, cells, blocks, k, i, t, dt, row)


@inlined
def _covers(e: Any, i: int, u: int, p: int) -> bool:
    """True where block (u, p) is one of those that edge i is in."""
    reach = 0 if e.map_basis[i] == TAYLOR else 1
    a, b = u - e.cell[i, 0], p - e.cell[i, 1]
    return bool(e.cell[i, 0] != SHUT and 0 <= a <= reach and 0 <= b <= reach)


@inlined
def set_step(e: Any, dt: float) -> None:
    """Factors that depend on the length of the step alone."""
    e.dt_s = dt
    e.lag_decay = math.exp(-dt / e.lag_s) if e.lag_s > 0.0 else 0.0
    for g in range(2):
        at = 0.5 + (GAUSS if g == 1 else -GAUSS)
        e.gauss_decay[g] = math.exp(-at * dt / e.lag_s) if e.lag_s > 0.0 else 0.0
    if e.form != INTEGRAL:
        second_order(e.wn_rad_s, e.zeta, dt, e.filter_a, e.filter_b)


@part
def working_points(e: Any, sample: FloatArray, dt: float) -> tuple[bool, bool]:
    """Per edge: moments of the lagged command in V, dp at both ends in Pa, block of the mean.

    Returns (every edge that is open lies inside its grid, some edge changes its block).
    """
    inside, moved, moments, dp, target = True, False, e.moments, e.dp_pa, e.target
    for i in range(e.n_edges):
        u = commanded(e, i)
        if e.is_sampled[i] != 0:
            j = e.command[i]
            u += 0.5 * e.direction[i] * (sample[2 + j] - e.values[j])
        end, m1, m2, mt = lagged_moments(u, e.w_v[i], e.lag_s, e.lag_decay, dt)
        e.held_v[i], e.start_v[i], e.w_v[i] = u, e.w_v[i], end
        iu, ip = SHUT, e.cell[i, 1]
        if m1 > e.safe_v[i]:
            dp[i, 0] = e.values[e.source[i]] - e.values[e.sink[i]]
            dp[i, 1] = sample[2 + e.source[i]] - sample[2 + e.sink[i]]
            moments[i, 0], moments[i, 1], moments[i, 2] = m1, m2, mt
            mid, before = 0.5 * (dp[i, 0] + dp[i, 1]), ip if e.cell[i, 0] != SHUT else SHUT
            if e.map_basis[i] != TAYLOR:
                iu, e.home[i, 0] = locate_pair(e.u_border[i], e.n_u[i], m1)
                ip, e.home[i, 1] = locate_pair(e.dp_border[i], e.n_dp[i], mid)
            else:
                iu = relocate(e.u_border[i], e.n_u[i], m1, e.cell[i, 0], e.hysteresis)
                ip = relocate(e.dp_border[i], e.n_dp[i], mid, before, e.hysteresis)
                e.home[i, 0], e.home[i, 1] = iu, ip
            inside = inside and iu >= 0 and ip >= 0
        moved = moved or iu != e.cell[i, 0] or ip != e.cell[i, 1]
        target[i, 0], target[i, 1] = iu, ip
    return inside, moved


@inlined
def home_of(e: Any, i: int) -> tuple[int, int]:
    """The block that holds the working point of edge i; SHUT while it is shut."""
    if e.target[i, 0] == SHUT:
        return SHUT, e.target[i, 1]
    return e.home[i, 0], e.home[i, 1]


@part
def _change_blocks(e: Any, cells: Any, closed: Any, blocks: Any) -> None:
    """Close the blocks that the working points left, open those that they entered.

    Edges that shut come first, or a reversal of the command could exceed the places for open ones.
    """
    for opening in range(2):
        for i in range(e.n_edges):
            if (e.target[i, 0] != SHUT) == (opening == 1) and _moved(e, i):
                if e.map_basis[i] != TAYLOR or e.is_shared[i] != 0:
                    _change_windows(e, cells, closed, blocks, i)
                else:
                    _change(e, cells, closed, blocks, i)
    if e.refused == 0:
        forgive(e)


@inlined
def _moved(e: Any, i: int) -> bool:
    """True when edge i is to be in another block than it was."""
    if e.target[i, 0] != e.cell[i, 0]:
        return True
    return bool(e.target[i, 0] != SHUT and e.target[i, 1] != e.cell[i, 1])


@inlined
def _change(e: Any, cells: Any, closed: Any, blocks: Any, i: int) -> None:
    e.counters[BLOCK_CHANGES] += 1
    e.cell[i, 0], e.cell[i, 1] = e.target[i, 0], e.target[i, 1]
    k, was_open = e.place[i], e.place[i] >= 0
    if was_open:
        close_block(e, closed, blocks, k)
    if e.target[i, 0] != SHUT:
        k, u, p = k if was_open else e.n_open, e.cell[i, 0], e.cell[i, 1]
        open_block(e, closed, blocks, k, i, _slot(e, cells, blocks, i, u, p), u, p)
    elif was_open:
        remove_open(e, k)


@part
def _change_windows(e: Any, cells: Any, closed: Any, blocks: Any, i: int) -> None:
    """The same for the windows that share a point, up to two by two from the cell on.

    A block of a shared map stays open as long as any of its commands is in it.
    """
    e.counters[BLOCK_CHANGES] += 1
    u, p, owner = e.target[i, 0], e.target[i, 1], e.owner[i]
    e.cell[i, 0], e.cell[i, 1] = u, p
    for k in range(e.n_open - 1, -1, -1):
        if e.open_edge[k] == owner and not _is_used(e, owner, e.open_cell[k, 0], e.open_cell[k, 1]):
            close_block(e, closed, blocks, k)
            remove_open(e, k)
    if u == SHUT:
        return
    n = 1 if e.map_basis[i] == TAYLOR else 2
    for a in range(u, min(u + n, e.n_u[i])):
        for b in range(p, min(p + n, e.n_dp[i])):
            if not _is_open(e, owner, a, b):
                slot = _slot(e, cells, blocks, owner, a, b)
                open_block(e, closed, blocks, e.n_open, owner, slot, a, b)


@inlined
def _is_used(e: Any, owner: int, u: int, p: int) -> bool:
    """True where a command of this map is in block (u, p)."""
    used = False
    for i in range(e.n_edges):
        used = used or (e.owner[i] == owner and _covers(e, i, u, p))
    return used


@inlined
def _is_open(e: Any, i: int, u: int, p: int) -> bool:
    for k in range(e.n_open):
        if e.open_edge[k] == i and e.open_cell[k, 0] == u and e.open_cell[k, 1] == p:
            return True
    return False


@part
def _slot(e: Any, cells: Any, blocks: Any, edge: int, u: int, p: int) -> int:
    """Slot of a cell of the edge, given out at its first visit."""
    at = e.first_cell[edge] + u * e.n_dp[edge] + p
    if cells[at].slot < 0:
        cells[at].slot = e.n_slots
        blocks[e.n_slots].cell = at
        blocks[e.n_slots].edge = edge
        e.n_slots += 1
    return int(cells[at].slot)


@inlined
def _integral_step(e: Any, blocks: Any, row: bool) -> None:
    """Noise of the interval, then a row, unless its innovation is refused."""
    for c in range(e.n_chambers):
        e.cov[c, c] += e.q_floor[c] * e.dt_s
    if row and (e.gate_sd <= 0.0 or admitted(e, blocks)):
        if e.n_chambers == 2:
            integral_row_two(e)
        else:
            integral_row_one(e)
