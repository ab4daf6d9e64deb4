"""From overlapping windows to Taylor terms per cell: all that follows knows one kind of map.

The values f = A theta of the fit at 16 Gauss points of a cell have the covariance
C = A cov A' (+ what blocks that were never visited may add + what six terms cannot follow); the
cell's Taylor terms are their generalised least squares,

    theta_cell = (Phi' C^-1 Phi + 1 / prior)^-1 Phi' C^-1 f.
"""

from __future__ import annotations

import numpy as np

from rtid.estimator.cells import quadrature, terms
from rtid.estimator.state import MASKS, fitted_terms
from rtid.estimator.sums import Sums
from rtid.kernels.basis import window_terms_at
from rtid.kernels.layout import TERMS
from rtid.model import BASES, BLENDED, LAPPED, PROPORTIONAL, TAYLOR, Edge, Machine
from rtid.plain import FloatArray

# Standard deviation of what a block's terms cannot follow, in shares of the rated flow: six local
# cosines miss about 1 % of a valve's flow on a usual grid, as measured on simulated plants.
TRUNCATION = {LAPPED: 1e-2, BLENDED: 1e-3, PROPORTIONAL: 1e-6}


def overlaps(model: Machine) -> bool:
    """True when the windows of a map overlap."""
    return any(edge.basis != TAYLOR for edge in model.edges)


def to_taylor(
    model: Machine, sums: Sums, cov: FloatArray, prior_sd: float
) -> tuple[FloatArray, FloatArray]:
    """Matrix T (n, n) from the unknowns to those with Taylor terms, and their covariance (n, n).

    cov (n, n): of the unknowns in their scaled units; prior_sd: of a term without data.
    """
    places, tiles = _places(model, sums), {}
    change = np.eye(len(cov))
    for (edge, *cell), place in places.items():
        declared, at = model.edges[edge], sums.n_shared + TERMS * place
        if declared.basis == TAYLOR:
            continue
        near = {c: _values(declared, c, cell) for c in _near(declared, *cell)}
        known = [c for c in near if (edge, *c) in places]
        first = np.array([sums.n_shared + TERMS * places[edge, *c] for c in known])
        columns = (first[:, None] + np.arange(TERMS)).ravel()
        a = np.hstack([near[c] for c in known])
        missing = [prior_sd**2 * v @ v.T for c, v in near.items() if c not in known]
        spread = a @ cov[np.ix_(columns, columns)] @ a.T + sum(missing)
        tiles[at], back = _least_squares(declared, spread, prior_sd)
        change[at : at + TERMS] = 0.0
        change[at : at + TERMS, columns] = back @ a
    changed = change @ cov @ change.T
    for at, tile in tiles.items():
        changed[at : at + TERMS, at : at + TERMS] = tile
    return change, changed


def _least_squares(
    edge: Edge, spread: FloatArray, prior_sd: float
) -> tuple[FloatArray, FloatArray]:
    """Covariance (6, 6) of a cell's Taylor terms, and how they follow its 16 values (6, 16)."""
    phi = terms() * MASKS[edge.terms]
    known = spread + TRUNCATION[edge.basis] ** 2 * np.eye(len(phi))
    weighed = np.linalg.solve(known, phi)
    tile = np.linalg.inv(phi.T @ weighed + np.eye(TERMS) / prior_sd**2)
    return tile, tile @ weighed.T


def _places(model: Machine, sums: Sums) -> dict[tuple[int, int, int], int]:
    """Place of each visited (edge, i, j) among the blocks."""
    places = {}
    for place, record in enumerate(sums.blocks):
        edge = int(record["edge"])
        cell = int(record["cell"]) - model.first_cells[edge]
        places[(edge, *divmod(cell, model.edges[edge].grid.shape[1]))] = place
    return places


def _near(edge: Edge, i: int, j: int) -> list[tuple[int, int]]:
    """The cells whose windows reach into cell (i, j), itself included."""
    nu, nd = edge.grid.shape
    along_u = range(max(0, i - 1), min(nu, i + 2))
    return [(a, b) for a in along_u for b in range(max(0, j - 1), min(nd, j + 2))]


def _values(edge: Edge, block: tuple[int, int], cell: list[int]) -> FloatArray:
    """The six functions of a block at the Gauss points of a cell (16, 6)."""
    w, dp = quadrature(edge.grid, cell[0])
    points, out = np.stack([w[cell[1]], dp[cell[1]]], axis=1), np.empty((w.shape[1], TERMS))
    basis = BASES.index(edge.basis)
    window_terms_at(basis, edge.grid.u_v, edge.grid.dp_pa, *block, points, out)
    return out * fitted_terms(edge)
