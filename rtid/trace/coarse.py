"""A position in steps of q, slower than a step per sample: it is known where it crosses a step.

Between two crossings the error of what is written runs once through -q / 2 .. q / 2: it is no noise
from sample to sample, and no mean over samples makes it smaller.  At the first sample behind a
crossing the piston is beyond the border b by a part of its way v T from sample to sample:

    x = b + sgn(v) w / 2,   w = min(|v| T, q),   error: even, of deviation w / sqrt(12).

These are from crossing to crossing independent of one another, and smaller: of 0.1 mm and
30 mm/s at 1 kHz 9 um, not 29.  So a row of the position is where it crosses, and between rows it is
on a line, as it is between two messages.  A border that is crossed to and fro within a few samples,
which the sensor's noise does, is one crossing, in their middle.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.estimator.noise import NoiseEstimate, divided_squares, estimate_noise
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, IntArray

QUIET = 1.3  # times q / sqrt(12): a sensor that is noisier spreads what it writes over its steps
ALIKE = 1.15  # times what white noise leaves of the mean of two: from there on errors are alike
TINY = 1e-300
FEWEST = 300  # crossings, to learn by them
LINGERS = 10  # samples, within which a border that is crossed again is the same crossing
ORDERS = range(4, 8)  # of the differences that tell the noise beside the way of a sample
WINDOW = 32  # crossings, of which the differences' mean is one figure
FEWEST_QUICK = 20  # windows of samples that tell the noise of quick motion
SLOWEST = 0.25  # of these figures, that tell the sensor's own noise


@dataclass(frozen=True)
class Crossings:
    """Where a position crosses its steps: samples at (m,), x_m (m,) there, m; way_m (m,): w, m."""

    at: IntArray
    x_m: FloatArray
    way_m: FloatArray

    def noise(self, t_s: FloatArray, quick_m2: float = 0.0) -> NoiseEstimate:
        """What is left of the steps as `resolution`, and the sensor's own noise; t_s (m,), s.

        Of the squares of differences, the sensor's own is what is beyond that of the ways: these
        differ from crossing to crossing, it does not.  Instants that it makes uneven hide it:
        quick_m2, what quick motion shows of it (`in_quick_motion`).
        """
        ways2 = float(np.mean(self.way_m**2))
        own2 = [_own(t_s, self.x_m, self.way_m, order) for order in ORDERS]
        sd = float(np.sqrt(ways2 / 12.0 + max(0.0, min(own2), quick_m2)))
        n = len(self.x_m)
        return NoiseEstimate(sd, float(np.sqrt(ways2)), float(np.sqrt(0.5 / n)), n)


def at_crossings(model: Machine, samples: Samples) -> tuple[Samples, NoiseEstimate | None]:
    """Samples whose rows are the crossings of a coarse position, and its noise there, SI.

    As they are, and None, where its noise or a quick motion spreads it over its steps as if white,
    or where it crosses few.
    """
    rows = np.flatnonzero(samples.flags & ROW)
    if model.measured or len(rows) < FEWEST:  # where a rate is measured x is its sum
        return samples, None
    t_s, x_m = np.multiply(1e-6, samples.t_us[rows]), samples.column(model.position)[rows]
    raw = estimate_noise(t_s, x_m)
    if not 0.0 < raw.sd < QUIET * raw.resolution / np.sqrt(12.0):
        return samples, None
    fresh = np.diff(np.cumsum((samples.flags & GAP) != 0)[rows], prepend=-1) != 0
    found = crossings(x_m, raw.resolution, fresh)
    if len(found.at) < FEWEST:
        return samples, None
    lines = _with_rows(model, samples, rows, found, fresh)
    error = x_m - lines.column(model.position)[rows]
    if _like_white(error) < ALIKE:
        return samples, None
    return lines, found.noise(t_s[found.at], in_quick_motion(x_m, raw.resolution, fresh))


def _like_white(error: FloatArray) -> float:
    """Variance of the means of two neighbours of error (n,) over that of white noise's."""
    pairs = error[: len(error) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return 2.0 * float(pairs @ pairs) / max(1, len(pairs)) / max(float(np.mean(error**2)), TINY)


def in_quick_motion(x_m: FloatArray, step_m: float, fresh: BoolArray) -> float:
    """Variance of the sensor's own noise, m2, of a position x_m (n,) in steps of step_m, m.

    Where it goes a step and more from sample to sample its rounding is white, q^2 / 12, and what
    differences tell beyond that is the sensor's.  fresh (n,): nothing is known before it.  0 where
    too little is quick.
    """
    told = []
    for order in ORDERS:
        n = (len(x_m) - order) // WINDOW
        square = np.diff(x_m, order)[: n * WINDOW] ** 2 / comb(2 * order, order)
        moved, begins = np.abs(np.diff(x_m)), fresh[1:]
        way, cut = (v[: n * WINDOW].reshape(n, WINDOW) for v in (moved, begins))
        quick = (way.mean(axis=1) >= step_m) & ~cut.any(axis=1) & ~np.roll(cut.any(axis=1), -1)
        if quick.sum() < FEWEST_QUICK:
            return 0.0
        told.append(float(np.median(square.reshape(n, WINDOW).mean(axis=1)[quick])))
    return max(0.0, min(told) - step_m**2 / 12.0)


def crossings(x_m: FloatArray, step_m: float, fresh: BoolArray) -> Crossings:
    """The crossings of a position x_m (n,) in steps, m; fresh (n,): nothing is known before it."""
    level = np.round((x_m - x_m[0]) / step_m)
    at = np.flatnonzero((np.diff(level, prepend=level[0]) != 0.0) & ~fresh)
    way = np.sign(level[at] - level[at - 1])
    border = level[at] - 0.5 * way
    again = (np.diff(border) == 0.0) & (np.diff(at) <= LINGERS)
    first = np.flatnonzero(np.append(True, ~again)) if len(at) else np.zeros(0, np.int64)
    size = np.diff(np.append(first, len(at)))
    middle = first + size // 2
    at, way, border = at[middle], way[middle], border[middle]
    rate = np.zeros(len(at))
    rate[1:-1] = (border[2:] - border[:-2]) / (at[2:] - at[:-2])
    goes = np.where(size > 1, 0.0, np.clip(way * rate, 0.0, 1.0))
    return Crossings(at, x_m[0] + step_m * (border + 0.5 * way * goes), step_m * goes)


def _with_rows(
    model: Machine, samples: Samples, rows: IntArray, by: Crossings, fresh: BoolArray
) -> Samples:
    """Samples with a row where a crossing is, and the position on a line between those of a run."""
    at, column = rows[by.at], samples.names.index(model.position)
    flags, values = samples.flags & ~np.uint8(ROW), samples.values.copy()
    flags[at] |= ROW
    runs = np.append(rows[fresh], len(samples))
    for begin, end in itertools.pairwise(runs.tolist()):
        mine = slice(*np.searchsorted(at, (begin, end)))
        if len(at[mine]):
            inside, t_us = slice(begin, end), samples.t_us
            values[inside, column] = np.interp(t_us[inside], t_us[at[mine]], by.x_m[mine])
    return replace(samples, values=values, flags=flags)


def _own(t_s: FloatArray, x_m: FloatArray, way_m: FloatArray, order: int) -> float:
    """Variance of the sensor's own noise, m2, by differences of one order at uneven t_s (m,)."""
    seen, of_ways = divided_squares(t_s, x_m, way_m**2 / 12.0, order)
    n = len(seen) // WINDOW * WINDOW
    seen, of_ways = (v[:n].reshape(-1, WINDOW).mean(axis=1) for v in (seen, of_ways))
    slow = np.argsort(of_ways)[: max(1, int(SLOWEST * len(of_ways)))]
    return float(np.median((seen - of_ways)[slow])) if len(slow) else 0.0
