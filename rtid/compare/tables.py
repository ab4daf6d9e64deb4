"""Tables of a comparison: per block, and a map beside a reference at chosen points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtid.compare.comparison import Comparison
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.solution import Solution
from rtid.model import FloatArray

PAPER_U_V = (4.0, 5.0, 6.0, 7.0)  # Table 1 of IMECE2005-79420
PAPER_DP_PA = (4.5e6, 5.0e6, 5.5e6)


class AnyMap(Protocol):
    """What a learned and a reference map have in common."""

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s."""


@dataclass(frozen=True)
class BlockRow:
    """One visited block; residual_rms_m3s: of its chambers' rows while it was open, NaN: none."""

    edge: str
    u_v: tuple[float, float]
    dp_pa: tuple[float, float]
    rows: int
    dwell_s: float
    condition: float
    flow_m3s: float
    sd_m3s: float
    residual_rms_m3s: float
    status: str
    reason: str


def block_rows(solution: Solution, comparison: Comparison) -> list[BlockRow]:
    """All visited blocks with the residual that they leave in a comparison."""
    model, first = solution.model, 0
    starts = []
    for edge in model.edges:
        starts.append(first)
        first += edge.grid.shape[0] * edge.grid.shape[1]
    table = []
    for b in solution.blocks:
        edge = model.edges[b.edge]
        u, p, nd = edge.grid.u_v, edge.grid.dp_pa, edge.grid.shape[1]
        at = comparison.cell[:, b.edge] == starts[b.edge] + b.i * nd + b.j
        ends = (edge.source, edge.sink)
        touched = [c for c, chamber in enumerate(model.chambers) if chamber.pressure in ends]
        residual = comparison.residual_m3s[np.ix_(at, touched)]
        rms = float(np.sqrt(np.mean(residual**2))) if residual.size else np.nan
        span = (float(u[b.i]), float(u[b.i + 1])), (float(p[b.j]), float(p[b.j + 1]))
        table.append(
            BlockRow(
                edge.name,
                *span,
                rows=b.rows,
                dwell_s=b.dwell_s,
                condition=b.condition,
                flow_m3s=b.mean_flow_m3s,
                sd_m3s=b.mean_sd_m3s,
                residual_rms_m3s=rms,
                status=b.status,
                reason=b.reason,
            )
        )
    return table


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
    def valid(self) -> NDArray[np.bool_]:
        """Points where the map is valid and the reference has a flow."""
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
    found = []
    for edge in flowmap.edges:
        u, p = edge.grid.u_v, edge.grid.dp_pa
        us = 0.5 * (u[1:] + u[:-1]) if u_v is None else np.asarray(u_v, float)
        ps = 0.5 * (p[1:] + p[:-1]) if dp_pa is None else np.asarray(dp_pa, float)
        w, dp = (a.ravel() for a in np.meshgrid(us, ps, indexing="ij"))
        flows = edge.flow(w, dp), edge.sd(w, dp), reference.flow(edge.name, w, dp)
        found.append(Deviation(edge.name, w, dp, *flows, edge.status_at(w, dp)))
    return found
