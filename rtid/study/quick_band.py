"""Up to which command valves are shut, and what moves a machine at rest, from motion alone.

The valves are shut where the motion does not depend on the command: it is that at rest, which a
leak under load makes a creep.  Where the command has just been larger the machine still runs on.
"""

from __future__ import annotations

import numpy as np

from rtid.plain import BoolArray, FloatArray

MOVES = 0.02  # of the top speed: below, the machine stands
WELL = 4.0  # times as fast, and as fast again: how the speed rises beyond the opening
STRAIGHT = 3.5  # times further to the next of them: 4 where it rises straight, 2 as a square
BINS = 80  # of the command
STILL_BINS = 2  # by which a command may have been larger just before
SETTLES_S = 0.1  # of just before: a machine that runs on stops within
COMMON = 0.2  # share of the commands at which it stands that are one and the same: its neutral
OBEYS = 0.8  # share of its way that a machine goes as its command says
HALF, LEAST = 0.5, 0.125  # of the command where motion begins; the least, of where it is seen


def settled(u: FloatArray, t_s: FloatArray) -> BoolArray:
    """Where the command (n,) has not been larger just before, by more than some bins; t_s (n,)."""
    from scipy.ndimage import maximum_filter1d  # noqa: PLC0415 - takes long to import

    size, long_s = np.abs(u), float(t_s[-1] - t_s[0]) if len(t_s) else 0.0
    n = max(1, round(SETTLES_S * len(t_s) / long_s)) if long_s > 0.0 else 1
    before = maximum_filter1d(size, min(n, len(u)), origin=(min(n, len(u)) - 1) // 2)
    return np.asarray(before <= size + STILL_BINS * size.max(initial=0.0) / BINS)


def creep(u: FloatArray, speed: FloatArray, is_settled: BoolArray | None = None) -> float:
    """The speed at rest, m/s: of next to no command; 0 where there is no rest.

    u (n,); speed (n,): dx/dt, m/s.
    """
    rests = np.abs(u) < float(np.abs(u).max(initial=0.0)) / BINS
    rests &= True if is_settled is None else is_settled
    return float(np.median(speed[rests])) if rests.any() else 0.0


def shut_band(u: FloatArray, speed: FloatArray, is_settled: BoolArray | None = None) -> float:
    """A |u| up to which the motion is surely that at rest, for u > 0 and for u < 0 alike.

    u (n,) in the unit that it was recorded in; speed (n,): dx/dt, m/s, of either sign.
    """
    top = float(np.abs(u).max(initial=0.0))
    fast = float(np.quantile(np.abs(speed), 0.99)) if len(u) else 0.0
    if top == 0.0 or fast == 0.0:
        return 0.0
    beyond = (speed - creep(u, speed, is_settled)) / fast
    every = np.ones(len(u), bool)
    usable = every if is_settled is None else is_settled

    def surely(w: FloatArray) -> float:
        """Where commands keep jumping, motion begins late and runs on: the earlier counts."""
        begins = _begins(w, beyond, usable)
        return min(HALF * begins, max(HALF * _begins(w, beyond, every), LEAST * begins))

    return min(surely(way * u / top) for way in (1, -1)) * top


def neutral_within(u: FloatArray, speed: FloatArray) -> float:
    """The neutral of a command of one sign that drives both ways: 4 to 20 mA rest at 12.

    0 of any other: it is counted from its neutral, or drives one way, or the machine goes either
    way at the same command.  Where it stands, as plants without pressures take it, was the end of
    the dead band on which a load leant: 12.9 mA.  Before it is switched on such a command rests at
    its least, 4 mA, and that tells nothing.  u (n,) in any unit; speed (n,): dx/dt, m/s.
    """
    neutral = _neutral_of(u, speed)
    if neutral or not len(u):
        return neutral
    is_on = u > u.min() + np.ptp(u) / BINS
    return _neutral_of(u[is_on], speed[is_on]) if is_on.any() else 0.0


def _neutral_of(u: FloatArray, speed: FloatArray) -> float:
    """The neutral as above, of all samples (n,) alike."""
    low, high = float(u.min(initial=0.0)), float(u.max(initial=0.0))
    if min(-low, high) > MOVES * (high - low) or np.ptp(u) == 0.0:
        return 0.0
    forward = np.sign(np.sum((u - u.mean()) * speed)) * speed
    neutral = _middle(u, forward, MOVES * float(np.quantile(np.abs(speed), 0.99)))
    obeyed = forward * np.sign(u - neutral)
    obeys = float(obeyed[obeyed > 0.0].sum()) > OBEYS * float(np.abs(speed).sum())
    return neutral if obeys else 0.0


def _middle(u: FloatArray, forward: FloatArray, stands: float) -> float:
    """The middle of the commands (n,) at which the speed (n,) is less, or where it rests most.

    nan where all motion is one way; forward: the larger the larger the command is; stands: m/s.
    """
    low, wide = float(u.min()), float(np.ptp(u))
    place = np.minimum((BINS * (u - low) / wide).astype(int), BINS - 1)
    bins, median = _rising(place, forward)
    if min(-median[0], median[-1]) <= stands:
        return float("nan")
    still, turns = bins[np.abs(median) <= stands], int(np.searchsorted(median, 0.0))
    still = still if len(still) else bins[turns - 1 : turns + 1]
    values, counts = np.unique(u[(place >= still[0]) & (place <= still[-1])], return_counts=True)
    if counts.max() >= COMMON * counts.sum():
        return float(values[counts.argmax()])
    return low + wide * float(still[0] + still[-1] + 1) / (2 * BINS)


def _begins(w: FloatArray, beyond: FloatArray, usable: BoolArray) -> float:
    """The share of the largest command at which motion of one way begins, or one below it.

    w (n,): command as such a share; beyond (n,): speed beyond that at rest, of the top speed.
    Where the speed rises straight, motion is seen as it begins.  Where it rises as the square of
    what is beyond the opening, two speeds tell that: a joystick's ramps left 2 % of the top speed
    at 4 times the opening.  Bins that few samples pass are pooled with those beside them.
    """
    mine, forward = (w > 0.0) & usable, w > 0.0
    if not mine.any():
        return 0.0
    way = np.sign(np.sum(w[forward] * beyond[forward]))
    place = np.minimum((w[mine] * BINS).astype(int), BINS - 1)
    bins, median = _rising(place, way * beyond[mine])
    at = [bins[median > MOVES * WELL**k][:1] / BINS for k in range(3)]
    seen, *more = [float(first[0]) for first in at if len(first)] or [0.0]
    if not more or (len(more) == 2 and more[1] - more[0] >= STRAIGHT * (more[0] - seen)):
        return seen
    return max(2.0 * seen - more[0], LEAST / HALF * seen)


def _rising(place: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bins (k,) that hold any of `place` (n,), and their speeds (k,), as they rise with the bin."""
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - takes long to import

    bins, count = np.unique(place, return_counts=True)
    median = [np.median(speed[place == k]) for k in bins]
    return bins, np.asarray(isotonic_regression(median, weights=count).x)
