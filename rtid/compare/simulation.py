"""Simulated pressure beside the measured one: free run, and k steps ahead.

The pressure equation (14) is integrated from a measured start with the candidate's map; command,
position (smoothed), supply and tank are inputs (`kernels.free_run`).  A free run starts once, k
steps ahead means a new start from the measurement every k steps.  How well it does is the fit,

    fit = 100 (1 - |y - yhat| / |y - mean y|) per cent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.compare.candidate import CandidateMap
from rtid.compare.motion import smooth_position
from rtid.effects.extra import with_extra_flow
from rtid.errors import RtidError
from rtid.estimator.state import build
from rtid.estimator.windows import OVERLAP
from rtid.kernels.free_run import BEYOND, INSIDE, STATUSES, free_run
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, IntArray

FREE_RUN = "free run"
HORIZONS_S = {FREE_RUN: np.inf, "1 s ahead": 1.0, "0.1 s ahead": 0.1}
REASONS = {
    "gap": "gap in the trace, or a refused sample",
    "off_grid": "command off the grid of an open edge",
    "ran_away": "the simulated pressure ran away",
}


class NoFreeRunError(RtidError):
    """The model has a chamber without a pressure equation."""


@dataclass(frozen=True)
class Simulation:
    """Pressures of c chambers as the model predicts them, n samples.

    period_s: a new start from the measurement so often, inf for the free run.  simulated_pa (n, c):
    NaN at samples where a run was stopped; status (n,): codes of `kernels.free_run`.
    """

    name: str
    period_s: float
    t_s: FloatArray
    measured_pa: FloatArray
    simulated_pa: FloatArray
    status: IntArray

    @property
    def predicted(self) -> BoolArray:
        """Samples (n,) that were predicted: neither a start nor a stop."""
        return np.asarray((self.status == INSIDE) | (self.status == BEYOND))

    @property
    def error_pa(self) -> FloatArray:
        """Measured minus simulated (n, c); NaN where nothing was predicted."""
        error = self.measured_pa - self.simulated_pa
        return np.asarray(np.where(self.predicted[:, None], error, np.nan))

    @property
    def rms_pa(self) -> FloatArray:
        """Root mean square of the error (c,); NaN where nothing was predicted."""
        error = self.error_pa[self.predicted]
        return np.sqrt(np.mean(error**2, axis=0)) if len(error) else self._nothing

    @property
    def fit_percent(self) -> FloatArray:
        """NRMSE fit (c,): 100 is perfect, 0 as good as the mean of the measurement."""
        y, error = self.measured_pa[self.predicted], self.error_pa[self.predicted]
        if not len(y):
            return self._nothing
        spread = np.sqrt(((y - y.mean(axis=0)) ** 2).sum(axis=0))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(100.0 * (1.0 - np.sqrt((error**2).sum(axis=0)) / spread))

    @property
    def stops(self) -> dict[str, int]:
        """How often a run was stopped and began anew, by reason; nothing is left out silently."""
        count = np.bincount(self.status, minlength=len(STATUSES))
        return {name: int(count[k]) for k, name in enumerate(STATUSES) if k > BEYOND}

    @property
    def beyond_share(self) -> float:
        """Share of the predicted samples in which a pressure drop was beyond its grid."""
        predicted = int(self.predicted.sum())
        return float((self.status == BEYOND).sum() / predicted) if predicted else 0.0

    @property
    def _nothing(self) -> FloatArray:
        return np.full(self.measured_pa.shape[1], np.nan)


def why_no_free_run(model: Machine) -> str:
    """The reason why the model cannot run on its own pressures, empty where it can."""
    without = [chamber.name for chamber in model.chambers if not chamber.pressure]
    return f"chamber {', '.join(without)} has no pressure" if without else ""


def simulate(
    model: Machine,
    candidate: CandidateMap,
    chunk: FloatArray,
    name: str = FREE_RUN,
    period_s: float | None = None,
    position_m: FloatArray | None = None,
    extra_flow: FloatArray | None = None,
) -> Simulation:
    """Pressures that the candidate predicts for samples chunk (n, 2 + signals).

    period_s: by the name if not given (`HORIZONS_S`).  position_m (n,): smooth position, made from
    the measured one if not given.  extra_flow (n - 1, chambers) m3/s is added to the right-hand
    side.  Raises NoFreeRunError, ExtraFlowError.
    """
    if reason := why_no_free_run(model):
        raise NoFreeRunError(f"no free run: {reason}", "the equation residual is all there is")
    period_s = HORIZONS_S[name] if period_s is None else period_s
    x = smooth_position(model, chunk) if position_m is None else position_m
    larger, terms, samples = with_extra_flow(model, candidate.terms, chunk, extra_flow)
    state = build(larger.with_taylor_maps, candidate.weights)
    state.engine[0]["term_theta"][: len(terms)] = terms
    simulated, status = np.empty((len(chunk), len(model.chambers))), np.zeros(len(chunk), np.int64)
    theta, compliance = candidate.theta, candidate.compliance
    samples, engine = np.ascontiguousarray(samples), state.engine
    free_run(engine, theta, compliance, OVERLAP, samples, x, period_s, simulated, status)
    columns = [2 + model.column(chamber.pressure) for chamber in model.chambers]
    return Simulation(name, period_s, chunk[:, 0], chunk[:, columns], simulated, status)
