"""A valve that is opened further passes no less: dQ/dw sign(dp) >= 0, as far as the data allow.

The published slope is linear in all cells' terms.  With their covariance C (the block's own misfit
included: it is what bends a polynomial down before the end of a dead band), the map that is changed
least is the most likely one among those that do not fall:

    minimise (theta - theta_0)' C^-1 (theta - theta_0)   subject to   slope rows theta >= 0,

a least-distance problem (Lawson and Hanson 1974, ch. 23).  A cell that would have to change by more
than LIMIT standard deviations keeps what the data say, and is marked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap
from rtid.estimator.windows import foot, overlaps
from rtid.kernels.layout import TERMS
from rtid.model import FloatArray

KNOWN = (VALID, LEARNING)
LIMIT = 3.0  # standard deviations by which a cell's terms may be changed
FLOOR = 1e-2  # share of its worst known direction's sd that every direction of a cell may move
MARGIN = 1e-2  # least slope, in its standard deviations: what lies between the points stays above 0
DENSE, COARSE = 13, 5  # slopes looked at per overlap, along w and along dp
ROUNDS = 40  # of adding what the last change has left falling

FALLS = "flow falls with the command, {:.1f} standard deviations against it"
Mask = NDArray[np.bool_]


def monotone(edge: EdgeMap, spread: FloatArray) -> EdgeMap:
    """The map that does not fall where cells are known; spread (nu, nd, 6, 6): C of each cell."""
    known = np.isin(edge.status, KNOWN).ravel()
    root = _roots(spread.reshape(-1, TERMS, TERMS))
    w, dp, parts = _points(edge, known)
    reason, theta, needed = dict(edge.reason), edge.theta, _by_the_worst_row(edge, root, w, dp)
    while True:
        against = known & (needed > LIMIT)
        for cell in np.flatnonzero(against).tolist():
            at = divmod(cell, edge.grid.shape[1])
            reason[at] = "; ".join(filter(None, (reason.get(at), FALLS.format(needed[cell]))))
        left = ~against[parts].any(axis=1)
        w, dp, parts = w[left], dp[left], parts[left]
        theta, needed = _least_change(edge, root, w, dp, parts[:, 0])
        if not (known & (needed > LIMIT)).any():
            return replace(edge, theta=theta, reason=reason)


def _points(edge: EdgeMap, known: Mask) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Where slopes are looked at: w, dp (k,) in known cells' reach, and the cells there (k, 4)."""
    w, dp = np.meshgrid(
        _around(edge.grid.u_v, DENSE), _around(edge.grid.dp_pa, COARSE), indexing="ij"
    )
    used = (w > edge.safe_band_v) & (dp != 0)
    w, dp = w[used], dp[used]
    corners = [(i * edge.grid.shape[1] + j, g) for (i, j), g, *_ in edge.corners(w, dp)]
    cells, weights = (np.stack(part, axis=1) for part in zip(*corners, strict=True))
    main = np.take_along_axis(cells, weights.argmax(axis=1)[:, None], axis=1)
    cells = np.where(weights > 0, cells, main)
    some = known[cells].any(axis=1)
    return w[some], dp[some], cells[some]


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


def _slopes(edge: EdgeMap, w: FloatArray, dp: FloatArray) -> FloatArray:
    return np.asarray(edge.gradient(w, dp)[0] * np.sign(dp))


def _rows(
    edge: EdgeMap, root: FloatArray, w: FloatArray, dp: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Slopes as rows (k, cells, 6) of unit norm on z, theta + root z; their norms; the cells."""
    risen, by_w = foot(edge.grid.u_v, edge.safe_band_v, w)
    data, at = [], []
    for (i, j), g, g_w, _ in edge.corners(w, dp):
        phi, phi_w, _ = edge.terms((i, j), w, dp)
        data.append((risen * g)[:, None] * phi_w + (risen * g_w + by_w * g)[:, None] * phi)
        at.append(i * edge.grid.shape[1] + j)
    cells, where = np.unique(np.stack(at, axis=1), return_inverse=True)
    where = where.reshape(len(w), 4)
    moved = np.stack(data, axis=1)[:, :, None, :] @ root[cells[where]]
    rows = np.zeros((len(w), len(cells), TERMS))
    np.add.at(
        rows, (np.arange(len(w))[:, None], where), moved[:, :, 0] * np.sign(dp)[:, None, None]
    )
    sd = np.linalg.norm(rows, axis=(1, 2))
    return rows / sd[:, None, None], sd, cells


def _by_the_worst_row(edge: EdgeMap, root: FloatArray, w: FloatArray, dp: FloatArray) -> FloatArray:
    """Standard deviations (cells,) by which a single slope that falls would move each cell."""
    needed, slope = np.zeros(len(root)), _slopes(edge, w, dp)
    falls = slope < 0
    if falls.any():
        rows, sd, cells = _rows(edge, root, w[falls], dp[falls])
        alone = (-slope[falls] / sd)[:, None] * np.linalg.norm(rows, axis=2)
        needed[cells] = alone.max(axis=0)
    return needed


def _least_change(
    edge: EdgeMap, root: FloatArray, w: FloatArray, dp: FloatArray, cell: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """The nearest terms with slopes >= 0 at all points; each cell's change in standard deviations.

    Per cell and pressure drop only the steepest fall is demanded to rise, then what falls yet.
    """
    line = np.stack([cell, dp], axis=1)
    start = slope = _slopes(edge, w, dp)
    theta, needed = edge.theta, np.zeros(len(root))
    demanded = np.zeros(0, np.intp)
    for _ in range(ROUNDS):
        falls = np.setdiff1d(np.flatnonzero(slope < 0), demanded)
        if not len(falls):
            break
        falls = falls[np.argsort(slope[falls])]
        demanded = np.append(demanded, falls[np.unique(line[falls], axis=0, return_index=True)[1]])
        rows, sd, cells = _rows(edge, root, w[demanded], dp[demanded])
        z = _least_distance(rows.reshape(len(rows), -1), MARGIN - start[demanded] / sd)
        z = z.reshape(-1, TERMS)
        needed = np.zeros(len(root))
        needed[cells] = np.linalg.norm(z, axis=1)
        theta = edge.theta.copy()
        theta.reshape(-1, TERMS)[cells] += (root[cells] @ z[:, :, None])[:, :, 0]
        slope = _slopes(replace(edge, theta=theta), w, dp)
    return theta, needed


def _least_distance(rows: FloatArray, least: FloatArray) -> FloatArray:
    """The shortest z with rows z >= least (Lawson and Hanson's LDP)."""
    dense = np.vstack([rows.T, least])
    u, _ = nnls(dense, np.append(np.zeros(rows.shape[1]), 1.0), maxiter=50 * len(least))
    rest = dense @ u
    return np.asarray(rest[:-1] / (1.0 - rest[-1]))
