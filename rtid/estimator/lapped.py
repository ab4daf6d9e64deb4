"""From overlapping windows to Taylor terms per cell: all that follows knows one kind of map.

The values f = A theta of the lapped fit at 16 Gauss points of a cell have the covariance
C = A cov A' (+ what blocks that were never visited may add + what six terms cannot follow); the
cell's Taylor terms are their generalised least squares,

    theta_cell = (Phi' C^-1 Phi + 1 / prior)^-1 Phi' C^-1 f.
"""

from __future__ import annotations

import numpy as np

from rtid.estimator.state import MASKS
from rtid.estimator.sums import Sums
from rtid.kernels.basis import lapped_at, taylor
from rtid.kernels.layout import TERMS
from rtid.model import BASES, BLENDED, LAPPED, TAYLOR, Edge, FloatArray, Model

NODES = np.polynomial.legendre.leggauss(4)[0]
POINTS = np.array([(xi, eta) for xi in NODES for eta in NODES])  # of a cell, local coordinates
# Standard deviation of what a block's terms cannot follow, in shares of the rated flow: six local
# cosines miss about 1 % of a valve's flow on a usual grid, as measured on simulated plants.
TRUNCATION = {LAPPED: 1e-2, BLENDED: 1e-3}


def overlaps(model: Model) -> bool:
    """True when the windows of a map overlap."""
    return any(edge.basis != TAYLOR for edge in model.edges)


def to_taylor(
    model: Model, sums: Sums, cov: FloatArray, prior_sd: float
) -> tuple[FloatArray, FloatArray]:
    """Matrix T (n, n) from the unknowns to those with Taylor terms, and their covariance (n, n).

    cov (n, n): of the unknowns in their scaled units; prior_sd: of a term without data.
    """
    n_shared = sums.n_shared
    change, slots = np.eye(len(cov)), _places(model, sums)
    tiles = []
    for (edge, i, j), slot in slots.items():
        if model.edges[edge].basis == TAYLOR:
            continue
        near, at = _near(model.edges[edge], i, j), n_shared + TERMS * slot
        known = [(cell, slots[edge, *cell]) for cell in near if (edge, *cell) in slots]
        values = {cell: _values(model.edges[edge], cell, (i, j)) for cell in near}
        columns = np.concatenate([n_shared + TERMS * s + np.arange(TERMS) for _, s in known])
        a = np.hstack([values[cell] for cell, _ in known])
        c = a @ cov[np.ix_(columns, columns)] @ a.T + TRUNCATION[
            model.edges[edge].basis
        ] ** 2 * np.eye(len(a))
        for cell in near:
            if (edge, *cell) not in slots:
                c += prior_sd**2 * values[cell] @ values[cell].T
        phi = taylor_terms() * MASKS[model.edges[edge].terms]
        weighed = np.linalg.solve(c, phi)
        tile = np.linalg.inv(phi.T @ weighed + np.eye(TERMS) / prior_sd**2)
        change[at : at + TERMS] = 0.0
        change[at : at + TERMS, columns] = tile @ weighed.T @ a
        tiles.append((at, tile))
    changed = change @ cov @ change.T
    for at, tile in tiles:
        changed[at : at + TERMS, at : at + TERMS] = tile
    return change, changed


def _places(model: Model, sums: Sums) -> dict[tuple[int, int, int], int]:
    """Place of each visited (edge, i, j) among the blocks."""
    found, first = {}, 0
    for edge, declared in enumerate(model.edges):
        nu, nd = declared.grid.shape
        for place in np.flatnonzero(sums.blocks["edge"] == edge):
            found[(edge, *divmod(int(sums.cells[place]) - first, nd))] = int(place)
        first += nu * nd
    return found


def _near(edge: Edge, i: int, j: int) -> list[tuple[int, int]]:
    """The cells whose windows reach into cell (i, j), itself included."""
    nu, nd = edge.grid.shape
    along_u = range(max(0, i - 1), min(nu, i + 2))
    return [(a, b) for a in along_u for b in range(max(0, j - 1), min(nd, j + 2))]


def _values(edge: Edge, block: tuple[int, int], cell: tuple[int, int]) -> FloatArray:
    """The six lapped functions of a block at the Gauss points of a cell (16, 6)."""
    u, p = edge.grid.u_v[cell[0] : cell[0] + 2], edge.grid.dp_pa[cell[1] : cell[1] + 2]
    middle, half = np.array([u.mean(), p.mean()]), 0.5 * np.array([u[1] - u[0], p[1] - p[0]])
    out = np.empty((len(POINTS), TERMS))
    points, basis = middle + half * POINTS, BASES.index(edge.basis)
    lapped_at(basis, edge.grid.u_v, edge.grid.dp_pa, *block, points, out)
    return out * MASKS[edge.terms]


def taylor_terms() -> FloatArray:
    """The six Taylor terms at the Gauss points (16, 6)."""
    out = np.empty((len(POINTS), TERMS))
    for row, (xi, eta) in zip(out, POINTS, strict=True):
        taylor(xi, eta, row)
    return out
