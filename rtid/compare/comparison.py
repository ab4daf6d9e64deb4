"""Hold a map against a trace: the equation residual of every chamber, and what it was made of.

Per chamber, the measured side s A v of eq. (14) and the modelled one, both through H_f of eq. (10)
and decimated to the rows of the project's filter; their difference is the equation residual.  Any
map can be held against any trace: the learned one, a calibrated one, a data sheet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtid.compare.reference import ReferenceMap
from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID, FlowMap
from rtid.estimator.record import RecordFit
from rtid.estimator.state import Weights, build
from rtid.kernels.explain import explain, filter_rows
from rtid.model import FloatArray, Model

REFERENCE, OUTSIDE = "reference", "outside"
# The status of an interval is that of its least certain open edge: the last of this list.
CERTAINTY = (SHUT, VALID, REFERENCE, LEARNING, EXTRAPOLATED, PRIOR, OUTSIDE)


@dataclass(frozen=True)
class Candidate:
    """A map with its compressibility: theta (cells, 6) in m3/s, compliance (chambers,) in 1/Pa.

    status (cells,) holds the words of `rtid.estimator.flowmap`; weights gives lag and noise slopes.
    terms (terms,): coefficients of the model's shared terms in units of their scales.
    """

    name: str
    theta: FloatArray
    compliance: FloatArray
    status: NDArray[np.str_]
    weights: Weights
    terms: FloatArray


@dataclass(frozen=True)
class Comparison:
    """One part of a trace beside what a candidate says about it, c chambers.

    t_s (rows,), measured_m3s and modelled_m3s (rows, c): through H_f.  cell (rows, edges): grid
    cell of each edge at the row, -1 shut.  shares: time by status of the least certain open edge.
    rho (c,): variance of the whitened innovations, 1 for a model that is right to the noise; a
    published map lies a little above the fit itself, whose weak terms it replaces by the law's.
    """

    name: str
    t_s: FloatArray
    measured_m3s: FloatArray
    modelled_m3s: FloatArray
    cell: NDArray[np.int64]
    shares: dict[str, float]
    rho: FloatArray

    @property
    def residual_m3s(self) -> FloatArray:
        """Measured minus modelled (rows, c)."""
        return self.measured_m3s - self.modelled_m3s

    @property
    def flow_rms_m3s(self) -> FloatArray:
        """Root mean square of the measured side (c,)."""
        return np.asarray(np.sqrt(np.mean(self.measured_m3s**2, axis=0)))

    @property
    def residual_rms_m3s(self) -> FloatArray:
        """Root mean square of the residual (c,)."""
        return np.asarray(np.sqrt(np.mean(self.residual_m3s**2, axis=0)))

    @property
    def residual_share(self) -> FloatArray:
        """Residual over flow, root mean squares (c,); NaN for a part without rows."""
        return self.residual_rms_m3s / self.flow_rms_m3s


def learned(fit: RecordFit, flowmap: FlowMap, name: str = "learned") -> Candidate:
    """The published map with the compliance and lag of the fit."""
    status = np.concatenate([edge.status.ravel() for edge in flowmap.edges])
    compliance = fit.solution.compliance
    terms = fit.solution.terms_theta
    return Candidate(name, flowmap.theta_cells(), compliance, status, fit.weights, terms)


def refitted(
    model: Model, reference: ReferenceMap, weights: Weights, chunk: FloatArray
) -> Candidate:
    """A reference map with each chamber's compliance fitted to the chunk, all else as it is."""
    theta = reference.theta_cells(model)
    empty, one = np.zeros_like(theta), np.ones(len(model.chambers))
    none = np.zeros(len(model.terms))
    by_map = _rows(model, _hold(model, theta, 0.0 * one, weights, none, chunk))
    by_beta = _rows(model, _hold(model, empty, one, weights, none, chunk))
    at = np.intersect1d(by_map[0], by_beta[0], return_indices=True)
    y = (by_map[1] - by_map[2])[at[1]]
    column = by_beta[2][at[2]]
    compliance = (column * y).sum(axis=0) / np.maximum((column**2).sum(axis=0), 1e-300)
    low, high = 1 / model.beta_bounds_pa[1], 1 / model.beta_bounds_pa[0]
    status = np.full(len(theta), REFERENCE)
    return Candidate(reference.name, theta, np.clip(compliance, low, high), status, weights, none)


def compare(model: Model, candidate: Candidate, chunk: FloatArray) -> Comparison:
    """Hold the candidate against samples chunk (n, 2 + signals) = [t_s, flags, values...], SI."""
    held = _hold(
        model, candidate.theta, candidate.compliance, candidate.weights, candidate.terms, chunk
    )
    t_s, measured, modelled = _rows(model, held)
    interval = np.clip(np.searchsorted(held.t_s, t_s) - 1, 0, len(held.cell) - 1)
    rho = _mean_squares(held.innovation)
    shares = _shares(held, candidate.status)
    return Comparison(candidate.name, t_s, measured, modelled, held.cell[interval], shares, rho)


@dataclass(frozen=True)
class _Held:
    """Raw result of `kernels.explain`; see there."""

    t_s: FloatArray
    flow: FloatArray
    cell: NDArray[np.int64]
    innovation: FloatArray


def _hold(
    model: Model,
    theta: FloatArray,
    compliance: FloatArray,
    weights: Weights,
    terms: FloatArray,
    chunk: FloatArray,
) -> _Held:
    n, c = max(len(chunk) - 1, 0), len(model.chambers)
    flow, innovation = np.full((n, 2 * c), np.nan), np.full((n, c), np.nan)
    cell = np.full((n, len(model.edges)), -1, np.int64)
    state = build(model.with_taylor_maps, weights)
    state.engine[0]["term_theta"][: len(terms)] = terms
    explain(state.engine, state.cells, theta, compliance, chunk, flow, cell, innovation)
    return _Held(np.ascontiguousarray(chunk[:, 0]), flow, cell, innovation)


def _rows(model: Model, held: _Held) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Row instants, measured and modelled flow through the project's filter."""
    f = model.filter
    if len(held.t_s) < 2:
        empty = np.empty((0, len(model.chambers)))
        return np.empty(0), empty, empty
    span_s = held.t_s[-1] - held.t_s[0]
    out = np.empty((int(span_s * f.rows_per_s) + 2, 1 + held.flow.shape[1]))
    rows = filter_rows(held.t_s, held.flow, f.wn_rad_s, f.zeta, 1.0 / f.rows_per_s, out)
    return out[:rows, 0], out[:rows, 1::2], out[:rows, 2::2]


def _mean_squares(innovation: FloatArray) -> FloatArray:
    known = np.isfinite(innovation).all(axis=1)
    if not known.any():
        return np.full(innovation.shape[1], np.nan)
    return np.asarray(np.mean(innovation[known] ** 2, axis=0))


def _shares(held: _Held, status: NDArray[np.str_]) -> dict[str, float]:
    """Share of the time per status of the least certain open edge."""
    rank = np.array([CERTAINTY.index(word) for word in status])
    worst = np.where(held.cell >= 0, rank[held.cell], 0).max(axis=1, initial=0)
    worst[~np.isfinite(held.flow).all(axis=1)] = CERTAINTY.index(OUTSIDE)
    dt = np.diff(held.t_s)
    total = max(float(dt.sum()), 1e-12)
    return {word: float(dt[worst == k].sum()) / total for k, word in enumerate(CERTAINTY)}
