"""The published map as a look-up table for the controller, with nodes where they are needed.

The table is bilinear in w and s = sign(dp) sqrt |dp| (`firmware_bridge.lookup`).  Its nodes begin
with the borders of the blocks, so that each cell of the table has one status.  On a lattice of
some points per block more are set, so that the error of interpolation along each axis alone stays
below half of what is allowed; what the whole table is off by is then measured at random points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.lookup import MOST_COUNT, MOST_NODES, NO_SAFE_BAND, STATUS, Table
from rtid.errors import RtidError
from rtid.estimator.flowmap import EdgeMap
from rtid.estimator.inverse import on_lattice
from rtid.estimator.orifice import root
from rtid.kernels.chords import far_apart
from rtid.model import Edge
from rtid.plain import FloatArray

FINE_W, FINE_S = 32, 64  # lattice points per block; the root is steep at dp = 0
CHECKED = 20_000  # random points at which the table is held against the map
ERROR_PERCENT = 0.1  # of the rated flow
Index = NDArray[np.intp]


class NoTableError(RtidError):
    """A map that cannot become a look-up table; the text names the edge."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """A table, and what it is off by from the published map at random points, m3/s.

    error_u_v, error_dp_pa: where it is off the most.
    """

    edge: str
    table: Table
    error_max_m3s: float
    error_rms_m3s: float
    error_u_v: float
    error_dp_pa: float


def on_wire(nu: int, ns: int) -> bool:
    """Whether an image can have so many nodes."""
    return max(nu, ns) <= MOST_NODES


def sample(
    edge: Edge,
    published: EdgeMap,
    error_percent: float = ERROR_PERCENT,
    fits: Callable[[int, int], bool] = on_wire,
) -> Sampled:
    """The table of an edge; its error in per cent of the rated flow is at most error_percent.

    fits(nu, ns): whether there is room; where there is not, the error is doubled until there is,
    and told.  Raises NoTableError for a map without room or that is not a number.
    """
    w_start, s_start = _borders(published)
    w, s = lattice(w_start, FINE_W), lattice(s_start, FINE_S)
    grid, theta = published.grid, published.theta
    exact = on_lattice(grid, published.safe_band_v, theta, w, drops(grid.dp_pa, s))
    if not np.isfinite(exact).all():
        raise NoTableError(f"edge {edge.name}: its map is not a number everywhere on its grid")
    if not fits(len(w_start), len(s_start)):
        raise NoTableError(
            f"edge {edge.name}: {len(w_start)} x {len(s_start)} nodes do not fit",
            "a coarser grid has fewer; or give the controller more room",
        )
    rounding = 0.5 * float(np.abs(exact).max()) / MOST_COUNT
    wanted = 1e-2 * error_percent * edge.rated_q_m3s
    allowed = 0.5 * max(wanted - rounding, 0.5 * wanted)  # for each axis alone
    while True:
        at_w, at_s = refined(w, exact, allowed, FINE_W), refined(s, exact.T, allowed, FINE_S)
        if fits(len(at_w), len(at_s)):
            return _measured(edge, published, w[at_w], s[at_s], exact[np.ix_(at_w, at_s)])
        allowed *= 2.0


def refined(x: FloatArray, exact: FloatArray, allowed: float, fine: int) -> Index:
    """Indices of nodes among x (n,), so that exact (n, m) between them is linear to `allowed`.

    Every fine-th is one from the start; between two of these each node is as far from the one
    before as it can be.
    """
    at = np.empty(len(x), np.int64)
    return at[: far_apart(x, np.ascontiguousarray(exact), allowed, fine, at)]


def _borders(published: EdgeMap) -> tuple[FloatArray, FloatArray]:
    """Where nodes begin: the blocks' borders above the safe band, and the roots of those of dp."""
    w = published.grid.u_v
    start = max(float(w[0]), published.safe_band_v)
    return np.append(start, w[w > start]), root(published.grid.dp_pa)


def lattice(border: FloatArray, fine: int) -> FloatArray:
    """The borders of blocks (n,) and fine - 1 points evenly between two of them, V or Pa."""
    steps = np.arange(fine * (len(border) - 1) + 1) / fine
    return np.interp(steps, np.arange(len(border)), border)


def drops(border_pa: FloatArray, s: FloatArray) -> FloatArray:
    """Pressure drops (n,), Pa, of signed roots s (n,), none of them off the grid by rounding."""
    return np.asarray(np.clip(s * np.abs(s), border_pa[0], border_pa[-1]))


def _measured(
    edge: Edge, published: EdgeMap, w: FloatArray, s: FloatArray, flow: FloatArray
) -> Sampled:
    """The table of these nodes, held against the map."""
    scale = max(float(np.abs(flow).max()) / MOST_COUNT, 1e-12)
    safe = published.safe_band_v
    centre_w, centre_s = 0.5 * (w[1:] + w[:-1]), 0.5 * (s[1:] + s[:-1])
    border_pa = published.grid.dp_pa
    words = published.status_at(centre_w[:, None], drops(border_pa, centre_s)[None, :])
    codes = np.vectorize(STATUS.index, otypes=[np.uint8])(words)
    table = Table(
        w.astype(np.float32),
        s.astype(np.float32),
        np.round(flow / scale).astype(np.int16),
        codes,
        float(np.float32(scale)),
        float(np.float32(safe)) if np.isfinite(safe) else NO_SAFE_BAND,
        edge.direction,
    )
    rng = np.random.default_rng(0)
    at_w, at_s = (rng.uniform(x[0], x[-1], CHECKED) for x in (w, s))
    dp = drops(border_pa, at_s)
    off = table.flow(edge.direction * at_w, dp)[0] - published.flow(at_w, dp)
    k = int(np.abs(off).argmax())
    return Sampled(
        edge.name, table, float(abs(off[k])), float(np.sqrt(np.mean(off**2))),
        float(edge.direction * at_w[k]), float(dp[k]),
    )  # fmt: skip
