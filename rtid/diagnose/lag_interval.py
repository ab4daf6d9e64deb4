"""How well a record tells a lag or a delay: by what others leave, not by a derivative at one.

Where a joystick's steps take the command from block to block, a lag of half a millisecond more has
other rows in each, and their maps follow: the derivative knew one to 0.2 ms, of which everything
from 2 to 6 ms left the same.  On either side it is moved on, twice as far each time, until
chi2 has risen by that of RISE standard deviations, or its range ends:

    sd = (l_+ - l_-) / (2 RISE),        excess(l_+-) - excess(l) = RISE^2 rho.

What is late as a lag is, a delay or the play of a valve, is moved alone, and with the spools' lag
as much the other way: what leaves less counts, for the lag as for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from rtid.diagnose.fit import Fit, fit, one_pass
from rtid.diagnose.moving import LAG_REACH, LEAST_LAG_S, NOISE
from rtid.diagnose.revision import Revision
from rtid.effects.laws.timing import Psi, TimingLaw, delayed, played, rate_limited
from rtid.plain import FloatArray

RISE = 3.0  # standard deviations at which chi2 is looked at
ABOUT, ROUGH = 0.5, 1.5  # of that rise, between which what the derivative says is not asked again
BENT = 0.5  # of what the derivative says: an interval as much wider is no derivative's
CORRECTIONS = 3  # of a play beside another lag
FARTHER = 3  # doublings for which another hollow is looked for
UNEVEN = 0.01  # of the degrees of freedom: chi2 by which a lag or share from elsewhere is better
LOOKS, JUMPING = 12, 0.5  # lags over the range; of a command's way, in steps over more than a block
Leaves = Callable[[float], float]


@dataclass(frozen=True)
class LagInterval:
    """Standard deviation of the spools' lag, s, NaN where the record does not tell it.

    compliance (chambers,): what of each chamber's, 1/Pa, is open with it beyond the derivative's.
    """

    sd_s: float
    compliance: FloatArray


def known_lag(present: Fit) -> LagInterval:
    """How well the spools' lag is known, and what goes with it.

    The compliances go by their derivatives where the lag does.  Where it is known less well they
    are those of its ends: beside 2.84 +- 0.42 ms 1116 +- 40 MPa were told, of 1458 and 3.38 ms.
    """
    local, none = present.lag_sd_s, np.zeros(len(present.compliance))
    if not np.isfinite(local):
        return LagInterval(local, none)
    ends = _ends_of_lag(present)
    if _wide(ends) <= (1.0 + BENT) * local:
        return LagInterval(max(local, _wide(ends)), none)
    lags = [present.weights.lag_s + end for end in ends]
    there = [_passed(present, lag_s, present.revision).compliance for lag_s in lags]
    return LagInterval(_wide(ends), np.max(np.abs(there - present.compliance), axis=0) / RISE)


def is_at_most(present: Fit) -> bool:
    """True where the lag has gone as far as it may, and is no lag that was declared as known."""
    return present.lag_tolerance_s > 0.0 and _room_of_lag(present)[1] < LEAST_LAG_S


def looked_over(present: Fit) -> Fit:
    """The fit from the lag that leaves the least over all of its range, where commands jump.

    Steps that lead over several blocks take along what their rows tell of them: chi2 is a bowl of
    milliseconds with a wall at each row's end, where derivatives stand still.  Of 10.8 ms they told
    6.812 +- 0.018 from 2 ms on.  By no more than unevenness a farther lag is no better one: where
    all from 3 to 6 ms leave the same, the one that is nearer to what was declared stays.
    """
    if not np.isfinite(present.lag_sd_s) or not _jumps(present):
        return present
    low, high = (present.weights.lag_s + end for end in _room_of_lag(present))
    lags = np.linspace(low, high, LOOKS)
    passes = (_passed(present, float(lag_s), present.revision).light() for lag_s in lags)
    best = min(passes, key=lambda fitted: fitted.excess)
    if best.excess > present.excess - UNEVEN * present.regression.dof:
        return present
    record = present.declared, present.chunk, best.weights, best.revision, best
    now = fit(*record, bank=False)
    return now if now.excess < present.excess else present


def _jumps(present: Fit) -> bool:
    """True where most of the way of a command is made in steps over more than a block."""
    far, way = 0.0, 1e-300
    for edge in present.declared.edges:
        steps = np.abs(np.diff(present.chunk[:, 2 + present.declared.column(edge.command)]))
        block = float(np.median(np.diff(edge.grid.u_v)))
        far, way = far + float(steps[steps > block].sum()), way + float(steps.sum())
    return far > JUMPING * way


def timing_sd(present: Fit, k: int) -> float:
    """Standard deviation of the first number of timing k, in its unit, beyond the derivative's.

    0 of a timing that is not late as a lag is, nor a limit.
    """
    timing, psi = present.revision.timings[k]
    sd = present.estimate.sd(present.timing_columns(k)[0])
    local = sd * float(np.sqrt(max(1.0, present.rho)))
    if timing.apply is played and np.isfinite(present.lag_sd_s):
        less, more = (_beside(present, k, end) - psi[0] for end in _ends_of_lag(present))
        return _beyond(_wide((less, more)), local)
    if timing.apply is rate_limited:
        return _beyond(_wide(_ends_of_limit(present, k, local)), local)
    if timing.apply is not delayed:
        return 0.0
    low_high = _room_of_lag(present)

    def leaves(by_s: float) -> float:
        moved = _moved(present, k, by_s)
        against = float(np.clip(-by_s, *low_high))
        return min(_left(present, lag, moved) for lag in {0.0, against})

    room = timing.low[0] - psi[0], timing.high[0] - psi[0]
    return _beyond(_wide(_ends(present, local, room, leaves)), local)


def _ends_of_limit(present: Fit, k: int, local: float) -> tuple[float, float]:
    """By how much the rate of timing k may be less and more at the rise that counts, V/s.

    Alone, and with what the lag that it is in goes along by: maps that follow a part of it in each
    block bend derivatives, not what is left.
    """
    timing, psi = present.revision.timings[k]
    first, *rest = present.timing_columns(k)
    used, cov = present.estimate.used, present.estimate.cov
    at = used.index(first)
    along = [cov[used.index(j), at] / max(cov[at, at], 1e-300) if j in used else 0.0 for j in rest]

    def leaves(by: float) -> float:
        lags = (psi[1:], tuple(v + slope * by for v, slope in zip(psi[1:], along, strict=True)))
        timings = [
            (timing, tuple(np.clip((psi[0] + by, *lag), timing.low, timing.high).tolist()))
            for lag in dict.fromkeys(lags)
        ]
        return min(_left(present, 0.0, _with(present.revision, k, new)) for new in timings)

    return _ends(present, local, (timing.low[0] - psi[0], timing.high[0] - psi[0]), leaves)


def _with(revision: Revision, k: int, timing: tuple[TimingLaw, Psi]) -> Revision:
    """The revision with another timing k."""
    timings = revision.timings
    return replace(revision, timings=(*timings[:k], timing, *timings[k + 1 :]))


def _beside(present: Fit, k: int, by_s: float) -> float:
    """The first number of timing k beside so much more lag, s; out of its range as much within."""
    low, high = _room_of_lag(present)
    is_within = low <= by_s <= high
    lag_s = present.weights.lag_s + (by_s if is_within else -by_s)
    first = shared(present, k, lag_s).revision.timings[k][1][0]
    return first if is_within else 2.0 * present.revision.timings[k][1][0] - first


def shared(present: Fit, k: int, lag_s: float) -> Fit:
    """The fit with another lag of the spools, and timing k earlier by as much.

    What of a play that is goes with the flow at each reversal: it is moved on as its derivative
    points beside that lag.
    """
    now = _passed(present, lag_s, _moved(present, k, present.weights.lag_s - lag_s))
    (timing, _), column = now.revision.timings[k], present.timing_columns(k)[0]
    used = tuple(c for c in now.estimate.used if c != now.first_given)
    is_play = timing.apply is played and column in used
    for _ in range(CORRECTIONS if is_play else 0):
        first = now.revision.timings[k][1][0] + now.regression.fit(used).value(column)
        then = _passed(now, lag_s, _with_first(now.revision, k, first))
        if then.excess >= now.excess - NOISE:
            break
        now = then
    return now


def _of_lag(fit: Fit, timing: TimingLaw) -> float:
    """What of a timing's first number is as late as one second of the spools' lag.

    Of a play w it is what is taken up as late as the lag on the mean over the record, where that
    moves a flow: w / 2 sign u' is nearest to tau u' where w / tau = 2 sum g^2 u'^2 / sum g^2 |u'|,
    with g = dQ / du.
    """
    if timing.apply is not played:
        return 1.0
    squares, sizes = 0.0, 1e-300
    for i, edge in enumerate(fit.model.edges):
        rate = np.abs(np.diff(fit.sent[:, 2 + fit.model.column(edge.command)])) / fit.view.dt_s
        weight = fit.view.slope_u(i) ** 2
        squares, sizes = squares + float(weight @ rate**2), sizes + float(weight @ rate)
    return 2.0 * squares / sizes


def _moved(present: Fit, k: int, by_s: float) -> Revision:
    """The revision with timing k later by so much, s."""
    timing, psi = present.revision.timings[k]
    return _with_first(present.revision, k, psi[0] + by_s * _of_lag(present, timing))


def _with_first(revision: Revision, k: int, first: float) -> Revision:
    """The revision with another first number of timing k, within its bounds."""
    timing, psi = revision.timings[k]
    first = float(np.clip(first, timing.low[0], timing.high[0]))
    return _with(revision, k, (timing, (first, *psi[1:])))


def _ends_of_lag(present: Fit) -> tuple[float, float]:
    """By how much the lag may be less and more, s, at the rise that counts."""
    timings = enumerate(present.revision.timings)
    late = [k for k, (timing, _) in timings if timing.apply in (delayed, played)]

    def leaves(by_s: float) -> float:
        lag_s = present.weights.lag_s + by_s
        against = [shared(present, k, lag_s).excess for k in late]
        return min([_left(present, by_s, present.revision), *against])

    return _ends(present, present.lag_sd_s, _room_of_lag(present), leaves)


def _room_of_lag(present: Fit) -> tuple[float, float]:
    """By how much the spools' lag may be less and more, s."""
    now_s, lag = present.weights.lag_s, present.declared.lag
    if present.lag_tolerance_s == 0.0:
        return 0.0, 0.0
    return -now_s, max(0.0, lag.nominal_s + LAG_REACH * lag.tolerance_s - now_s)


def _left(present: Fit, more_s: float, revision: Revision) -> float:
    """What another revision leaves beyond its unknowns, with so much more lag of the spools."""
    return _passed(present, present.weights.lag_s + more_s, revision).excess


def _passed(present: Fit, lag_s: float, revision: Revision) -> Fit:
    weights = replace(present.weights, lag_s=lag_s)
    record = present.declared, present.chunk, weights, revision
    return one_pass(*record, present, False, thorough=False)


def _ends(
    present: Fit, local: float, room: tuple[float, float], leaves: Leaves
) -> tuple[float, float]:
    """How far off chi2 has risen on either side, beginning with what the derivative says (`local`).

    What stands at an end of its range is as little known beyond it as before: a lag that was drawn
    to three tolerances was told to a third of what it was off by.
    """
    low, high = (_end(present, way * RISE * local, room, leaves) for way in (-1.0, 1.0))
    if min(np.abs(room)) < LEAST_LAG_S:
        low, high = min(low, -high), max(high, -low)
    return low, high


def _wide(ends: tuple[float, float]) -> float:
    """The standard deviation of what ends there."""
    return abs(ends[1] - ends[0]) / (2.0 * RISE)


def _beyond(sd: float, local: float) -> float:
    """A deviation beyond another one that counts as well."""
    return float(np.sqrt(max(0.0, sd**2 - local**2)))


def _end(present: Fit, step: float, room: tuple[float, float], leaves: Leaves) -> float:
    """How far off chi2 has risen for the last time, by steps that double, or its range ends.

    Where it rises far more than the derivative says, the present lag stands in one of several
    hollows, and others are looked for.
    """
    least, points = RISE**2 * max(1.0, present.rho), [(0.0, 0.0)]
    is_uneven = False
    for k in count():
        at = float(np.clip(step * 2.0**k, *room))
        risen = leaves(at) - present.excess
        points.append((at, risen))
        if k == 0 and ABOUT * least <= risen <= ROUGH * least:
            return at  # as the derivative says
        is_uneven |= k == 0 and risen > ROUGH * least
        if at != step * 2.0**k or (risen >= least and not (is_uneven and k < FARTHER)):
            break
    last = max(k for k, (_, risen) in enumerate(points) if risen < least)
    if last == len(points) - 1:
        return at
    (low, at_low), (high, at_high) = points[last : last + 2]
    root = np.sqrt([max(0.0, at_low), least, at_high])  # which goes with the way
    return low + (high - low) * float((root[1] - root[0]) / (root[2] - root[0]))
