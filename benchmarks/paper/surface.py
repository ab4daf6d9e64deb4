"""A function learned over a plane, and its error and its jumps at the borders of the blocks.

The jump of an estimate is its change over a border that the slopes beside it do not explain: over
one step from just below to just above, less the mean of the changes over the steps before and
after.  A step is 1 % of the narrower block.  The excess is the change less that of the truth: it
also counts what is steep, but continuous.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.paper.alone import alone
from benchmarks.paper.function import U_MAX, X_MAX, declared, true_value
from rtid.estimator.flowmap import VALID, EdgeMap
from rtid.estimator.record import fit_record
from rtid.estimator.solution import Solution
from rtid.kernels.basis import window_terms_at
from rtid.kernels.layout import TERMS
from rtid.model import BASES, Grid
from rtid.plain import FloatArray

STEP = 0.01  # of the narrower block's width, over which a jump is measured
ALONG = 21  # points along each border of a block
LATTICE = (501, 201)  # points along u and x at which the error is taken

Surface = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Estimate:
    """What was learned on one grid with one basis."""

    basis: str
    solution: Solution
    published: EdgeMap

    @property
    def grid(self) -> Grid:
        """Its blocks."""
        return self.published.grid

    @property
    def valid_share(self) -> float:
        """Share of the blocks that are valid."""
        return float(np.mean(self.published.status == VALID))

    def windowed(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """The sum of the windowed basis functions themselves, at points (n,)."""
        edge, out = self.solution.model.edges[0], np.zeros(len(u))
        points, phi = np.stack([u, x], axis=1), np.empty((len(u), TERMS))
        theta = self.solution.unknowns[-TERMS * len(self.solution.cells) :].reshape(-1, TERMS)
        for cell, terms in zip(self.solution.cells, theta, strict=True):
            i, j = divmod(int(cell), self.grid.shape[1])
            basis = BASES.index(self.basis)
            window_terms_at(basis, self.grid.u_v, self.grid.dp_pa, i, j, points, phi)
            out += edge.rated_q_m3s * phi @ terms
        return out

    def unwindowed(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """Each point from the Taylor terms of its own block alone."""
        i = np.clip(np.searchsorted(self.grid.u_v, u) - 1, 0, self.grid.shape[0] - 1)
        j = np.clip(np.searchsorted(self.grid.dp_pa, x) - 1, 0, self.grid.shape[1] - 1)
        phi = self.published.terms((i, j), u, x)[0]
        return np.asarray((phi * self.published.theta[i, j]).sum(axis=1))


def learn(chunk: FloatArray, blocks: Grid, basis: str) -> Estimate:
    """The record path of the product on one grid with one basis."""
    solution = fit_record(declared(blocks, basis), chunk).solution
    return Estimate(basis, solution, alone(solution).edges[0])


def errors(estimate: Estimate, known: float = np.inf) -> FloatArray:
    """Published estimate less truth, share of full scale, on the lattice's valid points (n,).

    known: only where the stated standard deviation is at most this share of full scale.
    """
    u, x = _lattice()
    miss = estimate.published.flow(u, x) - true_value(u, x)
    valid = estimate.published.status_at(u, x) == VALID
    valid &= estimate.published.sd(u, x) <= known * full_scale()
    return np.asarray(miss[valid] / full_scale())


def full_scale() -> float:
    """Range of the true function."""
    return float(np.ptp(true_value(*_lattice())))


def _lattice() -> tuple[FloatArray, FloatArray]:
    axes = np.linspace(0, U_MAX, LATTICE[0]), np.linspace(0, X_MAX, LATTICE[1])
    u, x = np.meshgrid(*axes, indexing="ij")
    return u, x


def jumps(blocks: Grid, surface: Surface) -> FloatArray:
    """Jumps at all points of the inner borders of the blocks (n,), shares of full scale."""
    before, below, above, after = (surface(*_beside(blocks, s)) for s in (-1.5, -0.5, 0.5, 1.5))
    beside = 0.5 * ((below - before) + (after - above))
    return np.asarray(above - below - beside) / full_scale()


def excess(blocks: Grid, surface: Surface) -> FloatArray:
    """Changes over the inner borders less those of the truth (n,), shares of full scale."""
    below, above = (_beside(blocks, side) for side in (-0.5, 0.5))
    change = surface(*above) - surface(*below)
    return np.asarray(change - true_value(*above) + true_value(*below)) / full_scale()


def _beside(blocks: Grid, side: float) -> tuple[FloatArray, FloatArray]:
    """Points so many steps beside the inner borders across u, then across x."""
    u, x = _border_points(blocks.u_v, blocks.dp_pa, side)
    x2, u2 = _border_points(blocks.dp_pa, blocks.u_v, side)
    return np.concatenate([u, u2]), np.concatenate([x, x2])


def _border_points(
    across: FloatArray, along: FloatArray, side: float
) -> tuple[FloatArray, FloatArray]:
    width = np.diff(across)
    at = across[1:-1] + side * STEP * np.minimum(width[1:], width[:-1])
    inner = (np.arange(ALONG) + 0.5) / ALONG
    points = (along[:-1, None] + np.diff(along)[:, None] * inner).ravel()
    a, b = np.meshgrid(at, points, indexing="ij")
    return a.ravel(), b.ravel()


def rms(values: FloatArray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))
