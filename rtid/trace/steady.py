"""Stamps of a sender with a steady period, which a busy logger writes late, now more, now less.

A computer without stamps of hardware reads its clock when it comes to it: the sensors were sampled
at a + k T, the stamp is that and a delay tau_k.  A signal y that moves is then off by y'(t) tau_k:
0.1 m/s and 0.4 ms are 40 um.  The grid is the line through the stamps, counted on where rows are
lost.  Whether the sensors were sampled on it or at the stamps is no matter of belief, they tell:

    D y_k = c D (y' tau)_k + D noise,    D: differences of order 4,

with c = 0 of a steady sender and c = 1 of one that samples when it stamps.  Where they do not tell,
the stamps stay.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rtid.plain import BoolArray, FloatArray, IntArray

EVEN, EVEN_US = 0.02, 60.0  # of the period, and us: stamps that scatter less are good enough
LOOSEST = 1.0  # of the period, by which stamps may scatter: beyond it rows cannot be counted
PAUSE = 8.0  # periods: a longer step is a gap of the log, behind which the phase is another
FEWEST = 400  # rows of a run, that show a period
BLOCK = 50  # rows, whose median stamp tells the period whatever is lost elsewhere
LATE, LOST = 1.25, 0.5  # periods: a step behind which rows may be lost, a delay that says so
DIFFERS = 0.3  # of the period, from block to block: rows may be lost in between
NEAR = 3.0  # of its deviation: so far the medians of the delays may wander from a line
WANDERS = 0.25  # share by which two figures of one thing may differ
PASSES = 2  # in which the lost rows are counted, by a better period each time
ORDER, REACH = 4, 8  # of the differences; rows on either side that a slope is taken over
SURE = 3.0  # deviations by which the sensors must tell which of the two it is
OVERLAP = 2.0  # times the deviation of independent differences


@dataclass(frozen=True)
class SteadyGrid:
    """Instants (n,) of the steady sender and late_us (n,): how much later rows are stamped, us.

    count (n,): which instant of the sender a row is of; period_us: that of the longest run.
    late_us has the median 0 in each run.
    """

    t_us: FloatArray
    late_us: FloatArray
    count: IntArray
    period_us: float

    @property
    def jitter_s(self) -> float:
        """Root mean square of how late the stamps are, beside their median."""
        return 1e-6 * float(np.sqrt(np.mean(self.late_us**2)))


def grid_of(t_us: IntArray) -> SteadyGrid | None:
    """The grid of stamps (n,), us, that scatter about one; None: they are even, or have none."""
    t = np.asarray(t_us, np.float64)
    steps = np.diff(t)
    if len(t) < FEWEST or steps.min() < 0.0 or not _scatters(steps):
        return None
    usual = float(np.median(steps))
    borders = np.concatenate([[0], np.flatnonzero(steps > PAUSE * usual) + 1, [len(t)]])
    grid, count, first = t.copy(), np.zeros(len(t), np.int64), 0
    for begin, end in itertools.pairwise(borders.tolist()):
        fitted = _of_run(t[begin:end], usual) if end - begin >= FEWEST else None
        if fitted is None and end - begin >= FEWEST:
            return None
        if fitted is not None:
            grid[begin:end], count[begin:end] = fitted
        count[begin:end] += first
        first = int(count[end - 1]) + ORDER + 2 * REACH + 1  # no difference is taken across
    k = int(np.argmax(np.diff(borders)))
    begin, end = borders[k], borders[k + 1] - 1
    if end - begin < FEWEST:
        return None
    period = (grid[end] - grid[begin]) / float(count[end] - count[begin])
    return SteadyGrid(grid, t - grid, count, period)


def period_of(t_us: IntArray) -> float:
    """The period of stamps (n,), us: the usual step, of those that jitter that of their sender."""
    grid = grid_of(t_us)
    return float(np.median(np.diff(t_us))) if grid is None else float(round(grid.period_us))


def _scatters(steps: FloatArray) -> bool:
    """Whether steps (n,), us, differ more than rounding does, and no more than can be counted."""
    usual = float(np.median(steps))
    low, high = np.quantile(steps, (0.16, 0.84))
    apart_us = 0.5 * float(high - low)
    return usual > 0.0 and max(EVEN_US, EVEN * usual) < apart_us < LOOSEST * usual


def _of_run(t: FloatArray, usual: float) -> tuple[FloatArray, IntArray] | None:
    """Instants (n,), us, and counts (n,) of a run of stamps (n,), us, without a pause."""
    i = np.arange(len(t))
    period = float(np.median(np.diff(_medians(t, BLOCK)))) / BLOCK
    if abs(period - usual) > WANDERS * usual:
        return None
    count = i
    for _ in range(PASSES):  # behind many lost rows the median step is none of the sender's
        count = i + _lost_before(t - period * i, np.diff(t), period)
        period = float(np.polynomial.Polynomial.fit(count, t, 1).deriv()(0.0))
    line = np.polynomial.Polynomial.fit(count, t, 1)
    late = t - line(count)
    for _ in range(2):  # what the computer was away for tells nothing of the sender
        near = np.abs(late - np.median(late)) < 2 * NEAR * _spread(late)
        line = np.polynomial.Polynomial.fit(count[near], t[near], 1)
        late = t - line(count)
    grid = line(count) + _wandering(late)
    if np.abs(np.diff(_medians(t - grid, FEWEST // 2))).max() > LOST * period:
        return None
    return grid + float(np.median(t - grid)), count


def _medians(values: FloatArray, rows: int) -> FloatArray:
    """Median of each whole block, of so many rows, of values (n,)."""
    n = len(values) // rows * rows
    return np.median(values[:n].reshape(-1, rows), axis=1)


def _spread(late: FloatArray) -> float:
    """A deviation that few outliers do not move."""
    return 1.4826 * float(np.median(np.abs(late - np.median(late))))


def _lost_before(late: FloatArray, steps: FloatArray, period: float) -> IntArray:
    """Rows lost before each of the stamps (n,), of which late (n,), us, is left by the index.

    steps (n - 1,), us.  Behind lost rows all are later by so many periods; behind a late stamp none
    is.
    """
    late, lost = late.copy(), np.zeros(len(late), np.int64)
    scatter = _spread(late[:FEWEST]) / period
    width = int(np.clip(2 * (12.5 * scatter) ** 2, 16, FEWEST))
    done, may = -1, steps > LATE * period
    for k in np.flatnonzero(may & _is_stepped(late, period)).tolist():
        if k <= done:
            continue
        number = round((_after(late, k, width) - _before(late, k, width)) / period)
        if number < 1:
            continue
        done = _place(late, k, width, number * period, may)
        late[done + 1 :] -= number * period
        lost[done + 1 :] += number
    return lost


def _is_stepped(late: FloatArray, period: float) -> BoolArray:
    """Where, (n - 1,), rows may be lost: delays late (n,), us, differ there from block to block.

    What is before the first middle and behind the last is not seen: there it may always be.
    """
    stepped = np.abs(np.diff(_medians(late, BLOCK))) > DIFFERS * period
    of_block = np.append(stepped, True) | np.append(True, stepped)
    every = np.repeat(of_block, BLOCK)
    rest = max(0, len(late) - 1 - len(every))
    return np.pad(every, (0, rest), constant_values=True)[: len(late) - 1]


def _before(late: FloatArray, k: int, width: int) -> float:
    return float(np.median(late[max(0, k + 1 - width) : k + 1]))


def _after(late: FloatArray, k: int, width: int) -> float:
    return float(np.median(late[k + 1 : k + 1 + width]))


def _place(late: FloatArray, k: int, width: int, step: float, may: BoolArray) -> int:
    """The row from k on behind which others are most likely lost: the rest scatters least so."""
    before = _before(late, k, width)
    part = late[k + 1 : k + 1 + width] - before
    # cost of a step behind part[j]: what is up to j is not stepped, what is behind is
    gain = np.concatenate([[0.0], np.cumsum(np.abs(part) - np.abs(part - step))])
    at = k + np.flatnonzero(may[k : k + len(part)])
    return int(at[np.argmin(gain[at - k])])


def _wandering(late: FloatArray) -> FloatArray:
    """How two clocks drift apart (n,), us, beside a line, by late (n,); 0 where they do not."""
    rows = max(BLOCK, len(late) // max(1, len(late) // (20 * BLOCK)))
    middle = _medians(late, rows)
    noise = 1.2533 * _spread(late) / np.sqrt(rows)
    if len(middle) < 3 or np.abs(middle - np.median(middle)).max() < NEAR * 2 * noise:
        return np.zeros(len(late))
    at = rows * (np.arange(len(middle)) + 0.5) - 0.5
    return np.interp(np.arange(len(late)), at, middle)


@dataclass(frozen=True)
class SeenMoving:
    """How sensors moved with the stamps: c of each of k sensors, and its deviation, (k, 2)."""

    shares: FloatArray

    @property
    def share(self) -> tuple[float, float]:
        """The c of all of them, and its deviation; nan and inf where none tells."""
        weight = self.shares[:, 1] ** -2
        if not len(weight):
            return float("nan"), float("inf")
        return float(self.shares[:, 0] @ weight / weight.sum()), float(weight.sum() ** -0.5)

    @property
    def says_grid(self) -> bool:
        """Whether they were surely sampled on the grid."""
        share, sd = self.share
        return share + SURE * sd < LOST and abs(share) < WANDERS + SURE * sd

    @property
    def says_stamps(self) -> bool:
        """Whether they surely moved with the stamps."""
        share, sd = self.share
        return share - SURE * sd > WANDERS


def seen_moving(grid: SteadyGrid, sensors: Iterable[FloatArray]) -> SeenMoving:
    """What sensors (n,), in any unit, tell of the instants at which they were sampled."""
    told = [pair for y in sensors if (pair := _moves_with(grid, y)) is not None]
    return SeenMoving(np.array(told).reshape(-1, 2))


def joined(parts: Iterable[SeenMoving]) -> SeenMoving:
    """What the sensors of several messages, stamped by one clock, tell together."""
    return SeenMoving(np.vstack([np.zeros((0, 2)), *(part.shares for part in parts)]))


def _moves_with(grid: SteadyGrid, y: FloatArray) -> tuple[float, float] | None:
    """The share c of a sensor y (n,) and its deviation; None for one that tells nothing."""
    slope, whole = np.zeros(len(y)), np.zeros(len(y), bool)
    centre = slice(REACH, -REACH)
    slope[centre] = (y[2 * REACH :] - y[: -2 * REACH]) / (2.0 * REACH * grid.period_us)
    whole[centre] = (grid.count[2 * REACH :] - grid.count[: -2 * REACH]) == 2 * REACH
    whole &= np.isfinite(y) & np.isfinite(slope)
    here = np.convolve(~whole, np.ones(ORDER + 1), "valid") == 0
    moved, seen = (np.diff(v, ORDER)[here] for v in (slope * grid.late_us, y))
    square = float(moved @ moved)
    if not square > 0.0:
        return None
    share = float(moved @ seen) / square
    rest = seen - share * moved
    sd = OVERLAP * float(np.sqrt((moved**2) @ (rest**2))) / square
    return (share, sd) if sd > 0.0 else None
