"""Fit one revision of the model to a record: maps, compliances, effects and timing together.

Timing parameters and the shapes of effects enter as their derivative columns and are moved until
nothing is left to move (Gauss-Newton); the declared lag of the spools is one of them, held by its
tolerance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.diagnose.candidates import Candidate, Cause, Columns, Shape, Volumes
from rtid.diagnose.causes import add_echoes, causes, softness
from rtid.diagnose.evidence import Projected, collect, project
from rtid.diagnose.regression import Estimate, Regression
from rtid.diagnose.timing import TIMINGS, Psi, Timing
from rtid.diagnose.timing import lagged as lagged_command
from rtid.diagnose.view import FlowMap, View
from rtid.estimator.factor import SHARED_PRIOR
from rtid.estimator.record import refined, run
from rtid.estimator.solution import sketch
from rtid.estimator.state import Weights, variance
from rtid.kernels.layout import TERMS
from rtid.model import FloatArray, Model

PASSES = 5  # of Gauss-Newton
SIZED = 0.05  # share by which compliances and sizes of effects may still change: they weigh
SETTLED = 0.2  # of a standard deviation: a step as short ends it
REACH = 0.6  # of a timing parameter: the longest step
SHAPE_REACH = 0.5  # the same of an effect's nonlinear parameter, in steps of its axis
LAG_STEP_S = 5e-5
RIDGE = 1e-9  # of the square of a shape's column: more than rounding leaves
HELD = 1e30  # information of a parameter that is held

IntArray = NDArray[np.int64]
Timings = tuple[tuple[Timing, Psi], ...]


@dataclass(frozen=True)
class Revision:
    """What was added to a model: effects with their shapes, timings with their parameters.

    sizes: coefficients of the effects as fitted last, which weigh the rows.
    """

    effects: tuple[Candidate, ...] = ()
    timings: Timings = ()
    sizes: tuple[tuple[Candidate, float], ...] = ()

    @property
    def replaces_lag(self) -> bool:
        """True where a timing stands for the declared lag of the spools."""
        return any(timing.replaces_lag for timing, _ in self.timings)

    def has(self, key: tuple[str, str]) -> bool:
        """True where a cause is part of it."""
        names = [t.effect for t, _ in self.timings]
        return key in [e.key for e in self.effects] or key[0] in names


@dataclass(frozen=True)
class Fit:
    """A fitted revision.

    declared: the machine as declared; model: the same with split commands; sent: the record with
    the commands as they reach the spools.  The columns of the regression are
    y, theta_beta per chamber, timing parameters, shapes up to `first`, candidates, echoes.
    shapes: (effect, nonlinear parameter) of each column of shapes.
    """

    declared: Model
    model: Model
    sent: FloatArray
    weights: Weights
    revision: Revision
    view: View
    columns: Columns
    projected: Projected
    regression: Regression
    estimate: Estimate
    map: FlowMap
    first: int
    shapes: tuple[tuple[int, int], ...] = ()

    @property
    def rho(self) -> float:
        """Residual variance in units of the sensors' noise."""
        return self.regression.rho(self.estimate)

    @property
    def compliance(self) -> FloatArray:
        """1 / beta per chamber, 1/Pa."""
        n_c = len(self.model.chambers)
        return np.asarray(self.estimate.theta[:n_c] * self.weights.compliance)

    @property
    def first_given(self) -> int:
        """Number of columns before the given ones: y and theta_beta."""
        return 1 + len(self.model.chambers)

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
        first = self.first - len(self.shapes)
        return {k: first + j for j, (e, k) in enumerate(self.shapes) if e == at}


def prepare(model: Model, chunk: FloatArray) -> Weights:
    """Weights of the rows from a first estimate."""
    return refined(model, sketch(model, run(model, chunk)), model.lag.nominal_s)


def fit(
    model: Model,
    chunk: FloatArray,
    weights: Weights,
    revision: Revision,
    start: FlowMap | None = None,
    bank: bool = True,
) -> Fit:
    """Fit a revision to chunk (n, 2 + signals); start: the map to begin with.

    bank: also make the columns of every candidate, to score them.
    """
    for _ in range(PASSES):
        found = one_pass(model, chunk, weights, revision, start, bank=False, thorough=False)
        start = found.map
        moved = _moved(found)
        if moved is None:
            break
        revision, weights = moved
    return one_pass(model, chunk, weights, revision, start, bank) if bank else found


def one_pass(
    model: Model,
    chunk: FloatArray,
    weights: Weights,
    revision: Revision,
    start: FlowMap | None,
    bank: bool,
    more: Iterable[tuple[Cause, Shape]] = (),
    thorough: bool = True,
) -> Fit:
    """Fit with the timing parameters where they are; more: causes to add with other shapes.

    thorough = False: SSE and coefficients alone.
    """
    before = commands(model, chunk)
    if revision.replaces_lag:
        weights = replace(weights, lag_s=0.0)
    declared, sent = model, transformed(model, chunk, revision.timings)
    model = split(declared)
    start = start or first_map(model, sent, weights)
    view = View.of(model, sent, weights, start)
    columns = Columns(len(chunk), len(model.chambers))
    n_timing = _add_timing(view, columns, before, weights, revision)
    shapes = tuple(_add_shapes(view, columns, revision))
    _offer(view, columns, revision, bank, more)
    add_echoes(view, columns, n_timing + len(shapes))
    evidence = collect(model, sent, weights, columns.given(), soft=softened(view, revision.sizes))
    projected = project(evidence, thorough)
    n_c = len(model.chambers)
    regression = _regression(
        model, weights, revision, projected, columns, evidence.squares(), evidence.rows
    )
    first = 1 + n_c + n_timing + len(shapes)
    weak = slice(first - len(shapes), first)
    regression.prior[weak] = RIDGE * regression.own[weak]
    at = [first + columns.candidates.index(e) for e in revision.effects]
    estimate = regression.fit((*range(1, first), *at))
    found = FlowMap(evidence.cells, _terms(projected, estimate), projected.cov)
    parts = sent, weights, revision, view, columns, projected, regression, estimate
    return Fit(declared, model, *parts, found, first, shapes)


def softened(view: View, sizes: tuple[tuple[Candidate, float], ...]) -> FloatArray:
    """What storage effects add to the white variance of each row's equation (n, chambers), m6.

    The noise of a pressure moves what is stored: sd_P times V / beta and the effects' own share.
    """
    more = np.zeros((view.n, len(view.model.chambers)))
    for c, chamber in enumerate(view.model.chambers):
        own = sum((size * softness(view, c, e) for e, size in sizes), np.zeros(view.n))
        if own.any():
            plain = view.volume(c) * view.compliance[c]
            noise = variance(view.model, chamber.pressure) * view.model.pressure_share
            more[:, c] = ((plain + own) ** 2 - plain**2) * noise
    return more


def split(model: Model) -> Model:
    """The same machine with a command of its own for either direction of every command."""
    signals, edges = list(model.signals), []
    for name in sorted({edge.command for edge in model.edges}):
        signal = model.signals[model.column(name)]
        signals += [replace(signal, name=_half(name, d)) for d in (1, -1)]
    for edge in model.edges:
        edges.append(replace(edge, command=_half(edge.command, edge.direction)))
    return replace(model, signals=tuple(signals), edges=tuple(edges))


def _half(name: str, direction: int) -> str:
    return name + ("+" if direction > 0 else "-")


def commands(model: Model, chunk: FloatArray) -> dict[str, tuple[int, FloatArray]]:
    """Direction and command (n,) as sent, by the names of the split machine."""
    found: dict[str, tuple[int, FloatArray]] = {}
    for name in sorted({edge.command for edge in model.edges}):
        u = chunk[:, 2 + model.column(name)]
        found |= {_half(name, d): (d, u) for d in (1, -1)}
    return found


def transformed(model: Model, chunk: FloatArray, timings: Timings) -> FloatArray:
    """The record of the split machine: commands as the timings let them reach the spools."""
    dt_s = float(np.median(np.diff(chunk[:, 0])))
    sent = [_through(u, d, dt_s, timings) for d, u in commands(model, chunk).values()]
    return np.column_stack([chunk, *sent])


def _through(u: FloatArray, direction: int, dt_s: float, timings: Timings) -> FloatArray:
    for timing, psi in timings:
        u = timing.on(u, direction, dt_s, psi)
    return u


def first_map(model: Model, chunk: FloatArray, weights: Weights) -> FlowMap:
    """The maps fitted without any effect."""
    evidence = collect(model, chunk, weights, Columns(len(chunk), len(model.chambers)).given())
    projected, n_c = project(evidence, thorough=False), len(model.chambers)
    s = projected.schur
    theta = np.asarray(np.linalg.solve(s[1:, 1:] + SHARED_PRIOR * np.eye(n_c), s[1:, 0]))
    estimate = Estimate(tuple(range(1, 1 + n_c)), theta, np.eye(n_c), 0.0)
    return FlowMap(evidence.cells, _terms(projected, estimate), projected.cov)


def _terms(projected: Projected, estimate: Estimate) -> FloatArray:
    taken = projected.coefficients[:, list(estimate.used)] @ estimate.theta
    return np.asarray((projected.coefficients[:, 0] - taken).reshape(-1, TERMS))


def _add_timing(
    view: View, columns: Columns, sent: dict[str, tuple[int, FloatArray]], weights: Weights,
    revision: Revision,
) -> int:  # fmt: skip
    """Derivative columns of the lag and of every timing parameter; their number.

    sent: the commands before any timing.
    """
    dt_s, n = view.step_s, 0
    if not revision.replaces_lag:
        above, below = weights.lag_s + LAG_STEP_S, max(0.0, weights.lag_s - LAG_STEP_S)
        change = {}
        for name in sent:
            u = view.signal(name)
            rise = lagged_command(u, dt_s, (above,)) - lagged_command(u, dt_s, (below,))
            change[name] = rise / (above - below)
        columns.add(opening_change(view, change))
        n += 1
    for k, (_, psi) in enumerate(revision.timings):
        for j in range(len(psi)):
            change = {
                name: _change(u, d, dt_s, revision.timings, k, j) for name, (d, u) in sent.items()
            }
            columns.add(opening_change(view, change))
            n += 1
    return n


def _add_shapes(view: View, columns: Columns, revision: Revision) -> Iterator[tuple[int, int]]:
    """Derivative columns of the nonlinear parameters of effects, but for those at a bound."""
    for e, effect in enumerate(revision.effects):
        cause = _cause(view, effect)
        for k, value in enumerate(effect.shape):
            low, high = cause.bounds(k)
            slope = cause.slope(effect.shape, k) if low < value < high else {}
            if any(np.any(series != 0.0) for series in slope.values()):
                columns.add(slope)
                yield e, k


def _cause(view: View, effect: Candidate) -> Cause:
    return next(cause for cause in causes(view) if cause.makes(effect))


def _change(
    u: FloatArray, direction: int, dt_s: float, timings: Timings, k: int, j: int
) -> FloatArray:
    """How the command at the spool follows parameter j of timing k, those behind it held."""
    timing, psi = timings[k]
    before = _through(u, direction, dt_s, timings[:k])
    change = timing.change(before, direction, dt_s, psi, j)
    for behind, held in timings[k + 1 :]:  # linear ones pass it on, play lets it through
        if behind.is_linear:
            change = behind.apply(change, dt_s, held)
    return change


def opening_change(view: View, change: dict[str, FloatArray]) -> Volumes:
    """Volumes per interval and chamber of a small change of the commands (n,), in the blocks."""
    flows = [
        view.slope_u(i) * edge.direction * change[edge.command][:-1]
        for i, edge in enumerate(view.model.edges)
    ]
    n_c = len(view.model.chambers)
    return {c: view.into_chamber(c, flows) * view.dt_s for c in range(n_c)}


def _offer(
    view: View,
    columns: Columns,
    revision: Revision,
    bank: bool,
    more: Iterable[tuple[Cause, Shape]],
) -> None:
    """Columns of the revision's effects, and of all that is to be scored."""
    for cause in causes(view) if bank or revision.effects else ():
        own = [e for e in revision.effects if cause.makes(e)]
        for effect in own:
            columns.offer(effect, cause.column(effect.shape))
        if bank and not own and cause.offered:
            for shape in cause.shapes:
                columns.offer(cause.at(shape), cause.column(shape))
    for cause, shape in more:
        columns.offer(cause.at(shape), cause.column(shape))
    if bank:
        _offer_timings(view, columns, revision)


def _offer_timings(view: View, columns: Columns, revision: Revision) -> None:
    """What each timing of the bank would change, first order in the opening; coefficient 1."""
    names = {e.command: e.direction for e in view.model.edges}
    for timing in TIMINGS:
        if revision.has((timing.effect, "command")) or timing.own_spools:
            continue
        for psi in timing.bank:
            change = {
                name: timing.on(view.signal(name), d, view.step_s, psi) - view.signal(name)
                for name, d in names.items()
            }
            columns.offer(
                Candidate(
                    timing.effect,
                    "command",
                    "share",
                    "1",
                    20.0,
                    shape=psi[:1],
                    shape_names=timing.parameters[:1],
                    shape_units=timing.units[:1],
                ),
                opening_change(view, change),
            )


def _regression(
    model: Model,
    weights: Weights,
    revision: Revision,
    projected: Projected,
    columns: Columns,
    own: FloatArray,
    rows: int,
) -> Regression:
    n_c, head = len(model.chambers), len(projected.schur)
    noise, prior, mean = np.zeros((head, head)), np.zeros(head), np.zeros(head)
    for a, echo_a in columns.echo_of.items():
        for b, echo_b in columns.echo_of.items():
            noise[a, b] = projected.schur[echo_a, echo_b]
    prior[1 : 1 + n_c] = SHARED_PRIOR
    if not revision.replaces_lag:
        tolerance = model.lag.tolerance_s
        prior[1 + n_c] = tolerance**-2 if tolerance > 0 else HELD
        mean[1 + n_c] = model.lag.nominal_s - weights.lag_s
    return Regression(projected.schur, noise, prior, mean, own[:head], projected.dof, rows)


def _moved(found: Fit) -> tuple[Revision, Weights] | None:
    """Revision and weights with timing parameters moved to where the derivatives point."""
    settled, weights, lag = True, found.weights, found.model.lag
    estimate, spread = found.estimate, np.sqrt(max(1.0, found.rho))
    if not found.revision.replaces_lag and lag.tolerance_s > 0:
        at = 1 + len(found.model.chambers)
        moved = found.weights.lag_s + estimate.value(at)
        moved = float(np.clip(moved, 0.0, lag.nominal_s + 3 * lag.tolerance_s))
        if abs(moved - found.weights.lag_s) > max(SETTLED * spread * estimate.sd(at), 2e-5):
            settled, weights = False, replace(weights, lag_s=moved)
    timings = []
    for k, (timing, psi) in enumerate(found.revision.timings):
        new = []
        for j, (value, at) in enumerate(zip(psi, found.timing_columns(k), strict=True)):
            reach = REACH * max(abs(value), abs(timing.bank[0][j]) * 0.1)
            step = float(np.clip(estimate.value(at), -reach, reach))
            target = float(np.clip(value + step, timing.low[j], timing.high[j]))
            if abs(target - value) > max(SETTLED * spread * estimate.sd(at), 2e-3 * abs(value)):
                settled = False
            new.append(target)
        timings.append((timing, tuple(new)))
    effects = tuple(_reshaped(found, effect) for effect in found.revision.effects)
    sizes = [found.estimate.value(found.column(effect)) for effect in found.revision.effects]
    known = [size for _, size in found.revision.sizes]
    settled = settled and effects == found.revision.effects and len(known) == len(sizes)
    settled = settled and np.allclose(known, sizes, rtol=SIZED, atol=0.0)
    low, high = sorted(1.0 / bound for bound in found.model.beta_bounds_pa)
    compliance = np.clip(found.compliance, low, high)
    if not np.allclose(compliance, found.weights.compliance, rtol=SIZED, atol=0.0):
        settled, weights = False, replace(weights, compliance=compliance)
    revision = Revision(effects, tuple(timings), tuple(zip(effects, sizes, strict=True)))
    return None if settled else (revision, weights)


def _reshaped(found: Fit, effect: Candidate) -> Candidate:
    """An effect with its nonlinear parameters moved by what their derivatives took."""
    size, shape = found.estimate.value(found.column(effect)), list(effect.shape)
    cause = _cause(found.view, effect)
    if size == 0.0:
        return effect
    for k, at in found.shape_columns(effect).items():
        step, sd = found.estimate.value(at) / size, found.estimate.sd(at) / abs(size)
        reach = SHAPE_REACH * cause.spacing(k)
        if abs(step) > max(SETTLED * np.sqrt(max(1.0, found.rho)) * sd, 1e-3 * cause.spacing(k)):
            shape[k] = float(np.clip(shape[k] + np.clip(step, -reach, reach), *cause.bounds(k)))
    return replace(effect, shape=tuple(shape))
