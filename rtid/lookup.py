"""The published map as a look-up table for the controller, with nodes where they are needed.

The table is bilinear in w and in s = sign(dp) sqrt |dp| (`firmware_bridge.lookup`).  Its nodes begin
with the borders of the blocks, so that each cell of the table has one status.  On a lattice of
FINE points per block more are set, so that the error of interpolation along each axis alone stays
below half of what is allowed; what the whole table is off by is then measured at random points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import lookup
from firmware_bridge.lookup import MOST_COUNT, MOST_NODES, NO_SAFE_BAND, STATUS, Table
from rtid.errors import RtidError
from rtid.estimator.flowmap import EdgeMap
from rtid.estimator.orifice import root
from rtid.model import Edge, FloatArray

FINE = 32  # lattice points per block and axis; a node every FINE-th of a block is the finest
CHECKED = 20_000  # random points at which the table is held against the map
ERROR_PERCENT = 0.1  # of the rated flow
Index = NDArray[np.intp]


class NoTableError(RtidError):
    """A map that cannot become a look-up table; the text names the edge."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """A table, and what it is off by from the published map at random points, m3/s."""

    edge: str
    table: Table
    error_max_m3s: float
    error_rms_m3s: float


def sample(
    edge: Edge, published: EdgeMap, error_percent: float = ERROR_PERCENT, most: int = MOST_NODES
) -> Sampled:
    """The table of an edge; its error in per cent of the rated flow is at most error_percent.

    most: nodes per axis; where they do not suffice the error is larger, and told.  Raises
    NoTableError for a map that is nowhere a number.
    """
    w_start, s_start = _borders(published)
    w, s = _lattice(w_start), _lattice(s_start)
    exact = published.flow(w[:, None], _drop(published, s)[None, :])
    if not np.isfinite(exact).all():
        raise NoTableError(f"edge {edge.name}: its map is not a number everywhere on its grid")
    allowed = 0.5e-2 * error_percent * edge.rated_q_m3s
    at_w = refined(w, exact, allowed, most)
    at_s = refined(s, exact.T, allowed, most)
    return _measured(edge, published, w[at_w], s[at_s], exact[np.ix_(at_w, at_s)])


def refined(x: FloatArray, exact: FloatArray, allowed: float, most: int) -> Index:
    """Indices of nodes among x (n,), so that exact (n, m) between them is linear to `allowed`.

    Every FINE-th is one from the start; between two of these each node is as far from the one
    before as it can be.  More than `most` are not given: what is allowed is doubled until they do.
    """
    while True:
        at = [0]
        for end in range(FINE, len(x), FINE):
            while at[-1] < end:
                at.append(_farthest(x, exact, allowed, at[-1], end))
        if len(at) <= most or allowed > np.abs(exact).max():
            return np.array(at)
        allowed *= 2.0


def _farthest(x: FloatArray, exact: FloatArray, allowed: float, start: int, end: int) -> int:
    """The last index up to `end` to which a chord from `start` misses by no more than allowed."""
    good, bad = start + 1, end + 1
    while bad - good > 1:
        tried = end if bad > end else (good + bad) // 2
        inner = slice(start, tried + 1)
        share = ((x[inner] - x[start]) / (x[tried] - x[start]))[:, None]
        chord = exact[start] + share * (exact[tried] - exact[start])
        if np.abs(chord - exact[inner]).max() <= allowed:
            good = tried
        else:
            bad = tried
    return good


def _borders(published: EdgeMap) -> tuple[FloatArray, FloatArray]:
    """Where nodes begin: the blocks' borders above the safe band, and the roots of those of dp."""
    w = published.grid.u_v
    start = max(float(w[0]), published.safe_band_v)
    return np.append(start, w[w > start]), root(published.grid.dp_pa)


def _lattice(border: FloatArray) -> FloatArray:
    steps = np.arange(FINE * (len(border) - 1) + 1) / FINE
    return np.interp(steps, np.arange(len(border)), border)


def _drop(published: EdgeMap, s: FloatArray) -> FloatArray:
    """Pressure drops of signed roots, none of them off the grid by rounding."""
    dp = published.grid.dp_pa
    return np.asarray(np.clip(s * np.abs(s), dp[0], dp[-1]))


def _measured(
    edge: Edge, published: EdgeMap, w: FloatArray, s: FloatArray, flow: FloatArray
) -> Sampled:
    """The table of these nodes, held against the map."""
    scale = max(float(np.abs(flow).max()) / MOST_COUNT, 1e-12)
    safe = published.safe_band_v
    centre_w, centre_s = 0.5 * (w[1:] + w[:-1]), 0.5 * (s[1:] + s[:-1])
    words = published.status_at(centre_w[:, None], _drop(published, centre_s)[None, :])
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
    dp = _drop(published, at_s)
    off = table.flow(edge.direction * at_w, dp)[0] - published.flow(at_w, dp)
    return Sampled(edge.name, table, float(np.abs(off).max()), float(np.sqrt(np.mean(off**2))))
