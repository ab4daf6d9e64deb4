"""A valve that is opened further passes no less: dQ/dw sign(dp) >= 0, as far as the data allow.

The published slope is linear in all cells' terms.  With their covariance C (the block's own misfit
included: it is what bends a polynomial down before the end of a dead band), the map that is changed
least is the most likely one among those that do not fall:

    minimise (theta - theta_0)' C^-1 (theta - theta_0)   subject to   slope rows theta >= 0,

a least-distance problem (Lawson and Hanson 1974, ch. 23).  A cell that would have to change by more
than LIMIT standard deviations keeps what the data say, and is marked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap
from rtid.estimator.windows import foot, overlaps
from rtid.kernels.layout import TERMS
from rtid.kernels.nearest import shortest
from rtid.plain import BoolArray, FloatArray

KNOWN = (VALID, LEARNING)
LIMIT = 3.0  # standard deviations by which a cell's terms may be changed
FLOOR = 1e-2  # share of its worst known direction's sd that every direction of a cell may move
MARGIN = 1e-2  # least slope, in its standard deviations: what lies between the points stays above 0
DENSE, COARSE = 13, 5  # slopes looked at per overlap, along w and along dp
ROUNDS = 40  # of adding what the last change has left falling

FALLS = "flow falls with the command, {:.1f} standard deviations against it"
Mask = BoolArray


@dataclass(frozen=True)
class Slopes:
    """Slopes dQ/dw sign(dp) at k points, linear in the terms of the cells that blend there.

    w (k,) in V, dp (k,) in Pa; cells (k, 4), by_term (k, 4, 6): a slope is by_term times these
    cells' terms; parts (k, 4): the same cells, in place of one without weight that with the most.
    """

    w: FloatArray
    dp: FloatArray
    cells: NDArray[np.intp]
    parts: NDArray[np.intp]
    by_term: FloatArray

    def __getitem__(self, at: Any) -> Slopes:
        return Slopes(self.w[at], self.dp[at], self.cells[at], self.parts[at], self.by_term[at])

    def of(self, theta: FloatArray) -> FloatArray:
        """Slopes (k,), m3/s/Pa, of a map with terms theta (nu, nd, 6), m3/s."""
        terms = theta.reshape(-1, TERMS)[self.cells]
        return np.asarray(np.einsum("kci,kci->k", self.by_term, terms))

    def rows(self, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows (k, 4, 6) of unit norm on the cells' z, theta + root z in m3/s, and their norms."""
        moved = (self.by_term[:, :, None, :] @ root[self.cells])[:, :, 0]
        same = self.cells[:, :, None] == self.cells[:, None, :]
        sd = np.sqrt(np.einsum("kai,kbi,kab->k", moved, moved, same))
        return moved / sd[:, None, None], sd


def monotone(edge: EdgeMap, spread: FloatArray) -> EdgeMap:
    """The map that does not fall where cells are known; spread (nu, nd, 6, 6): C, (m3/s)^2."""
    known = np.isin(edge.status, KNOWN).ravel()
    root = _roots(spread.reshape(-1, TERMS, TERMS))
    slopes = looked_at(edge, known)
    reason, theta, needed = dict(edge.reason), edge.theta, _by_the_worst_row(edge, root, slopes)
    while True:
        against = known & (needed > LIMIT)
        for cell in np.flatnonzero(against).tolist():
            at = divmod(cell, edge.grid.shape[1])
            reason[at] = "; ".join(filter(None, (reason.get(at), FALLS.format(needed[cell]))))
        slopes = slopes[~against[slopes.parts].any(axis=1)]
        theta, needed = _least_change(edge, root, slopes)
        if not (known & (needed > LIMIT)).any():
            return replace(edge, theta=theta, reason=reason)


def looked_at(edge: EdgeMap, known: Mask) -> Slopes:
    """Slopes at all points in known cells' reach: closely along w, coarsely along dp."""
    w, dp = np.meshgrid(
        _around(edge.grid.u_v, DENSE), _around(edge.grid.dp_pa, COARSE), indexing="ij"
    )
    used = (w > edge.safe_band_v) & (dp != 0)
    w, dp = w[used], dp[used]
    cells, parts = _met(edge, w, dp)
    near = known[parts].any(axis=1)  # a record visits a part of a map alone
    w, dp = w[near], dp[near]
    risen, by_w = foot(edge.grid.u_v, edge.safe_band_v, w)
    by_term = []
    for at, g, g_w, _ in edge.corners(w, dp):
        phi, phi_w, _ = edge.terms(at, w, dp)
        by_term.append((risen * g)[:, None] * phi_w + (risen * g_w + by_w * g)[:, None] * phi)
    signed = np.stack(by_term, axis=1) * np.sign(dp)[:, None, None]
    return Slopes(w, dp, cells[near], parts[near], signed)


def _met(edge: EdgeMap, w: FloatArray, dp: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The cells that blend at points (k,), V and Pa, and their parts: each (k, 4), see `Slopes`."""
    at, weight = [], []
    for (i, j), g, *_ in edge.corners(w, dp):
        at.append(i * edge.grid.shape[1] + j)
        weight.append(g)
    cells, weights = np.stack(at, axis=1), np.stack(weight, axis=1)
    main = np.take_along_axis(cells, weights.argmax(axis=1)[:, None], axis=1)
    return cells, np.where(weights > 0, cells, main)


def _around(border: FloatArray, count: int) -> FloatArray:
    """count points over the overlap at each border, and the middles of the blocks."""
    at = border[:, None] + overlaps(border)[:, None] * np.linspace(-1.0, 1.0, count)
    at = np.sort(np.append(at.ravel(), 0.5 * (border[1:] + border[:-1])))
    return at[(at >= border[0]) & (at <= border[-1])]


def _roots(spread: FloatArray) -> FloatArray:
    """Square roots of covariances (cells, 6, 6), of rank 6 even where a term is known exactly."""
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, FLOOR**2 * values[:, -1:])
    return np.asarray(vectors * np.sqrt(values)[:, None, :])


def _by_the_worst_row(edge: EdgeMap, root: FloatArray, slopes: Slopes) -> FloatArray:
    """Standard deviations (cells,) by which a single slope that falls would move each cell."""
    needed, slope = np.zeros(len(root)), slopes.of(edge.theta)
    falls = slope < 0
    if falls.any():
        rows, sd = slopes[falls].rows(root)
        alone = (-slope[falls] / sd)[:, None] * np.linalg.norm(rows, axis=2)
        np.maximum.at(needed, slopes.cells[falls], alone)
    return needed


def _least_change(edge: EdgeMap, root: FloatArray, slopes: Slopes) -> tuple[FloatArray, FloatArray]:
    """The nearest terms with slopes >= 0 at all points; each cell's change in standard deviations.

    Per cell and pressure drop only the steepest fall is demanded to rise, then what falls yet.
    """
    line = np.stack([slopes.parts[:, 0], slopes.dp], axis=1)
    start = slope = slopes.of(edge.theta)
    theta, needed = edge.theta, np.zeros(len(root))
    demanded, u = np.zeros(0, np.intp), np.zeros(0)
    for _ in range(ROUNDS):
        falls = np.setdiff1d(np.flatnonzero(slope < 0), demanded)
        if not len(falls):
            break
        falls = falls[np.argsort(slope[falls])]
        demanded = np.append(demanded, falls[np.unique(line[falls], axis=0, return_index=True)[1]])
        rows, sd = slopes[demanded].rows(root)
        z, u = np.zeros((len(root), TERMS)), np.append(u, np.zeros(len(demanded) - len(u)))
        shortest(rows, slopes.cells[demanded], MARGIN - start[demanded] / sd, u, z)
        needed = np.linalg.norm(z, axis=1)
        moved = needed > 0
        theta = edge.theta.copy()
        theta.reshape(-1, TERMS)[moved] += (root[moved] @ z[moved, :, None])[:, :, 0]
        slope = slopes.of(theta)
    return theta, needed
