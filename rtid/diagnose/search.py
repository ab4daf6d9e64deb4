"""Find a timing parameter from afar: exact refits on a coarser map, then the fine one.

The cost of a wrong delay is not a parabola: far from the truth the fitted map is bent, and its
derivatives point nowhere.  So each timing is first tried at the values of its bank, and the best is
closed in on; half the blocks per axis, and a thinned record, are enough to tell which is best.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rtid.diagnose.commands import (
    Timings,
    commands,
    cut_off,
    slowed,
    split,
    through,
    transformed,
)
from rtid.diagnose.equations import softened
from rtid.diagnose.evidence import project, rows_of
from rtid.diagnose.fit import Fit, columns_of_effects, prepare
from rtid.diagnose.moving import counted_for
from rtid.diagnose.revision import Revision
from rtid.diagnose.thinned import Thinning
from rtid.effects.instants import Instants
from rtid.effects.law import Volumes
from rtid.effects.laws.timing import COMMAND, Psi, TimingLaw
from rtid.estimator.state import Weights
from rtid.model import Grid, Machine
from rtid.plain import FloatArray

ROW_S = 20e-3  # long rows are enough
SIMPLEX, DOWNHILL = 0.25, 80  # first size in logarithms of the parameters; refits
CLOSING, HALVING = 3, 5  # refits between the neighbours of the best of the bank; of a limit
FOUND = 0.02  # share of a parameter within which it is found well enough from afar
LESS_DAMPED = 0.65  # times the damping of the bank
DEEP = 3.0  # times what a fit leaves that a timing must cost for stronger ones to be none
RANK = 1e-12  # of products of columns of length 1, below which one is made of others
OFF = 0.05  # share of a bracket that a trial stays off its ends
# of what the lag of a fit and a timing beside the declared one have taken: each beside the other's
SHARED = ((0.25, 0.75), (0.5, 0.5), (0.75, 0.25), (1.0, 1.0))


def coarse(model: Machine) -> Machine:
    """The same machine with every second border of its maps."""
    edges = []
    for edge in model.edges:
        u, dp = (_thinned(b) for b in (edge.grid.u_v, edge.grid.dp_pa))
        edges.append(replace(edge, grid=Grid(u, dp)))
    return replace(model, edges=tuple(edges))


def _thinned(border: FloatArray) -> FloatArray:
    kept = border[::2]
    return kept if kept[-1] == border[-1] else np.append(kept, border[-1])


class Search:
    """Costs of revisions on the coarse map of one record, thinned out.

    The declared lag is applied before the thinning, as every timing is.  Applied to the thinned
    record, whose step is longer than most lags, it left more than a spool of second order that
    stands in its place: for a delay of 0.69 ms 14,293 beside 10,933, where it is now 11,260.
    """

    def __init__(self, model: Machine, chunk: FloatArray) -> None:
        self.thinning = Thinning.of(model, chunk)
        self.model = self.thinning.model(coarse(model))
        self.split = split(self.model)
        self.declared, self.chunk = model, chunk
        self.instants = Instants.of(chunk, model.gates.max_gap_s)
        self._given = commands(model, chunk).values()
        self.record = self.thinning.record(model, chunk)
        self._thin_instants = Instants.of(self.record, self.model.gates.max_gap_s)
        weights = prepare(self.model, self.record)
        self.lag_s, self.weights = weights.lag_s, replace(weights, lag_s=0.0)

    def beside(self, fit: Fit) -> Beside:
        """Costs beside a fit."""
        return Beside(self, fit)

    def sent(self, timings: Timings, lag_s: float) -> FloatArray:
        """The thinned record (n // m, 2 + signals), SI, of the split machine, its spools' lag in.

        lag_s: of those whose lag no timing replaces.
        The commands of the split machine stand behind its columns.
        """
        record = self.record
        if any(timing.where != COMMAND for timing, _ in timings):
            whole = transformed(self.declared, self.chunk, timings, self.weights.compliance)
            whole = whole[:, : self.chunk.shape[1]]
            record = self.thinning.record(self.declared, whole)
        lag_s = 0.0 if any(timing.replaces_lag for timing, _ in timings) else lag_s
        sent = [self._thinned(through(u, d, self.instants, timings), lag_s) for d, u in self._given]
        thin = np.column_stack([record, *sent])
        cut_off(thin, self._thin_instants)
        return thin

    def _thinned(self, command: FloatArray, lag_s: float) -> FloatArray:
        """A command (n,) behind a lag, as over the intervals (n // m,) of the thinned record."""
        return self.thinning.command(slowed(command, self.instants, lag_s))


class Beside:
    """The search beside one fit: what a timing more would lower the cost by.

    Timings are looked for beside the declared lag, and not beside that of the fit, which stands for
    a part of what is missing.  What it has gained by that a timing must gain first, to be any
    better: of a leak beside a lag of 0 that was declared each timing explained 240,000 of chi2, and
    at its end 18,000 less than nothing.

    Rows are lost beside those of the fit as it is, whatever was tried before: a delay of 60 ms had
    kept the working point on its grid for 40 of 1,492 more, beside which each later timing had lost
    its rows, and a spool, a hysteresis and a delay were named where there was a hysteresis.
    """

    def __init__(self, search: Search, fit: Fit) -> None:
        self.search, self.timings = search, fit.revision.timings
        thinned = search.thinning.over_intervals
        self.volumes: list[Volumes] = [
            {c: thinned(series) for c, series in volumes.items()}
            for volumes in columns_of_effects(fit)
        ]
        self._rows: int | None = None  # of the fit as it is, whose cost is the first
        self._known: dict[tuple[Timings, float], tuple[float, FloatArray]] = {}
        self.before = self.cost(())
        self.ahead, self.fitted_s = 0.0, fit.weights.lag_s
        if self.fitted_s != search.lag_s:
            self.ahead = max(0.0, self.before - self.cost((), self.fitted_s))

    def cost(self, more: Timings, lag_s: float | None = None) -> float:
        """chi2 with more timings beyond what is due (`Rows`); inf where they lose rows of the fit.

        lag_s: of the spools, s, where it is not the declared one.
        """
        return self._solved(more, lag_s)[0]

    def shared(self, timing: TimingLaw, psi: Psi, gain: float) -> tuple[Psi, float, float]:
        """A timing that is found beside the declared lag, a lag in s, and the gain with both.

        The best of those in which the timing and the lag of the fit share what each takes alone.
        """
        declared_s, strength = self.search.lag_s, timing.strength(psi)
        best = psi, declared_s, gain
        if not self.ahead or timing.replaces_lag:
            return best
        for of_lag, of_timing in SHARED:
            part = timing.at(of_timing * strength)
            lag_s = declared_s + of_lag * (self.fitted_s - declared_s)
            gain = self.before - self.cost(((timing, part),), lag_s)
            if gain > best[2]:
                best = part, lag_s, gain
        return best

    def weights(self, more: Timings, like: Weights, lag_s: float) -> Weights:
        """Those like others, with the lag and the compliances beside which more timings were found.

        A delay that is missing bends the modulus by more than rows may be weighed apart, and had
        the lag stand for a part of it: both at once left 447,893 of chi2 where nothing left 97,557.
        """
        theta, n_c = self._solved(more, lag_s)[1], len(self.search.model.chambers)
        like = replace(like, lag_s=lag_s)
        if not self.search.model.has_pressures or len(theta) < n_c:
            return like
        low, high = sorted(1.0 / bound for bound in self.search.model.beta_bounds_pa)
        compliance = theta[:n_c] * self.search.weights.compliance
        return replace(like, compliance=np.clip(compliance, low, high))

    def _solved(self, more: Timings, lag_s: float | None = None) -> tuple[float, FloatArray]:
        """The cost with more timings, and the coefficients of compliances and effects.

        Kept: a bank ends where the closing in begins, and both where the lag takes its share.
        """
        asked = more, self.search.lag_s if lag_s is None else lag_s
        if asked not in self._known:
            self._known[asked] = self._solved_anew(*asked)
        return self._known[asked]

    def _solved_anew(self, more: Timings, lag_s: float) -> tuple[float, FloatArray]:
        search, timings = self.search, (*self.timings, *more)
        weights = search.weights
        sent = search.sent(timings, lag_s)
        soft = softened(search.split, sent, weights, Revision((), timings))
        rows = rows_of(search.split, sent, weights, ROW_S, soft, search.thinning.m)
        self._rows = rows.n if self._rows is None else self._rows
        left_out = counted_for(1.0 - rows.n / max(1, self._rows), timings)
        if np.isinf(left_out):
            return float("inf"), np.zeros(0)
        chi2, theta = _least(project(rows, [rows.on_rows(v) for v in self.volumes]).schur)
        return (1.0 + left_out) * chi2 - rows.due, theta

    def gain(self, timing: TimingLaw, psi: Psi) -> float:
        """What a timing lowers the cost by."""
        return self.before - self.cost(((timing, psi),))

    def bank(self, timing: TimingLaw, hint: float = 0.0) -> dict[float, float]:
        """Gains by strength, from the slightest value of the bank on, or from a hint below it.

        They rise towards the truth and fall behind it: two falls in a row end it, or one far below
        all that is left to gain.  Where none has risen yet others say little: 1.6 ms of a delay of
        10 cost 1 % of chi2, and what was tried no further could be no rival of the spool that was
        named.  What stands in the place of a declared lag begins where there is none, which is far
        below it: that is no fall.
        """
        costs, falls = {0.0: 0.0}, 0
        instead = timing.replaces_lag and not timing.is_limit  # whose zero is no lag at all
        strengths = sorted(timing.strength(psi) for psi in timing.bank)
        if 0.0 < hint < strengths[0] and not timing.replaces_lag:
            strengths.insert(0, hint)
        for strength in strengths:
            costs[strength] = self.gain(timing, timing.at(strength))
            *_, second, third = costs.values()
            is_first = instead and len(costs) == 2
            falls = falls + 1 if third < second and not is_first else 0
            is_deep = not instead and third < -DEEP * max(self.before, 0.0)
            if is_deep or (falls == 2 and max(costs.values()) > 0.0):
                break
        return costs

    def damped(self, timing: TimingLaw, psi: Psi, gain: float) -> tuple[Psi, float]:
        """A spool of second order as damped as the bank's or less, as late on slow motion.

        With more it is a lag of first order by another name.
        """
        slower = [LESS_DAMPED * value for value in psi]
        trial = tuple(np.clip(slower, timing.low, timing.high).tolist())
        less = self.gain(timing, trial)
        return (trial, less) if less > gain else (psi, gain)

    def polished(
        self, timing: TimingLaw, bank: list[Psi], first: float = SIMPLEX, most: int = DOWNHILL
    ) -> Psi:
        """The best of a bank for a timing of several parameters, and from there downhill.

        Where parameters bend each other, a simplex finds the way that derivatives miss.
        first: its size, in logarithms; most: refits.
        """

        def cost(logs: FloatArray) -> float:
            psi = tuple(np.clip(np.exp(logs), timing.low, timing.high))
            return self.cost(((timing, psi),))

        starts = [np.log(np.array(psi)) for psi in bank]
        start = min(starts, key=cost)
        simplex = np.vstack([start, start + first * np.eye(len(start))])
        options: Any = {"maxfev": most, "initial_simplex": simplex}
        from scipy.optimize import minimize  # noqa: PLC0415 - takes long to import

        minimum = minimize(cost, start, method="Nelder-Mead", options=options)
        return tuple(float(v) for v in np.clip(np.exp(minimum.x), timing.low, timing.high))

    def closed_in(self, timing: TimingLaw, bank: dict[float, float]) -> tuple[Psi, float]:
        """The parameters of the largest gain, by parabolas about the best of a bank.

        Of a limit by halves, as long as the next stronger one costs: 500 %/s took 96,900 of 98,500,
        743 %/s 10,700, and 300 %/s left 40 times as much, so that a parabola went the other way.
        """
        known = dict(bank)
        for _ in range(HALVING if timing.is_limit else CLOSING):
            at = sorted(known)
            k = at.index(max(at[1:], key=lambda x: known[x]))
            if k + 1 == len(at):
                trial = 2.0 * at[k]
            elif timing.is_limit and known[at[k + 1]] < 0.0:
                trial = 0.5 * (at[k] + at[k + 1])
            else:
                low, middle, high = at[k - 1 : k + 2]
                trial = _vertex((low, middle, high), [known[x] for x in (low, middle, high)])
            if abs(trial - at[k]) < FOUND * at[k]:
                break
            known[trial] = self.gain(timing, timing.at(trial))
        best = max(list(known)[1:], key=lambda x: known[x])
        return timing.at(best), known[best]


def _least(schur: FloatArray) -> tuple[float, FloatArray]:
    """What the columns leave of y, and their coefficients; schur: of [y | columns].

    In each column's own unit: beside the 1e14 of a leak per m3/s/Pa the compliances were below any
    tolerance, and fell out of all that was looked for beside it: 22,000,000 were left for 31,000.
    """
    scale = np.sqrt(np.maximum(np.diag(schur), 0.0))
    scale[scale == 0.0] = 1.0
    s = schur / np.outer(scale, scale)
    theta = np.linalg.lstsq(s[1:, 1:], s[1:, 0], rcond=RANK)[0]
    return float(schur[0, 0] * (1.0 - s[0, 1:] @ theta)), scale[0] * theta / scale[1:]


def _vertex(at: tuple[float, float, float], gain: list[float]) -> float:
    """Where a parabola through three points is highest, a little off the outer ones.

    Halfway to the better of these where there is no hill, and where one of them has lost so many
    rows that its gain is -inf.
    """
    (low, middle, high), (a, b, c) = at, gain
    left, right = (b - a) / (middle - low), (c - b) / (high - middle)
    if left <= right or not np.isfinite(left - right):
        return 0.5 * (low + middle) if a > c else 0.5 * (middle + high)
    top = 0.5 * (low + middle) + 0.5 * (high - low) * left / (left - right)
    margin = OFF * (high - low)
    return float(np.clip(top, low + margin, high - margin))
