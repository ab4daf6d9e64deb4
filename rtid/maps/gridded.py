"""The published map on plain grids, bilinear in command and pressure drop, for other programs.

A table has as few nodes as keep it within a share of its edge's largest flow: along each axis every
node is as far from the one before as a straight line allows, and of the ways to deal the allowed
error out to the two axes the one with the fewest nodes is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_bridge.lookup import STATUS
from rtid.estimator.flowmap import EdgeMap, FlowMap
from rtid.estimator.orifice import root
from rtid.maps.lookup import Index, NoTableError, drops, lattice, refined
from rtid.plain import FloatArray

ERROR_SHARE = 2e-3
FINE_U, FINE_DP = 8, 16  # points per block at which a line is held against the map, at most
MOST_POINTS = 1200  # along an axis
DEALT = (0.3, 0.45, 0.6)  # shares of the error that may lie along u
TURNS = 3  # by which the allowed error is found that the whole table keeps
LEAST_SHARE, MOST_SHARE, SEARCHED = 2e-4, 0.5, 7  # of the largest flow, for a table of a size
WORD = 2  # bytes of a value or of a node


@dataclass(frozen=True, eq=False)
class Gridded:
    """One edge: u (nu,) in V along the opening, dp (nd,) Pa, flow and sd (nu, nd) m3/s, code.

    code (nu, nd): index into STATUS of what each node stands on; miss: largest distance of the
    table from the map, as a share of its largest flow.
    """

    name: str
    u_v: FloatArray
    dp_pa: FloatArray
    flow_m3s: FloatArray
    sd_m3s: FloatArray
    code: FloatArray
    miss: float

    @property
    def n_bytes(self) -> int:
        """Memory of its flows and axes as 16-bit numbers."""
        return WORD * (self.flow_m3s.size + len(self.u_v) + len(self.dp_pa))


Tables = tuple[Gridded, ...]


@dataclass(frozen=True, eq=False)
class _Finely:
    """A map at many points: u (nu,), V, dp (nd,), Pa, flow (nu, nd), m3/s.

    Drops lie evenly in their roots, as flows do; borders are kept to the last bit.
    """

    edge: EdgeMap
    u: FloatArray
    dp: FloatArray
    flow: FloatArray

    @classmethod
    def of(cls, edge: EdgeMap) -> _Finely:
        border_u, border_dp = edge.grid.u_v, edge.grid.dp_pa
        u = lattice(border_u, _fine(border_u, FINE_U))
        fine = _fine(border_dp, FINE_DP)
        dp = drops(border_dp, lattice(root(border_dp), fine))
        dp[::fine] = border_dp
        return cls(edge, u, dp, edge.flow(u[:, None], dp[None, :]))

    def on_nodes(self, u: FloatArray, dp: FloatArray) -> Gridded:
        """The table on given nodes: u (nu,) in V, dp (nd,) in Pa, both rising."""
        edge, flow = self.edge, self.edge.flow(u[:, None], dp[None, :])
        words = edge.status_at(u[:, None], dp[None, :])
        code = np.vectorize(STATUS.index, otypes=[float])(words)
        miss = _miss(self.u, self.dp, self.flow, u, dp, flow)
        return Gridded(edge.name, u, dp, flow, edge.sd(u[:, None], dp[None, :]), code, miss)

    def smallest(self, share: float) -> Gridded:
        """The table of fewest nodes that misses by no more than a share of the largest flow."""
        allowed = share * max(float(np.abs(self.flow).max()), 1e-12)
        tried = [_dealt(self.u, self.dp, self.flow, share, allowed, along_u) for along_u in DEALT]
        at = min(tried, key=lambda nodes: len(nodes[0]) * len(nodes[1]))
        return self.on_nodes(self.u[at[0]], self.dp[at[1]])


def gridded(flowmap: FlowMap, share: float = ERROR_SHARE) -> Tables:
    """Every edge of a map; share: of the largest flow that interpolation may miss by."""
    return tuple(_Finely.of(edge).smallest(share) for edge in flowmap.edges)


def best_that_fits(flowmap: FlowMap, fits: Callable[[Tables], bool]) -> Tables:
    """The tables that miss least of those that fit.  Raises NoTableError where none does."""
    edges = [_Finely.of(edge) for edge in flowmap.edges]
    low, high = LEAST_SHARE, MOST_SHARE
    tables = tuple(edge.smallest(high) for edge in edges)
    if not fits(tables):
        sizes = ", ".join(f"{g.name} {len(g.u_v)} x {len(g.dp_pa)}" for g in tables)
        raise NoTableError(f"no table is so small: {sizes} nodes miss half of the largest flow")
    for _ in range(SEARCHED):
        share = float(np.sqrt(low * high))
        tried = tuple(edge.smallest(share) for edge in edges)
        if fits(tried):
            tables, high = tried, share
        else:
            low = share
    return tables


def on_nodes(edge: EdgeMap, u: FloatArray, dp: FloatArray) -> Gridded:
    """The table of an edge on given nodes: u (nu,) in V, dp (nd,) in Pa, both rising."""
    return _Finely.of(edge).on_nodes(u, dp)


def _dealt(
    u: FloatArray, dp: FloatArray, flow: FloatArray, share: float, allowed: float, along_u: float
) -> tuple[Index, Index]:
    """Indices of the fewest nodes along u (nu,) and dp (nd,) with so much of the error along u.

    flow (nu, nd) and allowed in m3/s.  Both axes together miss less than the sum of what each one
    may: that is raised as far as the table as a whole allows.
    """
    best, low, high = None, 1.0, 2.5
    for k in range(TURNS):
        more = 1.0 if k == 0 else float(np.sqrt(low * high))
        at_u = _far_apart(u, flow, along_u * allowed * more)
        at_dp = _far_apart(dp, flow.T, (1.0 - along_u) * allowed * more)
        miss = _miss(u, dp, flow, u[at_u], dp[at_dp], flow[np.ix_(at_u, at_dp)])
        if best is None or miss <= share:
            best, low = (at_u, at_dp), more
        else:
            high = more
    assert best is not None
    return best


def _far_apart(x: FloatArray, exact: FloatArray, allowed: float) -> Index:
    """Indices of nodes among x (n,), the ends and 0 of them: there a flow turns its sign."""
    zero = int(np.searchsorted(x, 0.0))
    if not (0 < zero < len(x) - 1 and x[zero] == 0.0):
        return refined(x, exact, allowed, len(x) - 1)
    below = refined(x[: zero + 1], exact[: zero + 1], allowed, zero)
    above = refined(x[zero:], exact[zero:], allowed, len(x) - 1 - zero)
    return np.concatenate([below, zero + above[1:]])


def _miss(
    u: FloatArray,
    dp: FloatArray,
    exact: FloatArray,
    at_u: FloatArray,
    at_dp: FloatArray,
    flow: FloatArray,
) -> float:
    """Largest distance of a table from exact (nu, nd), of the largest flow; outside it, of its end.

    u, at_u in V; dp, at_dp in Pa; flow (len(at_u), len(at_dp)) and exact in m3/s.
    """
    along = np.array([np.interp(u, at_u, column) for column in flow.T]).T
    table = np.array([np.interp(dp, at_dp, row) for row in along])
    inside = np.ix_((u >= at_u[0]) & (u <= at_u[-1]), (dp >= at_dp[0]) & (dp <= at_dp[-1]))
    off = np.abs(table - exact)[inside]
    return float(off.max(initial=0.0)) / max(float(np.abs(exact).max()), 1e-12)


def _fine(border: FloatArray, most: int) -> int:
    return max(2, min(most, MOST_POINTS // len(border)))
