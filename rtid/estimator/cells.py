"""From a flow to the six Taylor terms of a cell: least squares at 4 x 4 Gauss points."""

from __future__ import annotations

from functools import cache

import numpy as np

from rtid.model import Grid
from rtid.plain import FloatArray

NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)


def quadrature(grid: Grid, i: int) -> tuple[FloatArray, FloatArray]:
    """Gauss points of all cells of column i: w in V and dp in Pa (nd, 16)."""
    w = 0.5 * (grid.u_v[i] + grid.u_v[i + 1]) + 0.5 * (grid.u_v[i + 1] - grid.u_v[i]) * NODES
    middle, half = 0.5 * (grid.dp_pa[1:] + grid.dp_pa[:-1]), 0.5 * np.diff(grid.dp_pa)
    dp = middle[:, None] + half[:, None] * NODES
    n = len(NODES)
    return np.broadcast_to(np.repeat(w, n), (len(dp), n * n)), np.tile(dp, (1, n))


@cache
def terms() -> FloatArray:
    """The six terms at the Gauss points (16, 6), dimensionless."""
    xi, eta = np.repeat(NODES, len(NODES)), np.tile(NODES, len(NODES))
    return np.stack([np.ones_like(xi), xi, eta, xi * xi, eta * eta, xi * eta], axis=1)


@cache
def projection() -> FloatArray:
    """Least squares from values at the Gauss points to the six terms (6, 16), dimensionless."""
    weight = np.sqrt(_weights())
    return np.asarray(np.linalg.pinv(weight[:, None] * terms()) * weight)


@cache
def mean_square() -> FloatArray:
    """Mean of phi phi' over a cell (6, 6), dimensionless."""
    return np.asarray((terms().T * _weights()) @ terms())


@cache
def mean() -> FloatArray:
    """Mean of phi over a cell (6,), dimensionless."""
    return np.asarray(_weights() @ terms())


@cache
def _weights() -> FloatArray:
    """Share of the cell that each Gauss point stands for (16,)."""
    return np.asarray(0.25 * np.outer(WEIGHTS, WEIGHTS).ravel())
