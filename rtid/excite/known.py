"""What a solution knows already, as the information that segments add to."""

from __future__ import annotations

import numpy as np

from rtid.estimator.solution import Solution
from rtid.excite.information import PRIOR
from rtid.excite.selection import Known
from rtid.model import Model


def known_from(model: Model, solution: Solution) -> Known:
    """Information and rows per grid cell of everything that a solution has learned."""
    known = Known.nothing(model.n_cells)
    for b in solution.blocks:
        edge = model.edges[b.edge]
        cell = model.first_cells[b.edge] + b.i * edge.grid.shape[1] + b.j
        scale = 1.0 / edge.rated_q_m3s**2
        known.blocks[cell] = np.linalg.inv(b.cov * scale) - PRIOR
        known.rows[cell] = b.rows
    return known
