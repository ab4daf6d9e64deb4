"""Hold a map against a trace: the equation residual of every chamber, and what it was made of.

Per chamber, the measured side s A v of eq. (14) and the modelled one, both through H_f of eq. (10)
and decimated to the rows of the project's filter; their difference is the equation residual.  Any
map can be held against any trace: the learned one, a calibrated one, a data sheet; extra flows of
effects go to the modelled side.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtid.compare.candidate import CandidateMap, itself
from rtid.compare.reference import Reference
from rtid.effects.extra import with_extra_flow
from rtid.effects.laws.response import left_behind
from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID
from rtid.estimator.state import Weights, build
from rtid.kernels.engine import GAP_FLAG
from rtid.kernels.explain import explain, filter_rows
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

REFERENCE, OUTSIDE = "reference", "outside"
# The status of an interval is that of its least certain open edge: the last of this list.
CERTAINTY = (SHUT, VALID, REFERENCE, LEARNING, EXTRAPOLATED, PRIOR, OUTSIDE)


@dataclass(frozen=True)
class Intervals:
    """The samples of a comparison before any filter.

    t_s (n,); cell (n - 1, edges): grid cell of each edge over the interval, -1 shut; innovation
    (n - 1, c): whitened, at the interval's end, the first chamber's own, the second's given the
    first; begun anew after every interval whose flow does not stand on data.  NaN: no row, or such
    an interval.  own (n - 1, c): the same of the fit's own terms instead of the published map's,
    in the data of the fit.  values (n - 1, m): the model's signals at the interval's start.
    left (n - 1,): of a rate that is measured itself, its sample at the interval's start less what
    is modelled, behind its lag; empty of others.
    """

    t_s: FloatArray
    cell: IntArray
    innovation: FloatArray
    own: FloatArray
    values: FloatArray
    left: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Comparison:
    """One part of a trace beside what a candidate says about it, c chambers.

    t_s (rows,), measured_m3s and modelled_m3s (rows, c), signals (rows, m) of the model: all
    through H_f.  cell (rows, edges): grid cell of each edge at the row, -1 shut.  shares: time by
    status of the least certain open edge.
    rho (c,): variance of the whitened innovations, 1 for a model that is right to the noise; a
    published map lies a little above the fit itself, whose weak terms it replaces by the law's.
    """

    name: str
    t_s: FloatArray
    measured_m3s: FloatArray
    modelled_m3s: FloatArray
    cell: IntArray
    shares: dict[str, float]
    rho: FloatArray
    signals: FloatArray
    intervals: Intervals

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
        """The residual's share of the flow, root mean squares (chambers,); NaN without a flow."""
        flow = self.flow_rms_m3s
        return np.divide(
            self.residual_rms_m3s, flow, out=np.full_like(flow, np.nan), where=flow > 0
        )


def refitted(
    model: Machine,
    reference: Reference,
    weights: Weights,
    chunk: FloatArray,
    terms: FloatArray | None = None,
) -> CandidateMap:
    """A reference map with each chamber's compliance fitted to the chunk, all else as it is.

    chunk (n, 2 + signals): SI; terms (terms,): coefficients of the model's shared terms, SI, zero
    where not given.
    """
    theta, none = reference.theta_cells(model), np.zeros(len(model.terms))
    beside = none if terms is None else terms
    ones = np.ones(len(model.chambers))
    unknown = np.full(len(theta), REFERENCE)
    parts = CandidateMap(reference.name, theta, 0.0 * ones, unknown, weights, beside)
    by_map = _rows(model, _hold(model, parts, chunk))
    parts = replace(parts, theta=np.zeros_like(theta), compliance=ones, terms=none)
    by_beta = _rows(model, _hold(model, parts, chunk))
    at = np.intersect1d(by_map.t_s, by_beta.t_s, return_indices=True)
    y = (by_map.measured - by_map.modelled)[at[1]]
    column = by_beta.modelled[at[2]]
    compliance = (column * y).sum(axis=0) / np.maximum((column**2).sum(axis=0), 1e-300)
    low, high = 1 / model.beta_bounds_pa[1], 1 / model.beta_bounds_pa[0]
    bounded = np.clip(compliance, low, high)
    return CandidateMap(reference.name, theta, bounded, unknown, weights, beside)


def compare(
    model: Machine,
    candidate: CandidateMap,
    chunk: FloatArray,
    extra_flow: FloatArray | None = None,
    seen: bool = False,
) -> Comparison:
    """Hold the candidate against samples chunk (n, 2 + signals) = [t_s, flags, values...], SI.

    extra_flow (n - 1, chambers) m3/s is added to the modelled side.  seen: the candidate was fitted
    to these samples, so that its own terms hold in every block, else in the valid ones alone.
    """
    sums = _hold(model, candidate, chunk, extra_flow)
    innovation = _innovation(model, candidate, chunk, extra_flow, sums)
    innovations = innovation
    if seen and candidate.fitted is not None:
        innovations = _hold(model, itself(candidate), chunk, extra_flow).innovation
    rows = _rows(model, sums, chunk)
    interval = np.clip(np.searchsorted(sums.t_s, rows.t_s) - 1, 0, len(sums.cell) - 1)
    return Comparison(
        candidate.name,
        rows.t_s,
        rows.measured,
        rows.modelled,
        sums.cell[interval],
        _shares(sums, candidate.status),
        _mean_squares(sums.innovation),
        rows.signals,
        Intervals(
            sums.t_s,
            sums.cell,
            innovation,
            innovations,
            chunk[:-1, 2 : 2 + len(model.signals)],
            _left_of_samples(model, sums, chunk),
        ),
    )


@dataclass(frozen=True)
class _Held:
    """Raw result of `kernels.explain`; see there."""

    t_s: FloatArray
    flow: FloatArray
    cell: IntArray
    innovation: FloatArray


def _hold(
    model: Machine, candidate: CandidateMap, chunk: FloatArray, extra_flow: FloatArray | None = None
) -> _Held:
    model, terms, chunk = with_extra_flow(model, candidate.terms, chunk, extra_flow)
    n, c = max(len(chunk) - 1, 0), len(model.chambers)
    flow, innovation = np.full((n, 2 * c), np.nan), np.full((n, c), np.nan)
    cell = np.full((n, len(model.edges)), -1, np.int64)
    state = build(model.with_taylor_maps, candidate.weights)
    state.engine[0]["term_theta"][: len(terms)] = terms
    theta, compliance = candidate.theta, candidate.compliance
    explain(state.engine, state.cells, theta, compliance, chunk, flow, cell, innovation)
    return _Held(np.ascontiguousarray(chunk[:, 0]), flow, cell, innovation)


@dataclass(frozen=True)
class _Rows:
    """Rows of H_f: instants (rows,), flows (rows, c) and signals (rows, m)."""

    t_s: FloatArray
    measured: FloatArray
    modelled: FloatArray
    signals: FloatArray


def _rows(model: Machine, sums: _Held, chunk: FloatArray | None = None) -> _Rows:
    """Row instants, measured and modelled flow through the project's filter, and the signals."""
    f, c = model.filter, len(model.chambers)
    rate = sums.flow
    if chunk is not None:
        values = chunk[:, 2 : 2 + len(model.signals)]
        means = 0.5 * (values[1:] + values[:-1])
        rate = np.hstack([_as_measured(model, sums, means), means])
    if len(sums.t_s) < 2:
        return _Rows(np.empty(0), *(np.empty((0, m)) for m in (c, c, len(model.signals))))
    span_s = sums.t_s[-1] - sums.t_s[0]
    out = np.empty((int(span_s * f.rows_per_s) + 2, 1 + rate.shape[1]))
    rows = filter_rows(sums.t_s, rate, f.wn_rad_s, f.zeta, 1.0 / f.rows_per_s, out)
    out = out[:rows]
    return _Rows(out[:, 0], out[:, 1 : 2 * c : 2], out[:, 2 : 2 * c + 1 : 2], out[:, 2 * c + 1 :])


def _as_measured(model: Machine, sums: _Held, means: FloatArray) -> FloatArray:
    """Flows (n - 1, 2 c) of a rate that is measured itself: as measured, and behind its lag.

    means (n - 1, signals): of the intervals.
    """
    if not model.measured or not len(sums.flow):
        return sums.flow
    y, left = means[:, [model.column(model.measured)]], sums.flow[:, :1] - sums.flow[:, 1:]
    step_s = float(np.median(np.diff(sums.t_s)))
    left = left_behind(left, step_s, model.chambers[0].behind_s)
    return np.hstack([np.where(np.isnan(left), np.nan, y), y - left])


def _left_of_samples(model: Machine, sums: _Held, chunk: FloatArray) -> FloatArray:
    """What is left of each sample (n - 1,) of a rate that is measured itself; empty of others."""
    if not model.measured:
        return np.empty(0)
    values = chunk[:, 2 : 2 + len(model.signals)]
    modelled = _as_measured(model, sums, 0.5 * (values[1:] + values[:-1]))[:, 1]
    return np.asarray(values[:-1, model.column(model.measured)] - modelled)


def _mean_squares(innovation: FloatArray) -> FloatArray:
    known = np.isfinite(innovation).all(axis=1)
    if not known.any():
        return np.full(innovation.shape[1], np.nan)
    return np.asarray(np.mean(innovation[known] ** 2, axis=0))


def _innovation(
    model: Machine,
    candidate: CandidateMap,
    chunk: FloatArray,
    extra_flow: FloatArray | None,
    sums: _Held,
) -> FloatArray:
    """Whitened innovations, begun anew wherever a flow does not stand on data.

    What an unknown flow has done to the volume would stay in them for seconds.
    """
    known = np.isin(candidate.status, (SHUT, VALID, REFERENCE))
    unsure = ((sums.cell >= 0) & ~known[sums.cell]).any(axis=1)
    unsure |= ~np.isfinite(sums.flow).all(axis=1)
    marked = chunk.copy()
    marked[1:, 1] += np.where(unsure & (chunk[1:, 1].astype(int) & GAP_FLAG == 0), GAP_FLAG, 0)
    return _hold(model, candidate, marked, extra_flow).innovation


def _shares(sums: _Held, status: NDArray[np.str_]) -> dict[str, float]:
    """Share of the time per status of the least certain open edge."""
    rank = np.array([CERTAINTY.index(word) for word in status])
    worst = np.where(sums.cell >= 0, rank[sums.cell], 0).max(axis=1, initial=0)
    worst[~np.isfinite(sums.flow).all(axis=1)] = CERTAINTY.index(OUTSIDE)
    dt = np.diff(sums.t_s)
    total = max(float(dt.sum()), 1e-12)
    return {word: float(dt[worst == k].sum()) / total for k, word in enumerate(CERTAINTY)}
