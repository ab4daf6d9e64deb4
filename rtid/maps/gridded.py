"""The published map on plain grids, bilinear in command and pressure drop, for other programs.

Nodes begin with the borders of the blocks and are added where a straight line would miss: a tool
that interpolates between them is within `ERROR_SHARE` of an edge's largest flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_bridge.lookup import STATUS
from rtid.estimator.flowmap import EdgeMap, FlowMap
from rtid.estimator.orifice import root
from rtid.maps.lookup import drops, lattice, refined
from rtid.plain import FloatArray

ERROR_SHARE = 1e-3
FINE_U, FINE_DP = 8, 32  # points per block at which a line is held against the map


@dataclass(frozen=True, eq=False)
class Gridded:
    """One edge: u (nu,) in V along the opening, dp (nd,) Pa, flow and sd (nu, nd) m3/s, code.

    code (nu, nd): index into STATUS of what each node stands on.
    """

    name: str
    u_v: FloatArray
    dp_pa: FloatArray
    flow_m3s: FloatArray
    sd_m3s: FloatArray
    code: FloatArray


def gridded(flowmap: FlowMap, share: float = ERROR_SHARE) -> tuple[Gridded, ...]:
    """Every edge of a map; share: of the largest flow that interpolation may miss by."""
    return tuple(_edge(edge, share) for edge in flowmap.edges)


def _edge(edge: EdgeMap, share: float) -> Gridded:
    u, dp = lattice(edge.grid.u_v, FINE_U), _drops(edge.grid.dp_pa)
    flow = edge.flow(u[:, None], dp[None, :])
    allowed = 0.5 * share * max(float(np.abs(flow).max()), 1e-12)  # for either axis
    at = np.ix_(refined(u, flow, allowed, FINE_U), refined(dp, flow.T, allowed, FINE_DP))
    u, dp, flow = u[at[0].ravel()], dp[at[1].ravel()], flow[at]
    words = edge.status_at(u[:, None], dp[None, :])
    code = np.vectorize(STATUS.index, otypes=[float])(words)
    return Gridded(edge.name, u, dp, flow, edge.sd(u[:, None], dp[None, :]), code)


def _drops(border: FloatArray) -> FloatArray:
    """Pressure drops evenly spaced in their roots, as flows are; borders to the last bit."""
    dp = drops(border, lattice(root(border), FINE_DP))
    dp[::FINE_DP] = border
    return dp
