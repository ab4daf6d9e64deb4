"""How far the size of an effect is from one number: what a law that is not quite nature's misses.

The intervals of a fit know the noise, and not that a leak's gap widens with pressure or that a
sensor has two lags.  The intervals of a record are dealt into parts by the strength of the effect's
own column, each with as much of its square; where the law holds, each part gives the same size.
With c the sizes of the k parts, V their covariance and W its inverse,

    Q = (c - m)' W (c - m),     t^2 = max(0, Q - (k - 1)) / (tr W - 1' W^2 1 / 1' W 1),

m being their weighted mean: t is the standard deviation of the size from one part to another
(DerSimonian and Laird 1986), and so of what another motion finds.

What tells a flow is seldom all of it: the maps follow the rest.  And a gap widens with pressure: so
the size c goes with a pressure p, c0 + c1 (p - p0) / sd p, where p0 is the mean over all of the
effect's own flow, so that c0 is the size over the whole record, and c1 is unknown by W sd p c,

    c0 -> c0 - V01 / (V11 + (W sd p c)^2) c1,     var c0 -> V00 - V01^2 / (V11 + (W sd p c)^2),

where V is their covariance with a free c1.  p is the mean of all pressures, that of the effect's
own chamber, or the one between its own two, each as likely as the record makes it,

    2 ln L = c1^2 / V11 - c1^2 / (V11 + (W sd p c)^2) - ln(1 + (W sd p c)^2 / V11).

Of a leak that was 3 % visible, its slope over its own chamber's pressure, 8.55 +- 0.04, was told
for the 7.46 that it let through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from rtid.diagnose.bank import add_shapes, add_timing
from rtid.diagnose.commands import commands
from rtid.diagnose.evidence import Rows, project
from rtid.diagnose.fit import Fit, columns_of_effects
from rtid.diagnose.lag_interval import timing_sd
from rtid.diagnose.moving import LAG_REACH
from rtid.diagnose.sized import physical
from rtid.effects.column import Candidate, Columns
from rtid.effects.law import Volumes
from rtid.effects.laws import cause_of, total_softness
from rtid.effects.laws.timing import delayed
from rtid.plain import FloatArray, Key
from rtid.units import UNIFORM

PARTS = 4
STEP = 0.05  # of a size, for derivatives of a law about it
MOST = 10.0  # times the noise's deviation: a size that its law hardly tells
WIDENS = 0.05e-6  # 1/Pa: share by which a gap may let more through, one standard deviation


def with_spreads(fitted: Fit, unnamed: frozenset[Key] = frozenset()) -> Fit:
    """A fit that knows its sizes over the whole record, and how far they are from one number.

    As it is without its rows.  unnamed: effects of it that nobody is told of.  What a law misses
    they may have taken in.
    """
    if fitted.rows is None or not (fitted.revision.effects or fitted.revision.timings):
        return fitted
    given = _given(fitted)
    risen = {
        fitted.column(flow): _Risen.of(fitted, fitted.rows, given, flow) for flow in _flows(fitted)
    }
    spreads = _of_parts(fitted, fitted.rows, given, risen)
    for column, over in risen.items():
        spreads[column] = float(np.hypot(spreads[column], over.sd))
    of_delays = chain(_of_delays(fitted), _beside_others(fitted), _about_sizes(fitted, fitted.rows))
    for column, more in chain(_of_wholes(fitted), of_delays, _moved_by(fitted, unnamed)):
        spreads[column] = float(np.hypot(spreads.get(column, 0.0), more))
    shifts = tuple((column, over.shift) for column, over in risen.items() if over.shift)
    return fitted.knowing(spreads=tuple(spreads.items()), shifts=shifts, known_cov=None)


def _flows(fitted: Fit) -> list[Candidate]:
    """The effects that are flows: what is stored has another share of the noise."""
    return [
        effect
        for effect in fitted.revision.effects
        if not total_softness(fitted.view, ((effect, 1.0),)).any()
    ]


def _of_parts(
    fitted: Fit, rows: Rows, given: dict[int, Volumes], risen: dict[int, _Risen]
) -> dict[int, float]:
    """Spread of each timing, and of each effect that is a flow, by column: of its parts."""
    columns = [fitted.timing_columns(k)[0] for k in range(len(fitted.revision.timings))]
    columns += risen
    parts = [part for column in columns for part in _parts(given[column])]
    along = [column for column, over in risen.items() if over.column]
    sizes = _Sizes.of(fitted, rows, given, [*parts, *(risen[column].column for column in along)])
    spreads: dict[int, float] = {}
    for k, column in enumerate(columns):
        beside = [len(parts) + along.index(column)] if column in along else []
        found, cov = sizes.in_place_of(column, [*range(PARTS * k, PARTS * (k + 1)), *beside])
        spreads[column] = spread(found[:PARTS], cov[:PARTS, :PARTS])
    return spreads


@dataclass(frozen=True)
class _Risen:
    """A size that goes with a pressure: what it is over the whole record.

    shift: more than where it does not, sd: beyond what the noise leaves of that, in its unit;
    column: of the pressure that the record makes likeliest; empty where there is none.
    """

    shift: float = 0.0
    sd: float = 0.0
    column: Volumes = field(default_factory=dict)

    @classmethod
    def of(cls, fitted: Fit, rows: Rows, given: dict[int, Volumes], flow: Candidate) -> _Risen:
        """Of one of the effects that are flows; its own size stands where the other cannot be."""
        column = fitted.column(flow)
        grown = [_grown(given[column], by) for by in _levels(fitted, given[column])]
        if not grown:
            return cls()
        sizes = _Sizes.of(fitted, rows, given, [volumes for volumes, _ in grown])
        (plain, known), size = sizes.beside(column), fitted.held.value(column)
        c0, more, best = sizes.averaged(column, [WIDENS * span * size for _, span in grown])
        shift, sd = c0 - plain, float(np.sqrt(max(0.0, more - known)))
        if not flow.is_possible(physical(fitted, flow, size + shift)):
            shift, sd = 0.0, float(np.hypot(sd, shift))
        return cls(shift, sd, grown[best][0])


@dataclass(frozen=True)
class _Sizes:
    """What the sizes of more columns are beside those of a fit.

    s: products of y, the fit's columns and those more, the maps and the sensors' noise taken out;
    at: place of each of the fit's columns there; prior, mean: by that place.
    """

    s: FloatArray
    at: dict[int, int]
    prior: FloatArray
    mean: FloatArray
    rho: float

    @classmethod
    def of(cls, fitted: Fit, rows: Rows, given: dict[int, Volumes], more: list[Volumes]) -> _Sizes:
        known = [0, *range(1, fitted.first_given), *given]
        condensed = [rows.on_rows(column) for column in (*given.values(), *more)]
        s, free, regression = project(rows, condensed).schur, np.zeros(len(more)), fitted.regression
        s[1 : len(known), 1 : len(known)] -= regression.noise_of(known[1:])
        prior, mean = (np.append(of[known], free) for of in (regression.prior, regression.mean))
        at = {column: place for place, column in enumerate(known)}
        return cls(s, at, prior, mean, max(1.0, fitted.rho))

    def in_place_of(self, column: int, more: Iterable[int]) -> tuple[FloatArray, FloatArray]:
        """Sizes (k,) of k of those more, by number, and their covariance (k, k), in their units."""
        return self._free(column, [len(self.at) + k for k in more])

    def beside(self, column: int) -> tuple[float, float]:
        """Size of one of the fit's columns, and its variance, in its unit."""
        sizes, cov = self._free(column, [self.at[column]])
        return float(sizes[0]), float(cov[0, 0])

    def rising(self, column: int, more: int, sd: float) -> tuple[float, float, float]:
        """Size of one of the fit's columns, its variance, and 2 ln of the likelihood.

        Beside one of those more, by number, whose own is 0 within sd, in their unit.
        """
        (c0, c1), v = self._free(column, [self.at[column], len(self.at) + more])
        known, free = max(v[1, 1], 1e-300), v[1, 1] + sd**2
        likely = c1**2 / known - c1**2 / free - np.log(free / known)
        return c0 - v[0, 1] / free * c1, v[0, 0] - v[0, 1] ** 2 / free, likely

    def averaged(self, column: int, sds: list[float]) -> tuple[float, float, int]:
        """Size and variance over all of those more, as likely as each is, and the likeliest.

        sds: within which their own are 0, as of `rising`.
        """
        each = [self.rising(column, k, sd) for k, sd in enumerate(sds)]
        c0, var, likely = np.array(each).T
        share = np.exp(0.5 * (likely - likely.max()))
        share /= share.sum()
        mean = float(share @ c0)
        return mean, float(share @ (var + (c0 - mean) ** 2)), int(np.argmax(likely))

    def followed(self, column: int, more: int) -> float:
        """How much of one of the fit's columns takes one of those more, beside the others."""
        places = [place for c, place in self.at.items() if c != 0]
        gram = self.s[np.ix_(places, places)] + np.diag(self.prior[places])
        shares, _ = _solved(gram, self.s[places, len(self.at) + more])
        return float(shares[places.index(self.at[column])])

    def _free(self, column: int, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Of the places `free`, without a prior, beside the fit's columns without one of them."""
        places = [place for c, place in self.at.items() if c not in (0, column)] + free
        prior, mean = self.prior[places], self.mean[places]
        prior[-len(free) :] = 0.0
        right = self.s[places, 0] + prior * mean
        sizes, cov = _solved(self.s[np.ix_(places, places)] + np.diag(prior), right)
        return sizes[-len(free) :], self.rho * cov[-len(free) :, -len(free) :]


def _of_wholes(fitted: Fit) -> Iterator[tuple[int, float]]:
    """Column and spread of each number of an effect that its shape alone describes.

    What is left may be as much of the effect's own form, or none of it: anything between.
    """
    rest = max(0.0, fitted.held.sse - fitted.regression.dof)
    for effect in fitted.revision.effects:
        if effect.is_whole:
            column = fitted.column(effect)
            without = fitted.regression.fit(tuple(k for k in fitted.held.used if k != column))
            share = np.sqrt(rest / max(without.sse - fitted.held.sse, rest, 1e-300)) / UNIFORM
            for k, at in fitted.shape_columns(effect).items():
                yield at, float(share * abs(effect.shape[k] * fitted.held.value(column)))


def _about_sizes(fitted: Fit, rows: Rows) -> Iterator[tuple[int, float]]:
    """Column and what is more in the spread of each size that its own law is linear about.

    Where the law is made about a size s a fit finds c(s), and the size is where both are one: an
    error of c moves it by 1 / (1 - dc/ds) as much.  A column z that grows by k z per size finds
    that share less, dc/ds = - k.
    """
    view = fitted.view
    for effect in fitted.revision.effects:
        if not effect.law.linear_about:
            continue
        column, size = fitted.column(effect), effect.law.inner_size
        farther = replace(effect, page=effect.law.at_size((1.0 + STEP) * size))
        plain, moved = (cause_of(view, e).column(e.shape) for e in (effect, farther))
        change = {c: (moved[c] - plain[c]) / STEP for c in plain}
        sizes = _Sizes.of(fitted, rows, _given(fitted), [change])
        more = float(np.clip(1.0 / (1.0 + sizes.followed(column, 0)), 1.0, MOST))
        yield column, fitted.sd_of(column) * float(np.sqrt(more**2 - 1.0))


def _of_delays(fitted: Fit) -> Iterator[tuple[int, float]]:
    """Column and spread of each delay of a command beside a lag that is free, s.

    A part of a sample shares a step out between two intervals, and what reaches the lag is wider
    than it was by part (1 - part) step^2, as if the spools' lag were longer: their sum stays.  At
    200 samples a second the lag went as far as it may, 0.8 ms, and the delay took as much.
    """
    lag_s, step_s = fitted.weights.lag_s, fitted.view.step_s
    for k, (timing, psi) in enumerate(fitted.revision.timings):
        if timing.apply is delayed:
            part = psi[0] / step_s % 1.0
            wider = part * (1.0 - part) * step_s**2
            longer = float(np.sqrt(lag_s**2 + wider) - lag_s)
            yield fitted.timing_columns(k)[0], min(longer, LAG_REACH * fitted.lag_tolerance_s)


def _beside_others(fitted: Fit) -> Iterator[tuple[int, float]]:
    """Column and spread of each delay and play that is known no better than others leave more.

    A delay of 20 ms under a joystick's hard steps was told as 13.73 +- 0.08, and is +- 1.4.
    """
    for k in range(len(fitted.revision.timings)):
        column = fitted.timing_columns(k)[0]
        if column in fitted.estimate.used:
            yield column, timing_sd(fitted, k)


def _moved_by(fitted: Fit, unnamed: frozenset[Key]) -> Iterator[tuple[int, float]]:
    """What sizes of effects move by, by column, where those that nobody is told of are left out.

    As of a law's own form: it is anything between.  Beside a leak whose gap widens a relief valve
    that changed next to nothing stayed in the model, and left the leak 10 % smaller, to 0.3 %.
    """
    rest = [e for e in fitted.revision.effects if e.key not in unnamed]
    if len(rest) == len(fitted.revision.effects):
        return
    left_out = {
        column
        for e in fitted.revision.effects
        if e.key in unnamed
        for column in (fitted.column(e), *fitted.shape_columns(e).values())
    }
    without = fitted.regression.fit(tuple(k for k in fitted.held.used if k not in left_out))
    for column in map(fitted.column, rest):
        yield column, abs(without.value(column) - fitted.held.value(column)) / UNIFORM


def _given(fitted: Fit) -> dict[int, Volumes]:
    """Volumes per interval of every column of a fit behind those of the compliances."""
    view, revision, given = fitted.view, fitted.revision, list[Volumes]()
    raw = Columns(lambda volumes, _: given.append(volumes))
    add_timing(view, raw, commands(fitted.declared, fitted.chunk), fitted.weights, revision)
    list(add_shapes(view, raw, revision))
    columns = [*range(fitted.first_given, fitted.first), *map(fitted.column, revision.effects)]
    return dict(zip(columns, [*given, *columns_of_effects(fitted)], strict=True))


def _strength(volumes: Volumes) -> FloatArray:
    """Square of a column over its intervals (n - 1,), m6."""
    return np.asarray(np.sum([series**2 for series in volumes.values()], axis=0))


def _parts(volumes: Volumes) -> list[Volumes]:
    """A column dealt out by its strength, each part with as much of its square."""
    square = _strength(volumes)
    order = np.argsort(square)
    share = np.empty(len(square))
    share[order] = np.cumsum(square[order]) / max(float(square.sum()), 1e-300)
    part = np.minimum((PARTS * share).astype(int), PARTS - 1)
    return [{c: np.where(part == k, v, 0.0) for c, v in volumes.items()} for k in range(PARTS)]


def _levels(fitted: Fit, volumes: Volumes) -> list[Volumes]:
    """Pressures, Pa, that a flow's size may go with, over its chambers' intervals (n - 1,)."""
    if not fitted.view.has_pressures:
        return []
    pressures = [fitted.view.pressure(c) for c in range(len(fitted.model.chambers))]
    at = [0.5 * (p[1:] + p[:-1]) for p in pressures]
    levels: list[Volumes] = [{c: np.mean(at, axis=0) for c in volumes}, {c: at[c] for c in volumes}]
    if len(volumes) == len(at) == 2:
        levels.append({c: np.abs(at[0] - at[1]) for c in volumes})
    return [by for by in levels if any(np.ptp(level) > 0.0 for level in by.values())]


def _grown(volumes: Volumes, levels: Volumes) -> tuple[Volumes, float]:
    """A column that grows with levels, in their deviations over its square; and those, Pa."""
    off = {c: levels[c] - _mean(volumes, levels) for c in volumes}
    sd = max(np.sqrt(_mean(volumes, {c: by**2 for c, by in off.items()})), 1e-300)
    return {c: series * off[c] / sd for c, series in volumes.items()}, sd


def _mean(volumes: Volumes, of: Volumes) -> float:
    """Mean of series of the chambers (n - 1,), in their unit, over the square of a column."""
    whole = sum(float(series @ series) for series in volumes.values())
    return sum(float(volumes[c] ** 2 @ of[c]) for c in volumes) / max(whole, 1e-300)


def _solved(gram: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solution (n,) and inverse (n, n) of products (n, n), scaled on the way."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    outer = np.outer(scale, scale)
    cov = np.linalg.pinv(gram * outer, hermitian=True) * outer
    return cov @ right, cov


def spread(sizes: FloatArray, cov: FloatArray) -> float:
    """Standard deviation t, in their unit, of sizes (k,) beyond their covariance (k, k)."""
    w = np.linalg.pinv(cov, hermitian=True)
    total = float(w.sum())
    if total <= 0.0:
        return 0.0
    off = sizes - float((w @ sizes).sum()) / total
    weight = float(np.trace(w) - (w @ w).sum() / total)
    beyond = float(off @ w @ off) - (len(sizes) - 1)
    return float(np.sqrt(max(0.0, beyond) / weight)) if weight > 0.0 else 0.0
