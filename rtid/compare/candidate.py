"""What is held against a trace: a map in Taylor terms, with its compressibility and its weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.flowmap import FlowMap
from rtid.estimator.record import RecordFit
from rtid.estimator.solution import Solution
from rtid.estimator.state import Weights
from rtid.kernels.layout import TERMS
from rtid.model import TAYLOR
from rtid.plain import FloatArray


@dataclass(frozen=True)
class CandidateMap:
    """A map with its compressibility: theta (cells, 6) in m3/s, compliance (chambers,) in 1/Pa.

    status (cells,) holds the words of `rtid.estimator.flowmap`; weights gives lag and noise slopes.
    terms (terms,): coefficients of the model's shared terms in units of their scales.
    fitted (cells, 6): the fit's own terms, before the orifice law and the blending of the published
    map, NaN where it has none: what whitened innovations are taken from, where it is there.
    """

    name: str
    theta: FloatArray
    compliance: FloatArray
    status: NDArray[np.str_]
    weights: Weights
    terms: FloatArray
    fitted: FloatArray | None = None


def learned(fit: RecordFit, flowmap: FlowMap, name: str = "learned") -> CandidateMap:
    """The published map with the compliance and lag of the fit."""
    status = np.concatenate([edge.status.ravel() for edge in flowmap.edges])
    compliance = fit.solution.compliance
    terms, theta = fit.solution.terms_theta, flowmap.theta_cells()
    fitted = _fitted(fit.solution)
    return CandidateMap(name, theta, compliance, status, fit.weights, terms, fitted)


def _fitted(solution: Solution) -> FloatArray | None:
    """The fit's own terms (cells, 6), NaN where never visited; None where windows overlap."""
    model = solution.model
    if any(edge.basis != TAYLOR for edge in model.edges):
        return None
    theta, first = np.full((model.n_cells, TERMS), np.nan), model.first_cells
    for b in solution.blocks:
        theta[first[b.edge] + b.i * model.edges[b.edge].grid.shape[1] + b.j] = b.theta
    return theta


def itself(candidate: CandidateMap) -> CandidateMap:
    """The candidate with the fit's own terms in all blocks that it has visited."""
    if candidate.fitted is None:
        return candidate
    known = np.isfinite(candidate.fitted[:, 0])
    theta = np.where(known[:, None], candidate.fitted, candidate.theta)
    return replace(candidate, theta=theta)
