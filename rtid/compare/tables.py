"""Tables of a comparison: per block, and a map beside a reference at chosen points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtid.compare.comparison import Comparison
from rtid.estimator.blocks import EMPTY
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.solution import Solution
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray

PAPER_U_V = (4.0, 5.0, 6.0, 7.0)  # Table 1 of IMECE2005-79420
PAPER_DP_PA = (4.5e6, 5.0e6, 5.5e6)


class AnyMap(Protocol):
    """What a learned and a reference map have in common."""

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s at points of any one shape (...), V and Pa."""


@dataclass(frozen=True)
class BlockRow:
    """One block that was visited by the fit or in this part; i along u, j along dp.

    rows, dwell_s, condition, flow_m3s and sd_m3s are the fit's, NaN where it has none.
    residual_rms_m3s: of its chambers' rows while it was open, NaN: none; residual_share: of the sum
    of squares of these chambers' residual over the whole part.  reason: why it is not identified.
    """

    edge: str
    i: int
    j: int
    u_v: tuple[float, float]
    dp_pa: tuple[float, float]
    rows: int
    dwell_s: float
    condition: float
    flow_m3s: float
    sd_m3s: float
    residual_rms_m3s: float
    residual_share: float
    status: str
    reason: str


NEVER = "never visited in the data of the fit"
# What a block has or lacks, in words; the first is identified, the last has no data.
CAUSES = (
    "identified",
    "few rows",
    "condition",
    "spread too large",
    "contradicted",
    "never visited",
)
_BEGINS = {"condition": 2, "flow known": 3, "the machine": 4, "not visited": 4, "never": 5}


def cause_of(row: BlockRow) -> str:
    """One of CAUSES for a block."""
    return cause_of_block(row.status, row.reason)


def cause_of_block(status: str, reason: str) -> str:
    """One of CAUSES for a block of this status, and the reason for it."""
    if status == VALID:
        return CAUSES[0]
    return CAUSES[next((k for text, k in _BEGINS.items() if reason.startswith(text)), 1)]


def block_rows(
    solution: Solution, comparison: Comparison, flowmap: FlowMap | None = None
) -> list[BlockRow]:
    """All blocks that the fit or the comparison visited, with the residual that they leave.

    flowmap: gives the status of blocks that the fit has not visited.
    """
    model, table = solution.model, []
    for k, edge in enumerate(model.edges):
        if edge.shares:
            continue
        nd = edge.grid.shape[1]
        squares, count, total = _residual_by_cell(model, comparison, k)
        visited = {(b.i, b.j) for b in solution.blocks if b.edge == k}
        here = {divmod(int(cell), nd) for cell in np.flatnonzero(count)}
        for i, j in sorted(visited | here):
            b, at = solution.block(k, i, j), i * nd + j
            u, p = edge.grid.u_v[i : i + 2].tolist(), edge.grid.dp_pa[j : j + 2].tolist()
            unknown = EMPTY if flowmap is None else str(flowmap[edge.name].status[i, j])
            table.append(
                BlockRow(
                    edge.name,
                    i,
                    j,
                    (u[0], u[1]),
                    (p[0], p[1]),
                    rows=b.rows if b else 0,
                    dwell_s=b.dwell_s if b else 0.0,
                    condition=b.condition if b else np.nan,
                    flow_m3s=b.mean_flow_m3s if b else np.nan,
                    sd_m3s=b.mean_sd_m3s if b else np.nan,
                    residual_rms_m3s=float(np.sqrt(squares[at] / count[at]))
                    if count[at]
                    else np.nan,
                    residual_share=float(squares[at] / total) if total > 0 else 0.0,
                    status=b.status if b else unknown,
                    reason=b.reason if b else NEVER,
                )
            )
    return table


def _residual_by_cell(
    model: Machine, comparison: Comparison, k: int
) -> tuple[FloatArray, FloatArray, float]:
    """Per cell of edge k's map: sum of squares of its chambers' residual, their number; the total.

    All commands of the map count.
    """
    edge = model.edges[k]
    touched = [c for c, chamber in enumerate(model.chambers) if edge.sign(chamber) != 0]
    square = (comparison.residual_m3s[:, touched] ** 2).sum(axis=1)
    size, users = edge.grid.shape[0] * edge.grid.shape[1], np.array(model.owners) == k
    cells = comparison.cell[:, users]
    row, which = np.nonzero(cells >= 0)
    at = cells[row, which] - model.first_cells[k]
    squares = np.bincount(at, square[row], size)
    count = len(touched) * np.bincount(at, minlength=size)
    return np.asarray(squares, float), np.asarray(count, float), float(square.sum())


@dataclass(frozen=True)
class Deviation:
    """A map beside a reference at points (n,): flows in m3/s, and the map's status there."""

    edge: str
    w_v: FloatArray
    dp_pa: FloatArray
    flow_m3s: FloatArray
    sd_m3s: FloatArray
    reference_m3s: FloatArray
    status: NDArray[np.str_]

    @property
    def valid(self) -> BoolArray:
        """Points (n,) where the map is valid and the reference has a flow."""
        return (self.status == VALID) & np.isfinite(self.reference_m3s)

    @property
    def share(self) -> FloatArray:
        """Difference as a share of the reference at each point (n,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return (self.flow_m3s - self.reference_m3s) / np.abs(self.reference_m3s)

    @property
    def share_of_largest(self) -> FloatArray:
        """Difference as a share of the largest reference flow among the valid points (n,)."""
        flows = np.abs(self.reference_m3s[self.valid])
        largest = flows.max() if len(flows) else np.nan
        return (self.flow_m3s - self.reference_m3s) / largest


def deviations(
    flowmap: FlowMap,
    reference: AnyMap,
    u_v: ArrayLike | None = None,
    dp_pa: ArrayLike | None = None,
) -> list[Deviation]:
    """Per edge, map and reference at the points u_v x dp_pa; at the cells' centres if not given."""
    deviatings = []
    for edge in flowmap.edges:
        u, p = edge.grid.u_v, edge.grid.dp_pa
        us = 0.5 * (u[1:] + u[:-1]) if u_v is None else np.asarray(u_v, float)
        ps = 0.5 * (p[1:] + p[:-1]) if dp_pa is None else np.asarray(dp_pa, float)
        w, dp = (a.ravel() for a in np.meshgrid(us, ps, indexing="ij"))
        flows = edge.flow(w, dp), edge.sd(w, dp), reference.flow(edge.name, w, dp)
        deviatings.append(Deviation(edge.name, w, dp, *flows, edge.status_at(w, dp)))
    return deviatings
