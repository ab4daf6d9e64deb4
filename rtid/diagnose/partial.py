"""What a model leaves over the regressor of one effect: the points of an added-variable plot.

With C the effect's coefficient, x its column and y the record, each of them less what the maps,
the compliances and the other effects follow of it,

    y = C x + e:

over x the points of y lie on a line through zero of slope C.  e is what the model with the effect
leaves, and its points lie level.  Both pass the filter H_f, which changes nothing of the equation.
A timing has no column that is linear in it: x is what it changes of the flows, to first order, and
C = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.compare.dependence import Dependence, binned, inflation_of
from rtid.diagnose.bank import opening_change
from rtid.diagnose.commands import commands, slowed, through
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.evidence import Projected, Rows, project
from rtid.diagnose.fit import NO_COV, Fit
from rtid.diagnose.residual import (
    behind_lag,
    effect_values,
    is_known,
    measured,
    modelled,
    through_filter,
)
from rtid.diagnose.sized import physical
from rtid.effects.column import Candidate
from rtid.effects.law import Volumes
from rtid.effects.laws import cause_of
from rtid.effects.laws.common import supply_change
from rtid.effects.laws.pump import demand
from rtid.effects.laws.sensors import late
from rtid.effects.laws.timing import SUPPLY
from rtid.effects.record_view import MapTerms, RecordView
from rtid.plain import FloatArray, Key
from rtid.units import Z95

BINS = 14
SHARE = "share"  # what the coefficient of a timing is called


@dataclass(frozen=True)
class Rise:
    """Bins of what is left, m3/s, over the bins of a regressor; the slope of all its rows.

    slope, sd: in the unit of the effect's parameter.
    """

    bins: Dependence
    slope: float
    sd: float


@dataclass(frozen=True)
class AddedVariable:
    """One effect's column beside a model without the effect that was named, and with it.

    unit: of its parameter, SI; x is in m3/s per that unit.  rows: that stand behind the bins.
    """

    key: Key
    parameter: str
    unit: str
    before: Rise
    after: Rise

    @property
    def rows(self) -> int:
        """Rows of all chambers that the effect acts on."""
        return int(self.before.bins.rows.sum())


@dataclass(frozen=True)
class Exhibit:
    """The evidence for a named effect: over its own regressor, and over that of its best rival.

    coefficient, sd: of the named effect as the diagnosis fitted it; instead, instead_sd: what it
    would still be with the rival in its place (NaN without a rival).  alike: names of what the
    record cannot tell from it.  whole, whole_sd: its size over the whole record, where the rows
    show another one (`spread`); else NaN.
    """

    named: AddedVariable
    rival: AddedVariable | None
    coefficient: float
    sd: float
    instead: float = float("nan")
    instead_sd: float = float("nan")
    alike: tuple[str, ...] = ()
    whole: float = float("nan")
    whole_sd: float = float("nan")


def exhibits(result: Result) -> tuple[Exhibit, ...]:
    """The evidence for every effect that a diagnosis has found, in their order."""
    if not result.found:
        return ()
    bench = _Bench.of(result)
    return tuple(_exhibit(bench, f.key, f.alike) for f in result.found)


def _exhibit(bench: _Bench, key: Key, alike: tuple[Key, ...]) -> Exhibit:
    whole, whole_sd = bench.over_the_record(key)
    names = tuple(effect for effect, _ in alike)
    return replace(bench.exhibit(key, alike), alike=names, whole=whole, whole_sd=whole_sd)


@dataclass(frozen=True)
class _Bench:
    """The last fit with its rows; effects: those that it has, timings as what they change."""

    fit: Fit
    rows: Rows
    effects: dict[Key, tuple[Candidate, Volumes]]

    @classmethod
    def of(cls, result: Result) -> _Bench:
        fit, rows = result.last, result.last.own_rows
        effects = {e.key: (e, cause_of(fit.view, e).column(e.shape)) for e in fit.revision.effects}
        for k, (timing, _) in enumerate(fit.revision.timings):
            where = fit.view.supply_name if timing.where == SUPPLY else timing.where
            key = timing.effect, where
            effects[key] = Candidate(*key, SHARE, "1", 1.0), _changed(fit, k)
        return cls(fit, rows, effects)

    def exhibit(self, key: Key, alike: tuple[Key, ...]) -> Exhibit:
        """The evidence for one effect of the fit, beside the best of its rivals."""
        candidate, volumes = self.effects[key]
        named = self._added(candidate, volumes, key)
        value, sd = named.before.slope, named.before.sd
        if candidate in self.fit.revision.effects:
            value, sd = self._coefficient(candidate, self._used_without(candidate))
        rival = self._rival(candidate, alike)
        if rival is None:
            return Exhibit(named, None, value, sd)
        beside = self._added(rival, cause_of(self.fit.view, rival).column(rival.shape), key)
        used = (*self._used_without(candidate), self.fit.column(rival))
        return Exhibit(named, beside, value, sd, *self._coefficient(candidate, used))

    def over_the_record(self, key: Key) -> tuple[float, float]:
        """The size of an effect over the whole record, and its deviation; NaN where it is no other.

        Both in its unit.
        """
        candidate = self.effects[key][0]
        if candidate not in self.fit.revision.effects:
            return float("nan"), float("nan")
        value, sd = self._coefficient(candidate, self._used_without(candidate))
        at, scale = self.fit.column(candidate), physical(self.fit, candidate, 1.0)
        whole, whole_sd = scale * self.fit.size_of(at), abs(scale) * self.fit.sd_of(at)
        is_other = abs(whole - value) > Z95 * np.hypot(sd, whole_sd)
        return (whole, whole_sd) if is_other else (float("nan"), float("nan"))

    def _used_without(self, candidate: Candidate) -> tuple[int, ...]:
        """Columns of the regression that stand beside an effect."""
        others = [e for e in self.fit.revision.effects if e != candidate]
        shared = range(1, self.fit.first_given)
        return (*shared, *(self.fit.column(e) for e in others))

    def _coefficient(self, candidate: Candidate, used: tuple[int, ...]) -> tuple[float, float]:
        """Coefficient of an effect beside columns, and its standard deviation by what is left."""
        if candidate not in self.fit.revision.effects:
            return float("nan"), float("nan")
        score = self.fit.regression.score(used, self.fit.column(candidate))
        spread = float(np.sqrt(max(1.0, self.fit.rho)))
        value, sd = (physical(self.fit, candidate, v) for v in (score.value, score.sd))
        return value, sd * spread

    def _rival(self, named: Candidate, alike: tuple[Key, ...]) -> Candidate | None:
        """What would explain most in its place; of those that are not told apart, the first."""
        used, best, most = self._used_without(named), None, 0.0
        for candidate in self.fit.columns.candidates:
            if candidate.key in self.effects or candidate.parameter == SHARE:
                continue
            if alike and candidate.key != alike[0]:
                continue
            score = self.fit.regression.score(used, self.fit.column(candidate))
            is_possible = candidate.is_possible(physical(self.fit, candidate, score.value))
            if is_possible and score.gain > most:
                best, most = candidate, score.gain
        return best

    def _added(self, candidate: Candidate, volumes: Volumes, named: Key) -> AddedVariable:
        """A column beside the model without the named effect, and beside the one with it."""
        others = {key: v for key, (_, v) in self.effects.items() if key != named}
        whole = others if candidate.key == named else others | {named: self.effects[named][1]}
        scale = physical(self.fit, candidate, 1.0)
        view = RecordView.of(self.fit.model, self.fit.sent, self.fit.weights, self.fit.map)
        x = [
            behind_lag(self.fit, view, self._left_of(volumes, list(v.values())) / scale)
            for v in (others, whole)
        ]
        after = measured(view) - modelled(self.fit, view)
        before = after + self._given(named) * self._left_of(
            self.effects[named][1], list(others.values())
        )
        rates = [behind_lag(self.fit, view, rate) for rate in (before, after)]
        _, parts = through_filter(view, [*rates, *x], is_known(view))
        acting = [c for c, v in volumes.items() if np.any(v != 0.0)]
        rest = [part.T[acting].ravel() for part in parts]
        name = f"{candidate.effect}:{candidate.where}"
        unit = self.fit.declared.unit_here(candidate.unit)
        return AddedVariable(
            candidate.key,
            candidate.parameter,
            unit,
            *(_trend(name, unit, y, r) for y, r in zip(rest[:2], rest[2:], strict=True)),
        )

    def _given(self, key: Key) -> float:
        """Coefficient with which an effect is part of the fit."""
        return next((v for e, v in effect_values(self.fit) if e.key == key), 1.0)

    def _left_of(self, volumes: Volumes, others: list[Volumes]) -> FloatArray:
        """A column, m3/s per unit (n - 1, chambers), less what everything else follows of it."""
        shared = self.fit.first_given
        given = [volumes, *others]
        projected = project(self.rows, [self.rows.on_rows(g) for g in given])
        used = [*range(1, shared), *range(shared + 1, shared + len(given))]
        theta = _followed(projected, used, shared, self.fit.regression.prior[1:shared])
        terms = projected.terms(used, theta, shared)
        view = self.fit.view
        flows = RecordView.of(
            self.fit.model, self.fit.sent, self.fit.weights,
            MapTerms(self.rows.cells, terms, NO_COV),
        )  # fmt: skip
        rest = np.zeros((view.n - 1, len(self.fit.model.chambers)))
        for volume, share in zip(given, [1.0, *-theta[shared - 1 :]], strict=True):
            for c, series in volume.items():
                rest[:, c] += share * series / view.dt_s
        for c, share in enumerate(theta[: shared - 1]):
            v, p = view.volume(c), view.pressure(c)
            stored = self.fit.weights.compliance[c] * 0.5 * (v[1:] + v[:-1]) * np.diff(p)
            rest[:, c] += share * stored / view.dt_s - flows.chamber_flow(c)
        return rest


def _followed(projected: Projected, used: list[int], column: int, prior: FloatArray) -> FloatArray:
    """Coefficients of the columns used by which they follow another one best."""
    gram = projected.schur[np.ix_(used, used)].copy()
    gram[np.diag_indices(len(prior))] += prior
    return np.asarray(np.linalg.solve(gram, projected.schur[used, column]))


def _changed(fit: Fit, k: int) -> Volumes:
    """What a timing of the fit changes of the flows, to first order, per interval."""
    timing, psi = fit.revision.timings[k]
    view, timings = fit.view, fit.revision.timings
    if timing.where == SUPPLY:
        return supply_change(view, -timing.apply(demand(view), view.step_s, psi))
    if timing.of_sensor:
        return {c: psi[0] * series for c, series in late(view, timing, psi).items()}
    others = timings[:k] + timings[k + 1 :]
    change = {}
    for name, (direction, u) in commands(fit.declared, fit.chunk).items():
        without = through(u, direction, view.instants, others)
        if timing.replaces_lag:
            without = slowed(without, view.instants, fit.declared.lag.nominal_s)
        change[name] = through(u, direction, view.instants, timings) - without
    return opening_change(view, change)


def _trend(name: str, unit: str, y: FloatArray, x: FloatArray) -> Rise:
    """Bins and slope of y over x, both (rows,), through zero."""
    square = float(x @ x) or 1.0
    slope = float(x @ y) / square
    pull = x * (y - slope * x)
    sd = float(np.sqrt(inflation_of(pull) * (pull @ pull))) / square
    return Rise(binned(name, unit, x, y[:, None], BINS), slope, sd)
