"""The equation residual of a fitted revision on any record, beside what the sensors alone leave.

Everything passes the machine's filter H_f (10 Hz, damping 0.8, 50 rows per second unless another is
declared).  Intervals whose blocks the fit does not know are left out, and the filter settles anew
behind them; of the record that has taught the blocks none need be, since its fit is of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.diagnose.commands import transformed
from rtid.diagnose.fit import Fit
from rtid.diagnose.sensor_noise import noise_of
from rtid.diagnose.visited import where_taught
from rtid.effects.column import Candidate
from rtid.effects.laws import SEED, cause_of, total_softness
from rtid.effects.laws.response import behind_s, left_behind
from rtid.effects.record_view import RecordView
from rtid.estimator.state import variance
from rtid.kernels.explain import filter_rows
from rtid.plain import BoolArray, FloatArray

KNOWN = 4.0  # times what a valid block may be uncertain by: where the map is known worse, nothing
# is judged


@dataclass(frozen=True)
class Residual:
    """Filtered rows: t_s (rows,), measured, left and noise (rows, chambers) in m3/s.

    left: measured less modelled; noise: what simulated sensor noise gives on the same path;
    map_sd_m3s: root mean square, over all rows, of the deviations that the maps state there.
    """

    t_s: FloatArray
    measured: FloatArray
    left: FloatArray
    noise: FloatArray
    rows_per_s: float = 50.0
    map_sd_m3s: float = 0.0

    def at_rows_of(self, other: Residual) -> Residual:
        """The rows alone at whose instants another has one too, of the same record.

        Behind another lag a spool passes through other blocks, and other rows are judged: the rms
        of 173 of them had risen where 36,650 of 38,399 of chi2 had gone, by the 31 that were new.
        """
        mine, others = (np.round(rest.t_s * self.rows_per_s) for rest in (self, other))
        at = np.isin(mine, others)
        return replace(
            self, t_s=self.t_s[at], measured=self.measured[at], left=self.left[at],
            noise=self.noise[at],
        )  # fmt: skip

    @property
    def judged_s(self) -> float:
        """Length of what is judged: the map is known well enough there."""
        return len(self.t_s) / self.rows_per_s

    @property
    def rms_m3s(self) -> float:
        """Root mean square over rows and chambers of what is left; NaN without rows."""
        return _rms(self.left)

    @property
    def floor_m3s(self) -> float:
        """What the sensors' noise alone would leave."""
        return _rms(self.noise)

    @property
    def flow_m3s(self) -> float:
        """Root mean square of the measured chamber flows."""
        return _rms(self.measured)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def modelled(fit: Fit, view: RecordView, leave_out: Candidate | None = None) -> FloatArray:
    """Mean flow into each chamber per interval, storage taken off: (n - 1, chambers), m3/s."""
    flows = np.empty((view.n - 1, len(view.model.chambers)))
    for c, compliance in enumerate(fit.compliance):
        v, p = view.volume(c), view.pressure(c)
        stored = compliance * 0.5 * (v[1:] + v[:-1]) * np.diff(p) / view.dt_s
        flows[:, c] = view.chamber_flow(c) - stored
    for effect, value in effect_values(fit):
        if effect == leave_out:
            continue
        cause = cause_of(view, effect)
        for c, volume in cause.column(effect.shape).items():
            flows[:, c] += value * volume / view.dt_s
    return flows


def effect_values(fit: Fit) -> list[tuple[Candidate, float]]:
    """The effects of a revision and their coefficients, SI."""
    return [(e, fit.held.value(fit.column(e))) for e in fit.revision.effects]


def residual(
    fit: Fit,
    chunk: FloatArray,
    leave_out: Candidate | None = None,
    everywhere: bool = False,
    as_taught: bool = False,
) -> Residual:
    """Hold a fitted revision against a record, chunk (n, 2 + signals), SI, as recorded.

    leave_out: an effect whose flow is not counted.  everywhere: on the grid, however well the map
    is known there: of the record that has taught it.  as_taught: in those parts of blocks alone
    that have taught them (`visited`).
    """
    sent = transformed_like(fit, chunk)
    view = RecordView.of(fit.model, sent, fit.weights, fit.map, fit.view)
    flows = measured(view)
    rates = [
        seen_rates(view, flows),
        behind_lag(fit, view, flows - modelled(fit, view, leave_out)),
        behind_lag(fit, view, _noise(fit, view)),
    ]
    flow_sd = view.flow_sd()
    known = view.inside if everywhere else _is_known(view, flow_sd)
    known &= where_taught(view) if as_taught else True
    t_s, (moved, left, noise) = through_filter(view, rates, known)
    return Residual(
        t_s, moved, left, noise, fit.model.filter.rows_per_s, _of_maps(view, flow_sd[:, known])
    )


def seen_rates(view: RecordView, flows: FloatArray) -> FloatArray:
    """The measured flows (n - 1, chambers), m3/s, or a rate that is measured itself."""
    if not view.model.measured:
        return flows
    y = view.signal(view.model.measured)
    return 0.5 * (y[1:] + y[:-1])[:, None]


def behind_lag(fit: Fit, view: RecordView, rates: FloatArray) -> FloatArray:
    """Errors of the equation (n - 1, chambers), m3/s, as they are seen behind a fit's lag."""
    known = np.where(view.inside[:, None], rates, np.nan)
    return left_behind(known, view.step_s, behind_s(fit.revision.timings))


def measured(view: RecordView) -> FloatArray:
    """Flow into each chamber over each interval by the piston's motion (n - 1, chambers), m3/s."""
    speed = np.diff(view.x_m) / view.dt_s
    return np.stack([c.sign * c.area_m2 * speed for c in view.model.chambers], axis=1)


def is_known(view: RecordView) -> BoolArray:
    """True (n - 1,) where the open edges are on their grids and the map is known well."""
    return _is_known(view, view.flow_sd())


def _is_known(view: RecordView, flow_sd: FloatArray) -> BoolArray:
    worst = KNOWN * view.model.gates.max_sd_share
    return view.inside & (view.share_of_rated(flow_sd) <= worst)


def _of_maps(view: RecordView, flow_sd: FloatArray) -> float:
    """Root mean square over chambers of what edges' deviations (edges, n) sum up to, m3/s."""
    feeds = [[e.sign(c) != 0 for e in view.model.edges] for c in view.model.chambers]
    return _rms(np.sqrt(np.array(feeds, float) @ flow_sd**2))


def through_filter(
    view: RecordView, rates: list[FloatArray], known: BoolArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Instants (rows,) and rows (rows, chambers) of rates (n - 1, chambers) behind H_f.

    Instants in s, rates in m3/s.  known (n - 1,): where they are not left out.
    """
    by, lost = view.model.filter, ~known
    for rate in rates:
        lost |= np.isnan(rate).any(axis=1)
    period = 1.0 / by.rows_per_s
    most, t_s = int((view.t_s[-1] - view.t_s[0]) / period) + 2, view.t_s[:0]
    parts = list[FloatArray]()
    for rate in rates:  # one at a time: all beside one another are as large as the record
        out = np.empty((most, 1 + rate.shape[1]))
        masked = np.where(lost[:, None], np.nan, rate)
        n = filter_rows(view.t_s, masked, by.wn_rad_s, by.zeta, period, out)
        t_s = out[:n, 0]
        parts.append(out[:n, 1:])
    return t_s, parts


def transformed_like(fit: Fit, chunk: FloatArray) -> FloatArray:
    """A record with the commands as the timings of a fit let them reach the spools.

    chunk (n, 2 + signals), SI, as declared; result: of the split machine (see `transformed`).
    """
    return transformed(fit.declared, chunk, fit.revision.timings, fit.weights.compliance)


def _noise(fit: Fit, view: RecordView) -> FloatArray:
    """A sample of the noise of the residual before the filter (n - 1, chambers), m3/s."""
    rng, model = np.random.default_rng(SEED), view.model
    names = {model.position, *(c.pressure for c in model.chambers)}
    names |= {n for e in model.edges for n in (e.source, e.sink) if n}
    noise = {name: noise_of(view, name, rng) for name in sorted(names) if variance(model, name) > 0}
    still = np.zeros(view.n)
    softness = total_softness(view, effect_values(fit))
    result = np.empty((view.n - 1, len(model.chambers)))
    for c, chamber in enumerate(model.chambers):
        p, v = noise.get(chamber.pressure, still), view.volume(c)
        x_rate = np.diff(noise.get(model.position, still)) / view.dt_s
        result[:, c] = chamber.sign * chamber.area_m2 * x_rate
        result[:, c] += np.diff((fit.compliance[c] * v + softness[:, c]) * p) / view.dt_s
        slopes = []
        for i, edge in enumerate(model.edges):
            dp = noise.get(edge.source, still) - noise.get(edge.sink, still)
            slopes.append(view.slope_dp(i) * 0.5 * (dp[1:] + dp[:-1]))
        result[:, c] -= view.into_chamber(c, slopes)
    return result
