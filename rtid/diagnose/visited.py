"""Where a record is like the one that taught its maps: in parts of blocks that this has passed.

Six terms hold within a block for what has taught them.  Where a valve opens in the middle of one,
and what taught it came by above the opening alone, they say nothing of what is below it; nor does
their deviation, which is that of a law with six terms.  So each interval of a block is cut into
four along either axis, and a part of a block is known that has taught as many samples as a block
needs for its terms (`Gates.min_rows`).
"""

from __future__ import annotations

import numpy as np

from rtid.effects.record_view import RecordView
from rtid.model import Grid
from rtid.plain import BoolArray, FloatArray, IntArray

PARTS = 4  # of a block's interval, along either axis


def where_taught(view: RecordView) -> BoolArray:
    """True (n - 1,) where each open edge is in a part of a block that has been visited enough.

    view: of a record beside a map that another one, `view.taught`, has taught; of that one itself
    it is true everywhere.
    """
    known = np.ones(view.n - 1, bool)
    if view.taught is None or not view.model.has_pressures:
        return known
    for i, edge in enumerate(view.model.edges):
        here, is_open = _parts(view, i)
        there, taught = _parts(view.taught, i)
        visits = np.bincount(there[taught], minlength=_n_parts(edge.grid))
        known &= ~is_open | (visits[here] >= view.model.gates.min_rows)
    return known


def _parts(view: RecordView, i: int) -> tuple[IntArray, BoolArray]:
    """The part of a block that edge i is in, and whether it is open; both (n - 1,)."""
    edge = view.model.edges[i]
    drop = view.signal(edge.source) - view.signal(edge.sink)
    w, grid = view.opening(i), edge.grid
    along, across = _place(grid.u_v, w), _place(grid.dp_pa, 0.5 * (drop[1:] + drop[:-1]))
    is_open = view.inside & (w > edge.safe_band_v)
    return along * PARTS * (len(grid.dp_pa) - 1) + across, is_open


def _place(border: FloatArray, values: FloatArray) -> IntArray:
    """Number of the part of an interval that values (n,) are in, or of the nearest one."""
    share = np.interp(values, border, np.arange(len(border), dtype=np.float64))
    return np.minimum((PARTS * share).astype(np.int64), PARTS * (len(border) - 1) - 1)


def _n_parts(grid: Grid) -> int:
    return PARTS * PARTS * (len(grid.u_v) - 1) * (len(grid.dp_pa) - 1)
