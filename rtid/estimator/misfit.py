"""What the blocks' own misfit does to the compliances: a covariance by clusters of blocks.

Six terms per block do not follow a map exactly; what is left is the same at every visit of a block,
so it does not average out over time as noise does.  With w_k the whitened row of the compliance's
influence (its covariance with all unknowns, times the columns) and r_k the innovation,

    error of theta_beta = sum_k w_k r_k,

summed per block these are independent from block to block, and their sum of squares estimates the
variance, noise and misfit together (cluster-robust covariance; blocks of both chambers are crossed
clusters: Cameron, Gelbach and Miller 2011).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from rtid.estimator.solution import Sketch, Solution, widen
from rtid.estimator.state import Weights, build
from rtid.kernels.engine import ROW_FLAG
from rtid.kernels.explain import explain
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

Cells = IntArray


def count_misfit(
    model: Machine, chunk: FloatArray, weights: Weights, solution: Solution
) -> Solution:
    """The solution with intervals that hold where its blocks' polynomials miss their maps.

    chunk (n, 2 + signals): the record that it was learned from, SI.
    """
    if not can_be_explained(chunk):
        return solution
    cov = solution.compliance_cov / np.outer(solution.scale_pa, solution.scale_pa)
    return widen(solution, cov * (widened(model, chunk, weights, solution) - 1.0))


def widened(
    model: Machine, chunk: FloatArray, weights: Weights, estimate: Solution | Sketch
) -> FloatArray:
    """By what the misfit multiplies the covariance of the compliances, (chambers, chambers).

    chunk (n, 2 + signals): the record that it was learned from, SI, which can be explained.
    """
    scores, cells = _scores(model, chunk, weights, estimate)
    chambers = range(len(model.chambers))
    if not len(scores):
        return np.ones((len(chambers), len(chambers)))
    variance = crossed(scores, [_of_chamber(model, cells, c) for c in chambers])
    ratio = np.sqrt(np.maximum(1.0, variance / estimate.influence.diagonal()))
    return np.outer(ratio, ratio)


def can_be_explained(chunk: FloatArray) -> bool:
    """True where every sample of chunk (n, 2 + signals), SI, is a row.

    Where the position comes rarely, the engine may begin a new memory between two rows, which
    `explain` does not see: what is left of the blocks visited before would pass for misfit.
    """
    return len(chunk) >= 2 and bool((chunk[:, 1].astype(int) & ROW_FLAG).all())


@dataclass(frozen=True)
class Misfit:
    """A fit held against its record, per interval (n - 1).

    missed (n - 1, chambers): measured flow less modelled, m3/s; innovation (n - 1, chambers):
    whitened, NaN where no row; cells (n - 1, edges): grid cell, -1 shut, in half of an index;
    estimate: what it was held beside, of `residual_of`.
    """

    missed: FloatArray
    innovation: FloatArray
    cells: Cells
    estimate: Solution | Sketch | None = None


def residual_of(
    model: Machine, chunk: FloatArray, weights: Weights, estimate: Solution | Sketch
) -> Misfit:
    """What an estimate leaves of its record, chunk (n, 2 + signals) in SI."""
    n_c = len(model.chambers)
    theta = _cells_of(model, estimate.cells, estimate.unknowns)
    terms = estimate.unknowns[n_c : n_c + len(model.terms)]
    misfit = _residual(model, chunk, weights, theta, estimate.compliance, terms)
    return replace(misfit, estimate=estimate)


def _scores(
    model: Machine, chunk: FloatArray, weights: Weights, solution: Solution | Sketch
) -> tuple[FloatArray, Cells]:
    """w_k r_k (rows, chambers) about their mean, and the grid cells (rows, edges)."""
    theta, flows = _per_cell(model, solution)
    n_c = len(solution.scale_pa)
    terms = solution.unknowns[n_c : n_c + len(model.terms)]
    misfit = _residual(model, chunk, weights, theta, solution.compliance, terms)
    residual, cells = misfit.innovation, misfit.cells
    scores = np.empty((len(residual), len(solution.scale_pa)))
    for c, influence in enumerate(flows):
        moved = solution.compliance + solution.influence[c, :n_c] * solution.scale_pa
        shared = terms + solution.influence[c, n_c : n_c + len(terms)]
        shifted = _residual(model, chunk, weights, theta + influence, moved, shared).innovation
        scores[:, c] = ((residual - shifted) * residual).sum(axis=1)
    known = np.isfinite(scores).all(axis=1)
    scores, cells = scores[known], cells[known]
    return scores - scores.sum(axis=0) / max(1, len(scores)), cells


def _per_cell(model: Machine, solution: Solution | Sketch) -> tuple[FloatArray, list[FloatArray]]:
    """The fitted map (cells, 6) in m3/s, and the influence on each compliance as such maps."""
    rows = (solution.unknowns, *solution.influence)
    maps = [_cells_of(model, solution.cells, unknowns) for unknowns in rows]
    return maps[0], maps[1:]


def _cells_of(model: Machine, cells: IntArray, unknowns: FloatArray) -> FloatArray:
    """The maps' part of the unknowns by grid cell (cells, 6), m3/s; 0 where never visited."""
    theta = np.zeros((model.n_cells, TERMS))
    theta[cells] = unknowns[len(model.chambers) + len(model.terms) :].reshape(-1, TERMS)
    return np.asarray(theta * np.repeat(*_rated(model))[:, None])


def _rated(model: Machine) -> tuple[FloatArray, list[int]]:
    """Rated flow and number of cells of each map."""
    rated = np.array([edge.rated_q_m3s for edge in model.maps])
    return rated, [edge.grid.shape[0] * edge.grid.shape[1] for edge in model.maps]


def _residual(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    theta: FloatArray,
    compliance: FloatArray,
    terms: FloatArray,
) -> Misfit:
    n, n_c, state = len(chunk), len(model.chambers), build(model, weights)
    state.engine[0]["term_theta"][: len(terms)] = terms
    flow, innovation = np.empty((n - 1, 2 * n_c)), np.empty((n - 1, n_c))
    cells = np.empty((n - 1, len(model.edges)), np.int64)
    explain(state.engine, state.cells, theta, compliance, chunk, flow, cells, innovation)
    missed = flow[:, 0::2] - flow[:, 1::2]
    return Misfit(missed, innovation, cast("Cells", cells.astype(np.int32)))


def _of_chamber(model: Machine, cells: Cells, chamber: int) -> Cells:
    """One number per row: which blocks the edges of a chamber are in."""
    place = np.zeros(len(cells), np.int64)
    for i, edge in enumerate(model.edges):
        if edge.sign(model.chambers[chamber]) != 0:
            place = place * (model.n_cells + 1) + cells[:, i] + 1
            place = np.unique(place, return_inverse=True)[1]  # small again, in the same order
    return place


def crossed(scores: FloatArray, clusters: list[Cells]) -> FloatArray:
    """Variance (chambers,), in any unit, of the sum of scores alike within either cluster."""
    if len(clusters) == 1:
        return _clustered(scores, clusters[0])
    both = clusters[0] * (clusters[1].max() + 1) + clusters[1]
    alone = [_clustered(scores, cluster) for cluster in clusters]
    together = _clustered(scores, np.unique(both, return_inverse=True)[1])
    # The difference of estimates can turn negative; the sum is at least as alike as in either.
    return np.maximum(alone[0] + alone[1] - together, np.maximum(alone[0], alone[1]))


def _clustered(scores: FloatArray, cluster: Cells) -> FloatArray:
    n = int(cluster.max()) + 1
    sums = np.stack([np.bincount(cluster, column, n) for column in scores.T], axis=1)
    return np.asarray((sums**2).sum(axis=0) * n / max(1, n - 1))
