"""Which blocks of each edge's grid a trace excites, from the samples alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_bridge.samples import ROW, Samples
from rtid.model import Edge, Machine
from rtid.plain import BoolArray, FloatArray


@dataclass(frozen=True)
class Coverage:
    """Rows per block, float64 (nu, nd), of one edge.

    A row is a measured position (integral form) or a filtered row (carry form).  Shares are those
    of the time the edge was open: outside its grid, and with dp < 0.  below: share of the record
    during which the command is below the grid of an edge that no safe band declares shut there.
    """

    edge: str
    rows: FloatArray
    min_rows: int
    open_s: float
    outside: float
    reverse: float
    below: float
    w_v: tuple[float, float]  # extremes of command and pressure difference while open
    dp_pa: tuple[float, float]

    @property
    def enough(self) -> int:
        """Number of blocks with at least `min_rows` rows."""
        return int((self.rows >= self.min_rows).sum())

    @property
    def touched(self) -> int:
        """Number of blocks with any row."""
        return int((self.rows > 0).sum())


def coverage(model: Machine, samples: Samples) -> tuple[Coverage, ...]:
    """Coverage of every edge's grid."""
    is_row = (samples.flags & ROW) != 0
    t_us = samples.t_us[is_row]
    period_s = float(np.median(np.diff(t_us))) * 1e-6 if len(t_us) > 1 else 0.0
    return tuple(_edge(model, edge, samples, is_row, period_s) for edge in model.maps)


def _edge(
    model: Machine, edge: Edge, samples: Samples, is_row: BoolArray, period_s: float
) -> Coverage:
    w = edge.direction * samples.column(edge.command)
    ends = [samples.column(n) if n else np.zeros(len(w)) for n in (edge.source, edge.sink)]
    dp, shut = ends[0] - ends[1], edge.shut_up_to_v if model.has_pressures else -np.inf
    below = is_row & (w < edge.grid.u_v[0]) & (w > edge.safe_band_v)
    opened = is_row & (w > shut)
    w, dp = w[opened], dp[opened]
    rows, _, _ = np.histogram2d(w, dp, [edge.grid.u_v, edge.grid.dp_pa])
    share = min(1.0, model.filter.rows_per_s * period_s) if model.form == "carry" else 1.0
    n = max(len(w), 1)
    return Coverage(
        edge=edge.name,
        rows=share * rows,
        min_rows=model.gates.min_rows,
        open_s=len(w) * period_s,
        outside=(len(w) - float(rows.sum())) / n,
        reverse=float((dp < 0).sum()) / n,
        below=float(below.sum()) / max(int(is_row.sum()), 1),
        w_v=_span(w),
        dp_pa=_span(dp),
    )


def _span(x: FloatArray) -> tuple[float, float]:
    return (float(x.min()), float(x.max())) if len(x) else (float("nan"), float("nan"))
