"""How far the size of an effect is from one number: what a law that is not quite nature's misses.

The intervals of a fit know the noise, and not that a leak's gap widens with pressure or that a
sensor has two lags.  The intervals of a record are dealt into parts by the strength of the effect's
own column, each with as much of its square; where the law holds, each part gives the same size.
With c the sizes of the k parts, V their covariance and W its inverse,

    Q = (c - m)' W (c - m),     t^2 = max(0, Q - (k - 1)) / (tr W - 1' W^2 1 / 1' W 1),

m being their weighted mean: t is the standard deviation of the size from one part to another
(DerSimonian and Laird 1986), and so of what another motion finds.

A flow's size is told over the whole record (`rising`), without what noise and the blocks' terms
make of it (`size_biases`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.lag_interval import timing_sd
from rtid.diagnose.moving import LAG_REACH
from rtid.diagnose.rising import Rising, SizeBias, SizesBeside, given_volumes, risings
from rtid.diagnose.size_biases import size_biases
from rtid.diagnose.sized import physical
from rtid.effects.column import Candidate
from rtid.effects.law import Volumes
from rtid.effects.laws import cause_of, total_softness
from rtid.effects.laws.timing import delayed
from rtid.plain import FloatArray, Key
from rtid.units import UNIFORM

PARTS = 4
STEP = 0.05  # of a size, for derivatives of a law about it
MOST = 10.0  # times the noise's deviation: a size that its law hardly tells


def with_spreads(fitted: Fit, unnamed: frozenset[Key] = frozenset()) -> Fit:
    """A fit that knows its sizes over the whole record, and how far they are from one number.

    As it is without its rows.  unnamed: effects of it that nobody is told of.  What a law misses
    they may have taken in.
    """
    if fitted.rows is None or not (fitted.revision.effects or fitted.revision.timings):
        return fitted
    given = given_volumes(fitted)
    risen = risings(fitted, given, _flows(fitted))
    spreads = _of_parts(fitted, given, risen)
    shifts = dict[int, float]()
    for column, bias in size_biases(fitted, risen).items():
        known = _possible(fitted, column, bias)
        shifts[column] = known.shift
        spreads[column] = float(np.hypot(spreads[column], known.sd))
    of_delays = chain(_of_delays(fitted), _beside_others(fitted), _about_sizes(fitted))
    for column, more in chain(_of_wholes(fitted), of_delays, _moved_by(fitted, unnamed)):
        spreads[column] = float(np.hypot(spreads.get(column, 0.0), more))
    for column, more in [*_moved_along(fitted, spreads)]:
        spreads[column] = float(np.hypot(spreads.get(column, 0.0), more))
    sizes = {"spreads": tuple(spreads.items()), "shifts": tuple(shifts.items())}
    return fitted.knowing(**sizes, known_cov=None)


def _possible(fitted: Fit, column: int, bias: SizeBias) -> SizeBias:
    """A size's bias, which only widens it where it would make the size one that cannot be."""
    (flow,) = (e for e in fitted.revision.effects if fitted.column(e) == column)
    size = fitted.held.value(column) + bias.shift
    return bias if flow.is_possible(physical(fitted, flow, size)) else bias.unknown()


def _flows(fitted: Fit) -> list[Candidate]:
    """The effects that are flows: what is stored has another share of the noise."""
    return [
        effect
        for effect in fitted.revision.effects
        if not total_softness(fitted.view, ((effect, 1.0),)).any()
    ]


def _of_parts(fitted: Fit, given: dict[int, Volumes], risen: dict[int, Rising]) -> dict[int, float]:
    """Spread of each timing, and of each effect that is a flow, by column: of its parts."""
    columns = [fitted.timing_columns(k)[0] for k in range(len(fitted.revision.timings))]
    columns += risen
    parts = [part for column in columns for part in _parts(given[column])]
    along = [column for column, over in risen.items() if over.column]
    sizes = SizesBeside.of(fitted, given, [*parts, *(risen[column].column for column in along)])
    spreads: dict[int, float] = {}
    for k, column in enumerate(columns):
        beside = [len(parts) + along.index(column)] if column in along else []
        found, cov = sizes.in_place_of(column, [*range(PARTS * k, PARTS * (k + 1)), *beside])
        spreads[column] = spread(found[:PARTS], cov[:PARTS, :PARTS])
    return spreads


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


def _about_sizes(fitted: Fit) -> Iterator[tuple[int, float]]:
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
        sizes = SizesBeside.of(fitted, given_volumes(fitted), [change])
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


def _moved_along(fitted: Fit, spreads: dict[int, float]) -> Iterator[tuple[int, float]]:
    """Column and spread of a timing's other numbers, which its first takes along, in their units.

    Of a valve of 40 rad/s, damped by 0.9, 42.4 +- 0.9 was told with 0.958 +- 0.001: the ratio of
    the two is what a record tells.
    """
    used, cov = fitted.estimate.used, fitted.estimate.cov
    for k in range(len(fitted.revision.timings)):
        first, *others = fitted.timing_columns(k)
        for column in others if first in used else ():
            if column in used:
                at, there = used.index(first), used.index(column)
                yield column, float(abs(cov[there, at] / cov[at, at]) * spreads.get(first, 0.0))


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
