"""Fit one revision of the model to a record: maps, compliances, effects and timing together.

Timing parameters and the shapes of effects enter as their derivative columns and are moved until
nothing is left to move (`moving`); the declared lag of the spools is one of them, held by its
tolerance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtid.diagnose.bank import columns_of, pointing_out
from rtid.diagnose.commands import behind, commands, transformed
from rtid.diagnose.equations import regression_of, softened
from rtid.diagnose.evidence import Heading, Rows, project, rows_of
from rtid.diagnose.moving import (
    CLEAR,
    goes_on,
    halfway,
    is_as_good,
    is_lost,
    is_worse,
    moved,
    reweighed,
    steadied,
)
from rtid.diagnose.regression import Estimate, Regression
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import is_about_sizes
from rtid.diagnose.steepness import with_own_slopes
from rtid.effects.column import Candidate, Cause, Columns
from rtid.effects.law import Shape, Volumes
from rtid.effects.laws import cause_of
from rtid.effects.laws.response import behind_s
from rtid.effects.laws.timing import SUPPLY
from rtid.effects.page import Effect
from rtid.effects.record_view import LONG, MapTerms, RecordView
from rtid.estimator.factor import SHARED_PRIOR
from rtid.estimator.misfit import Misfit
from rtid.estimator.record import refined, summed
from rtid.estimator.solution import sketch
from rtid.estimator.state import Weights
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray, give_back

PASSES = 10  # of Gauss-Newton
HALVINGS = 2  # of one step, before it is given up
HOPELESS = 4  # passes in a row that leave the record less likely than it was
WHOLLY = 1e8  # information of a coefficient that is 1, the effect being what its shape says
RIDGE = 1e-9  # of the square of a timing's or a shape's column: more than rounding leaves
WEIGHED = 0.05  # share by which the compliances may differ that weigh the rows alike
MATCH_RHO = 1.10  # largest rho of a model that matches, of a record that is long enough
BAND_SD = 3.0  # standard deviations of rho that a record's own length gives it
LEAST_COMPLIANCE = 1e-11  # 1/Pa: of an oil of 100 GPa, that weighs as nothing
NO_COV = np.zeros((0, TERMS, TERMS))  # of maps whose covariance nobody asked for


@dataclass(frozen=True)
class Fit:
    """A fitted revision.

    declared: the machine as declared, and chunk the record; before: the map that gave the columns.
    The columns of the regression are
    y, theta_beta per chamber, timing parameters, shapes up to `first`, candidates, echoes.
    estimate: of all of them, which says where timings and shapes should move; held: with these
    where they are, to which `map` belongs and which everything else is judged by.
    shapes: (effect, nonlinear parameter) of each column of shapes.  rows: of the record, for
    another fit with the same commands and weights; large.  suspects: scored beside the catalogue.
    rest, known_cov: what the maps leave of the record, and `excuse.counted`, if somebody has asked
    before.
    spreads: (column, how far its size is from one number), where somebody has asked (`spread`);
    shifts: (column, what its size over the whole record is more than what the rows show of it).
    """

    declared: Machine
    chunk: FloatArray
    weights: Weights
    revision: Revision
    before: MapTerms
    columns: Columns
    regression: Regression
    estimate: Estimate
    held: Estimate
    map: MapTerms
    first: int
    shapes: tuple[tuple[int, int], ...] = ()
    rows: Rows | None = None
    suspects: tuple[Effect, ...] = ()
    rest: Misfit | None = None
    known_cov: FloatArray | None = None
    spreads: tuple[tuple[int, float], ...] = ()
    shifts: tuple[tuple[int, float], ...] = ()

    @cached_property
    def model(self) -> Machine:
        """The machine of the record as it reaches the spools."""
        return behind(self.declared, self.revision.timings)

    @cached_property
    def sent(self) -> FloatArray:
        """The record (n, 2 + signals), SI, with the commands as they reach the spools."""
        return transformed(
            self.declared, self.chunk, self.revision.timings, self.weights.compliance
        )

    @cached_property
    def view(self) -> RecordView:
        """The record beside the map that gave the columns."""
        return RecordView.of(self.model, self.sent, self.weights, self.before)

    @property
    def rho(self) -> float:
        """Residual variance in units of the sensors' noise."""
        return self.regression.rho(self.held)

    @property
    def excess(self) -> float:
        """chi2 beyond what the noise leaves of so many rows with so many unknowns, on average.

        A timing moves the working points to other blocks, which take along what their rows tell of
        them: a lag of 9.6 ms, where 1.1 and a delay of 20 were true, drew a joystick's steps
        through 160 more, and left 152 of chi2 less with 250 degrees of freedom less.
        """
        return self.held.sse - self.regression.dof

    @property
    def spread_of_rho(self) -> float:
        """How far from 1 so long a record lets rho be, in `BAND_SD` standard deviations."""
        return BAND_SD * float(np.sqrt(2.0 / max(1.0, self.regression.dof)))

    @property
    def most_rho(self) -> float:
        """The largest rho of a model that matches: of any record, and wider for a short one."""
        return max(MATCH_RHO, 1.0 + self.spread_of_rho)

    @property
    def freedom(self) -> float:
        """Degrees of freedom that are left to the rows."""
        return max(1.0, self.regression.dof - len(self.held.used))

    def wins_over(self, other: Fit) -> float:
        """How far -2 log likelihood falls from another fit of the same record to this one.

        Rows that are weighed for more noise leave a smaller chi2 whatever explains them: on clean
        sweeps a hose took 730 off chi2, and its pressure's noise had spread the rows by 815.  A lag
        behind the maps transforms what is measured, A y with A = 1 + tau d/dt: ln det of the noise
        rises by 2 ln det A, and so does the density of y, so that chi2 alone is left.
        Where one has rows that the other has not, ln det counts of those of the same time.
        """
        gain = other.excess - self.excess
        ours, theirs = self.regression, other.regression
        lags = {behind_s(fit.revision.timings) for fit in (self, other)}
        if len(lags) > 1:
            return gain
        if ours.rows == theirs.rows:
            return gain + theirs.log_noise - ours.log_noise
        if ours.weighed and theirs.weighed:
            gain += theirs.weighed.noisier_than(ours.weighed)
        return gain

    @cached_property
    def settled_chi2(self) -> float:
        """What it leaves of its rows, weighed for the noise of exactly what it has found.

        Beside the maps that it has found: a line of 1350 MPa, which rings with what passes a valve,
        took 185 off a leak's sweep beside the maps of the pass before, and 60 beside its own.
        A pressure that is measured has noise in what the chamber stores.  Were it free to be what
        it was, at every row, chi2 so weighed would be all that is left of the likelihood (Deming):
        its least is at the truth.  Compliances and sizes that are weighed a few per cent off are as
        much as noise in it; and ln det in its place rewards an oil for being stiff.
        """
        old, found = self.revision, np.maximum(np.abs(self.compliance), LEAST_COMPLIANCE)
        sizes = tuple((e, self.held.value(self.column(e))) for e in old.effects)
        weights, revision = replace(self.weights, compliance=found), replace(old, sizes=sizes)
        record = self.unfactored().declared, self.chunk, weights, revision, self.light()
        now = one_pass(*record, bank=False, thorough=False)
        theta = dict(zip(self.held.used, self.held.theta, strict=True))
        theta |= {1 + c: share for c, share in enumerate(self.compliance / found)}
        at = {self.column(e): now.column(e) for e in old.effects}
        columns = np.array([at.get(c, c) for c in theta])
        return now.regression.chi2(columns, np.array(list(theta.values())))

    @property
    def compliance(self) -> FloatArray:
        """1 / beta (chambers,), 1/Pa."""
        n_c = len(self.model.chambers)
        return np.asarray(self.held.theta[:n_c] * self.weights.compliance)

    @property
    def compliance_cov(self) -> FloatArray:
        """Covariance of the compliances (chambers, chambers), 1/Pa2, by the misfit that is left."""
        n_c, c0 = len(self.model.chambers), self.weights.compliance
        spread = max(1.0, self.rho) * np.outer(c0, c0)
        return np.asarray(self.held.cov[:n_c, :n_c] * spread)

    @property
    def lag_tolerance_s(self) -> float:
        """By how much the spools' lag is free, s; 0 where it is known, or another law is in it."""
        return 0.0 if self.revision.replaces_lag else self.declared.lag.tolerance_s

    @property
    def lag_sd_s(self) -> float:
        """Of the spools' lag, by the misfit that is left; NaN where the record does not tell it."""
        at = self.first_given
        if self.lag_tolerance_s == 0.0 or at not in self.estimate.used:
            return float("nan")
        return self.sd_on_its_way(at)

    def size_of(self, column: int) -> float:
        """A size over the whole record, SI."""
        return self.held.value(column) + dict(self.shifts).get(column, 0.0)

    def sd_of(self, column: int) -> float:
        """Of a size, by the misfit that is left and by how far it is from one number."""
        sd = self.estimate.sd(column) * float(np.sqrt(max(1.0, self.rho)))
        return float(np.hypot(sd, dict(self.spreads).get(column, 0.0)))

    def sd_on_its_way(self, column: int) -> float:
        """Of a lag or a timing, and how far it clearly points on from where it has ended."""
        sd, ahead = self.sd_of(column), abs(self.estimate.value(column))
        return float(np.hypot(sd, ahead)) if ahead > CLEAR * sd else sd

    @property
    def first_given(self) -> int:
        """Number of columns before the given ones: y and theta_beta."""
        return 1 + len(self.model.chambers)

    @property
    def own_rows(self) -> Rows:
        """Its rows, made again where they were let go."""
        given = self.model, self.sent, self.weights
        return self.rows or rows_of(*given, soft=softened(*given, self.revision))

    def light(self) -> Fit:
        """The same without the rows, and without what can be made again."""
        return replace(self, rows=None)

    def unfactored(self, always: bool = False) -> Fit:
        """The same, the factor of its rows let go: one with other rows is made beside it."""
        if self.rows is not None:
            self.rows.forget(always)
        return self

    def leaving(self, rest: Misfit) -> Fit:
        """The same, with what its maps leave of the record; a long one has no room to keep it."""
        if len(self.chunk) >= LONG:
            return self
        return self.knowing(rest=rest)

    def knowing(self, **more: Any) -> Fit:
        """The same with other fields, and with what was made of the record."""
        better = replace(self, **more)
        kept = {"model", "sent", "view"} & vars(self).keys()
        vars(better).update({name: vars(self)[name] for name in kept})
        return better

    def unread(self) -> Fit:
        """The same, what was read along its record let go: who asks for it again reads it anew."""
        vars(self).pop("view", None)
        return self

    def at_rest(self) -> Fit:
        """The same, let go of what a long record gives again when it is asked for."""
        if len(self.chunk) >= LONG:
            vars(self.unread()).pop("sent", None)
            give_back()
        return self

    def column(self, candidate: Candidate) -> int:
        """Column of a candidate."""
        return self.first + self.columns.candidates.index(candidate)

    def timing_columns(self, k: int) -> range:
        """Columns of the parameters of timing k."""
        lengths = [len(psi) for _, psi in self.revision.timings]
        at = self.first - len(self.shapes) - sum(lengths) + sum(lengths[:k])
        return range(at, at + lengths[k])

    def shape_columns(self, effect: Candidate) -> dict[int, int]:
        """Columns of an effect's nonlinear parameters that are free, by their number."""
        at = self.revision.effects.index(effect)
        columns = enumerate(self.shapes, self.first - len(self.shapes))
        return {k: j for j, (e, k) in columns if e == at and j in self.estimate.used}


def prepare(model: Machine, chunk: FloatArray) -> Weights:
    """Weights of the rows from a first estimate; chunk (n, 2 + signals), SI."""
    weights = refined(model, sketch(model, summed(model, chunk)), model.lag.nominal_s)
    return with_own_slopes(model, chunk, weights)


def fit(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    revision: Revision,
    start: Fit | None = None,
    bank: bool = True,
    suspects: tuple[Effect, ...] = (),
    other: Fit | None = None,
) -> Fit:
    """Fit a revision to chunk (n, 2 + signals), SI; start: the fit to begin with.

    bank: also make the columns of every candidate, to score them; suspects: effects of the user's
    beside those of the catalogue; other: the fit that it must win over, given up where it does not.
    """
    best = one_pass(model, chunk, weights, revision, start, False, thorough=False)
    step, halvings, behind, stretch, top = moved(best), 0, 0, 1.0, best.light()
    for _ in range(PASSES):
        if step is None or halvings > HALVINGS or behind == HOPELESS:
            break
        fitted = one_pass(model, chunk, step.weights, step.revision, best, False, thorough=False)
        if is_worse(fitted, best):
            step, halvings, stretch = halfway(best, step), halvings + 1, 1.0
        else:
            halvings, on = 0, goes_on(fitted, best)
            # as good on the other side of the least is no end: a lag stayed 45 us too long
            is_over = stretch > 1.0
            stretch = 2.0 * stretch if on else 1.0
            is_done = is_as_good(fitted, best) and not (on or is_over)
            is_at_end = is_done and is_about_sizes(fitted)
            step = None if is_at_end else steadied(moved(fitted, stretch), fitted, best)
            best = fitted
            top = best.light() if best.wins_over(top) > 0.0 else top
        behind = behind + 1 if other is not None and fitted.wins_over(other) < 0.0 else 0
        del fitted  # its rows are large
    if is_lost(best, top):
        best = one_pass(model, chunk, top.weights, top.revision, top, False, thorough=False)
    if not bank:
        return best
    return one_pass(model, chunk, best.weights, best.revision, best, bank, suspects=suspects)


def one_pass(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    revision: Revision,
    start: Fit | None,
    bank: bool,
    more: Iterable[tuple[Cause, Shape]] = (),
    thorough: bool = True,
    before: MapTerms | None = None,
    suspects: tuple[Effect, ...] = (),
    sent: FloatArray | None = None,
) -> Fit:
    """Fit with the timing parameters where they are; more: causes to add with other shapes.

    chunk (n, 2 + signals), SI: the record as declared.  start: the fit whose map gives the
    columns, or `before`, the map alone; sent: the record as it reaches the spools, where known.
    thorough = False: without the covariances of the maps.
    """
    if revision.replaces_lag:
        weights = replace(weights, lag_s=0.0)
    declared, sent = model, _sent(start, model, chunk, revision, weights) if sent is None else sent
    model = behind(declared, revision.timings)
    soft = softened(model, sent, weights, revision)
    known = _same_rows(start, sent, weights, soft)
    if known is None and start is not None:
        start.unfactored()
    rows = known or rows_of(model, sent, weights, soft=soft)
    before = start.map if start else before or _map_alone(model, rows)
    view = RecordView.of(model, sent, weights, before)
    view.rest()  # of what the rows took; nothing was read along it yet
    heading = Heading(rows)
    given = heading.add, commands(declared, chunk), weights, revision
    columns, n_timing, shapes = columns_of(view, *given, bank, more, suspects)
    first = 1 + len(model.chambers) + n_timing + len(shapes)
    view.rest()
    projected = heading.projected()
    regression = regression_of(model, weights, revision, projected, columns, rows)
    weak = slice(first - len(shapes) - sum(len(psi) for _, psi in revision.timings), first)
    regression.prior[weak] = RIDGE * regression.own[weak] + (regression.own[weak] == 0.0)
    at = [first + columns.candidates.index(e) for e in revision.effects]
    regression.prior[at] += regression.own[at] == 0.0  # what never acts here is held at nothing
    whole = [column for column, e in zip(at, revision.effects, strict=True) if e.is_whole]
    regression.prior[whole], regression.mean[whole] = WHOLLY, 1.0
    estimate = regression.fit((*range(1, first), *at))
    while out := pointing_out(view, revision, shapes, first - len(shapes), at, estimate):
        estimate = regression.fit(tuple(k for k in estimate.used if k not in out))
    fixed = regression.fit((*range(1, 1 + len(model.chambers)), *at))
    flowmap = MapTerms(rows.cells, projected.terms(list(fixed.used), fixed.theta), NO_COV)
    parts = chunk, weights, revision, before, columns, regression, estimate, fixed
    is_same = start is not None and known is not None and start.revision == revision
    rest = start.rest if start is not None and is_same else None
    fitted = Fit(declared, *parts, flowmap, first, shapes, rows, suspects, rest)
    vars(fitted).update(model=model, sent=sent)  # what is made when it is missing
    if bank or revision.effects:  # nobody else asks for what the map says along the record
        vars(fitted).update(view=view)
    return with_covariances(fitted) if thorough else fitted


def with_covariances(fitted: Fit, like: Fit | None = None) -> Fit:
    """A fit with the covariances of its maps.

    like: a fit whose covariances are taken where its rows are weighed alike and meet the same
    blocks: an effect more changes them by next to nothing.
    """
    if fitted.rows is None:
        return fitted
    cov = _covariances_of(like, fitted) if like is not None else None
    if cov is None:
        cov = fitted.rows.covariances
    better = replace(fitted, map=replace(fitted.map, cov=cov))
    vars(better).update(model=fitted.model, sent=fitted.sent, view=fitted.view)
    return better


def _covariances_of(like: Fit, fitted: Fit) -> FloatArray | None:
    """Those of another fit, in the order of this one's blocks; None where they are not the same."""
    known, cells = like.map, fitted.map.cells
    alike = like.revision.timings == fitted.revision.timings and np.allclose(
        like.weights.compliance, fitted.weights.compliance, rtol=WEIGHED, atol=0.0
    )
    if not alike or not len(known.cov) or not np.isin(cells, known.cells).all():
        return None
    order = np.argsort(known.cells)
    return np.asarray(known.cov[order[np.searchsorted(known.cells[order], cells)]])


def tried(model: Machine, chunk: FloatArray, weights: Weights, revision: Revision) -> Fit:
    """A revision fitted where it is, its rows weighed by what it finds; derivatives do the rest.

    chunk (n, 2 + signals), SI.
    """
    fitted = one_pass(model, chunk, weights, revision, None, False, thorough=False)
    better = reweighed(fitted)
    if better is not None:
        start, sent = fitted.light(), fitted.sent
        del fitted  # its rows are large, and weighed otherwise
        fitted = one_pass(model, chunk, better, revision, start, False, thorough=False, sent=sent)
    return fitted.light()


def _same_rows(
    start: Fit | None, sent: FloatArray, weights: Weights, soft: FloatArray
) -> Rows | None:
    """The rows of a fit, where they are those of this record with these weights."""
    if start is None or start.rows is None or start.weights.lag_s != weights.lag_s:
        return None
    known = start.weights
    pairs = (
        (known.slopes, weights.slopes),
        (known.compliance, weights.compliance),
        (known.missed, weights.missed),
        (start.rows.soft, soft),
        (start.sent, sent),
    )
    return start.rows if all(a is b or np.array_equal(a, b) for a, b in pairs) else None


def _sent(
    start: Fit | None,
    declared: Machine,
    chunk: FloatArray,
    revision: Revision,
    weights: Weights,
) -> FloatArray:
    """The record with the commands as they reach the spools; a fit's with the same timings.

    And with the same oil, where a supply must compress it.
    """
    is_same = start is not None and start.chunk is chunk and start.declared is declared
    if start is not None and is_same and start.revision.timings == revision.timings:
        compresses = any(timing.where == SUPPLY for timing, _ in revision.timings)
        known = start.weights.compliance
        if not compresses or np.array_equal(known, weights.compliance):
            return start.sent
    return transformed(declared, chunk, revision.timings, weights.compliance)


def with_rows_of(known: Fit, fitted: Fit) -> Fit:
    """A light fit with the rows of another one, where they are its own."""
    soft = softened(fitted.model, fitted.sent, fitted.weights, fitted.revision)
    rows = _same_rows(known, fitted.sent, fitted.weights, soft)
    return replace(fitted, rows=rows) if rows is not None and fitted.rows is None else fitted


def columns_of_effects(fitted: Fit) -> list[Volumes]:
    """Volumes per interval of the effects of a fit, for coefficients of 1."""
    return [cause_of(fitted.view, e).column(e.shape) for e in fitted.revision.effects]


def first_map(model: Machine, chunk: FloatArray, weights: Weights) -> MapTerms:
    """The maps fitted without any effect; chunk (n, 2 + signals), SI."""
    return _map_alone(model, rows_of(model, chunk, weights))


def _map_alone(model: Machine, rows: Rows) -> MapTerms:
    projected, n_c = project(rows, []), len(model.chambers)
    s = projected.schur
    theta = np.asarray(np.linalg.solve(s[1:, 1:] + SHARED_PRIOR * np.eye(n_c), s[1:, 0]))
    return MapTerms(rows.cells, projected.terms(list(range(1, 1 + n_c)), theta), NO_COV)
