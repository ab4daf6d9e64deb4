"""How well a record tells a lag or a delay: by what others leave, not by a derivative at one.

Where a joystick's steps take the command from block to block, a lag of half a millisecond more has
other rows in each, and their maps follow: the derivative knew one to 0.2 ms, of which everything
from 2 to 6 ms left the same.  On either side it is moved on, twice as far each time, until
chi2 has risen by that of RISE standard deviations, or its range ends:

    sd = (l_+ - l_-) / (2 RISE),        excess(l_+-) - excess(l) = RISE^2 rho.

A delay is moved alone, and with the spools' lag as much the other way: what leaves less counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np

from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.moving import LAG_REACH
from rtid.diagnose.revision import Revision

RISE = 3.0  # standard deviations at which chi2 is looked at
ABOUT, ROUGH = 0.5, 1.5  # of that rise, between which what the derivative says is not asked again
FARTHER = 3  # doublings for which another hollow is looked for
Leaves = Callable[[float], float]


def lag_sd_s(present: Fit) -> float:
    """Standard deviation of the spools' lag, s; NaN where the record does not tell it."""
    if not np.isfinite(present.lag_sd_s):
        return present.lag_sd_s
    room = _room_of_lag(present)
    return _sd(present, present.lag_sd_s, room, lambda by: _left(present, by, present.revision))


def delay_sd_s(present: Fit, k: int) -> float:
    """Standard deviation of the delay that is timing k of a fit, s, beyond the derivative's."""
    (timing, psi), low_high = present.revision.timings[k], _room_of_lag(present)
    local = present.estimate.sd(present.timing_columns(k)[0]) * float(
        np.sqrt(max(1.0, present.rho))
    )

    def leaves(by_s: float) -> float:
        timings = list(present.revision.timings)
        timings[k] = timing, (psi[0] + by_s,)
        moved = replace(present.revision, timings=tuple(timings))
        against = float(np.clip(-by_s, *low_high))
        return min(_left(present, lag, moved) for lag in {0.0, against})

    room = timing.low[0] - psi[0], timing.high[0] - psi[0]
    return float(np.sqrt(_sd(present, local, room, leaves) ** 2 - local**2))


def _room_of_lag(present: Fit) -> tuple[float, float]:
    """By how much the spools' lag may be less and more, s."""
    now_s, lag = present.weights.lag_s, present.declared.lag
    if present.lag_tolerance_s == 0.0:
        return 0.0, 0.0
    return -now_s, max(0.0, lag.nominal_s + LAG_REACH * lag.tolerance_s - now_s)


def _left(present: Fit, more_s: float, revision: Revision) -> float:
    """What another revision leaves beyond its unknowns, with so much more lag of the spools."""
    weights = replace(present.weights, lag_s=present.weights.lag_s + more_s)
    record = present.declared, present.chunk, weights, revision
    return one_pass(*record, present, False, thorough=False).excess


def _sd(present: Fit, local: float, room: tuple[float, float], leaves: Leaves) -> float:
    """By what is left on either side, and no less than the derivative says (`local`)."""
    ends = [_end(present, way * RISE * local, room, leaves) for way in (-1.0, 1.0)]
    return max(local, (ends[1] - ends[0]) / (2.0 * RISE))


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
