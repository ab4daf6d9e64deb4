"""From a block of a map to its time spans in the trace, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.compare.comparison import Comparison
from rtid.errors import RtidError
from rtid.model import Machine

Span = tuple[float, float]


class NoSuchBlockError(RtidError):
    """An edge or block that the model does not have."""


@dataclass(frozen=True)
class Visit:
    """A block and the time that its edge's working point spent in it."""

    edge: str
    i: int
    j: int
    time_s: float


def cell_of(model: Machine, edge: str, i: int, j: int) -> int:
    """Number of a block among all grid cells.  Raises NoSuchBlockError naming what there is."""
    names = [e.name for e in model.edges]
    if edge not in names:
        raise NoSuchBlockError(f"there is no edge {edge!r}", f"edges: {', '.join(names)}", 2)
    k = names.index(edge)
    nu, nd = model.edges[k].grid.shape
    if not (0 <= i < nu and 0 <= j < nd):
        remedy = f"edge {edge} has blocks 0..{nu - 1},0..{nd - 1} (along u, along dp)"
        raise NoSuchBlockError(f"there is no block {edge}:{i},{j}", remedy, 2)
    return model.first_cells[k] + i * nd + j


def spans_of_block(model: Machine, part: Comparison, edge: str, i: int, j: int) -> list[Span]:
    """When the working point of the edge was in block (i, j): [(t0, t1)] in s, in order."""
    cell = cell_of(model, edge, i, j)
    column = [e.name for e in model.edges].index(edge)
    inside = part.intervals.cell[:, column] == cell
    step = np.diff(np.concatenate([[0], inside.astype(np.int8), [0]]))
    t_s = part.intervals.t_s
    first, last = np.flatnonzero(step == 1), np.flatnonzero(step == -1)
    return list(zip(t_s[first].tolist(), t_s[last].tolist(), strict=True))


def blocks_in_span(model: Machine, part: Comparison, t0_s: float, t1_s: float) -> list[Visit]:
    """Blocks that the edges' working points were in between t0_s and t1_s, longest stay first."""
    t_s = part.intervals.t_s
    overlap = np.minimum(t_s[1:], t1_s) - np.maximum(t_s[:-1], t0_s)
    during = overlap > 1e-9
    visits = []
    for k, edge in enumerate(model.edges):
        cell = part.intervals.cell[during, k]
        time_s = overlap[during][cell >= 0]
        for at in np.unique(cell[cell >= 0]).tolist():
            i, j = divmod(at - model.first_cells[k], edge.grid.shape[1])
            spent = float(time_s[cell[cell >= 0] == at].sum())
            visits.append(Visit(edge.name, i, j, spent))
    return sorted(visits, key=lambda visit: -visit.time_s)
