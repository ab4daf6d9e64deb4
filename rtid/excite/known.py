"""What is known before a motion, as the information that segments add to.

A prior map tells of each cell on its own: P^-1 of its terms there, P as `rtid.estimator.prior` has
it.  Errors of a prior are alike from cell to cell, which is left out: one cell that is visited says
nothing of the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtid.estimator.blocks import VALID, Block
from rtid.estimator.prior import Prior, prior_terms
from rtid.estimator.solution import Solution
from rtid.excite.information import PRIOR
from rtid.excite.selection import ENOUGH_ROWS, KnownCells
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray


def known_from(model: Machine, solution: Solution) -> KnownCells:
    """Information and rows per grid cell of everything that a solution has learned."""
    known = KnownCells.nothing(model.n_cells)
    for b in solution.blocks:
        edge = model.edges[b.edge]
        cell = model.first_cells[b.edge] + b.i * edge.grid.shape[1] + b.j
        scale = 1.0 / edge.rated_q_m3s**2
        known.blocks[cell] = np.linalg.inv(b.cov * scale) - PRIOR
        known.rows[cell] = b.rows
    return known


def take_prior(
    known: KnownCells, model: Machine, prior: Prior, blocks: Sequence[Block] = ()
) -> None:
    """Add what a prior map tells, in place; it counts as rows do that are enough.

    blocks: what is learned already; a prior that misses it is believed less.
    """
    theta, cov = prior_cells(model, prior, blocks)
    rated = np.concatenate([np.full(e.grid.shape, e.rated_q_m3s).ravel() for e in model.edges])
    known_cells = np.isfinite(theta).all(axis=1)
    known.blocks[known_cells] += np.linalg.inv(
        cov[known_cells] / rated[known_cells, None, None] ** 2
    )
    known.rows[known_cells] = np.maximum(known.rows[known_cells], ENOUGH_ROWS)


def prior_cells(
    model: Machine, prior: Prior, blocks: Sequence[Block] = ()
) -> tuple[FloatArray, FloatArray]:
    """Terms (cells, 6) of a prior map, m3/s, covariance (cells, 6, 6); NaN off its own."""
    theta = np.full((model.n_cells, TERMS), np.nan)
    cov = np.full((model.n_cells, TERMS, TERMS), np.nan)
    maps = {edge.name: edge for edge in prior.flowmap.edges}
    for k, edge in enumerate(model.edges):
        if edge.name in maps:
            valid = [b for b in blocks if b.edge == k and b.status == VALID]
            terms = prior_terms(edge, maps[edge.name], prior.share, valid)
            first = model.first_cells[k]
            place = slice(first, first + edge.grid.shape[0] * edge.grid.shape[1])
            theta[place], cov[place] = (a.reshape(-1, *a.shape[2:]) for a in terms)
    return theta, cov
