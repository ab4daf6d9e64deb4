"""The innovation gate: a row must be what the map held says, within the noise.

The gap between y and the map held passes the same whitener as the columns; whitened, with the map's
own error beside the noise, it has unit variance at most.  A refused row is as if the position had
not been measured, so that one outlier costs one row.  At a change of block the gap begins at zero,
so that each block answers for itself, but not while rows are being refused: what is wrong then has
to show that it lasts.  When rows are refused for long, the plant or a sensor's zero has changed:
all memory ends, and the gate admits everything until another map is held, but goes on to judge.
"""

from __future__ import annotations

from typing import Any

from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import OUTLIER, REOPENED, TAYLOR
from rtid.kernels.rows import fade, innovations, position_noise


@part
def admitted(e: Any, blocks: Any) -> bool:
    """Judge the coming row, follow the gap through it; False when it is refused."""
    blind, e.blind = e.blind != 0, 0
    if blind and e.refused == 0:  # what the unknown block adds to the gap must not be judged later
        forgive(e)
        return True
    first, second = innovations(e, e.gap, e.gap_sd[0] ** 2, e.gap_sd[1] ** 2)
    if not blind:
        limit = e.gate_sd * e.gate_sd
        _judge(e, blocks, min(first * first, limit) + min(second * second, limit))
    if (blind or max(abs(first), abs(second)) > e.gate_sd) and e.admits_all == 0:
        e.counters[OUTLIER] += 1
        e.refused += 1
        if e.refused >= e.gate_rows:
            e.counters[REOPENED] += 1
            e.admits_all, e.refused, e.break_due = 1, 0, 1
        return False
    e.refused = 0
    _follow(e)
    return True


@inlined
def forgive(e: Any) -> None:
    """Begin the gap at zero."""
    for c in range(e.n_chambers):
        e.gap[c], e.gap_sd[c] = 0.0, 0.0


@inlined
def _judge(e: Any, blocks: Any, square: float) -> None:
    """Note the surprise with the blocks that hold the working points."""
    for k in range(e.n_open):
        i = e.open_edge[k]
        home = e.open_cell[k, 0] == e.home[i, 0] and e.open_cell[k, 1] == e.home[i, 1]
        if e.map_basis[i] == TAYLOR or home:
            blocks[e.open_slot[k]].surprise += square
            blocks[e.open_slot[k]].judged += e.n_chambers


@inlined
def _follow(e: Any) -> None:
    """Let the gap fade as the columns do at a row, and the share that is the map's own error."""
    for c in range(e.n_chambers):
        r = position_noise(e, c, c)
        e.gap_sd[c] *= r / (e.cov[c, c] + r)
    fade(e, e.gap)
