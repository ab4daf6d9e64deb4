"""Sensor noise from the trace itself, where nobody has declared it.

White noise of variance s^2 gives the m-th difference of a signal the variance s^2 C(2m, m); smooth
motion loses a factor (2 pi f dt)^m.  So the differences' mean square falls with m to the noise's
floor and stays there.  It is taken over the windows in which nothing else happened: those that lie
within the chi-square scatter of their own floor.  A signal in steps of q has at least q^2/12.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from rtid.plain import BoolArray, FloatArray

ORDERS = range(2, 9)
WINDOW = 32  # differences per window: shorter than the time between two steps of a command
FEWEST = 4  # windows that tell of a noise
QUIET = 0.25  # the quantile of the windows that the floor starts from
LIKELY = 0.999  # of the clean windows lie below the limit that counts as quiet
ROUNDING = 1e-8  # share of the largest value below which steps are rounding errors
SINGLE = 2.0**-24  # of the largest value, that one in single precision is off by
DISTINCT = 20.0  # times what values are off by, from which on a step is none of their rounding
RECURS = 4  # times that a level is come to, of a signal whose steps were written in finer ones
FEW_LEVELS = 6
HELD_SHARE = 0.3  # of equal neighbours, from which on repeats are looked at
EVEN = 0.01  # scatter of the sampling intervals up to which plain differences do
OFTEN, GAP = 0.95, 1.5  # times what so many steps stay below: a longer one is a gap
FINEST = 2.0**-24  # of a signal's span, that its sensor tells at best; what is less is no noise
SINGLE_RUNS = 0.2  # share of values that come once, up to which a signal is held


@dataclass(frozen=True)
class NoiseEstimate:
    """White noise of one signal, in its unit; samples: measurements that tell of it.

    sd: 1 sigma in all, quantisation included; resolution: the quantisation step, 0 where there is
    none; relative_sd: standard deviation of sd as a share of it, inf where nothing is known.
    """

    sd: float
    resolution: float
    relative_sd: float
    samples: int

    @property
    def analogue_sd(self) -> float:
        """The sensor's own noise, to be declared beside its resolution."""
        return float(np.sqrt(max(0.0, self.sd**2 - self.resolution**2 / 12.0)))


def estimate_noise(
    t_s: NDArray[np.floating], values: NDArray[np.floating], held_command: bool = False
) -> NoiseEstimate:
    """Noise of a signal sampled at t_s (n,) with values (n,); NaN are left out.

    held_command: the signal is a command, which is what was commanded: only its steps count.
    """
    values = np.asarray(values, np.float64)  # differences of unsigned counts would wrap
    t_s = np.asarray(t_s, np.float64)
    known = np.isfinite(t_s) & np.isfinite(values)
    t, y = t_s[known], values[known]
    every = np.unique(y)
    step, levels = _resolution(y, every), len(every)
    if held_command and levels < FEW_LEVELS:
        step = 0.0  # the levels of a switched command
    least = float(step / np.sqrt(12.0))
    if held_command:
        return NoiseEstimate(least, step, 0.0, len(y))
    t, y = measurements(t, y)
    spacing = _Spacing.of(t)
    floors = [f for m in ORDERS if (f := _floor(spacing, y, m)) is not None]
    if not floors or levels < 2:
        return NoiseEstimate(least, step, np.inf, 0)
    sd, relative_sd, samples = _settled(floors)
    if sd < least:
        return NoiseEstimate(least, step, max(relative_sd, 1.0 - sd / least), samples)
    return NoiseEstimate(sd, step, relative_sd, samples)


def pooled(estimates: Sequence[NoiseEstimate]) -> NoiseEstimate:
    """One sensor's noise by several records: the mean square by the measurements of each."""
    known = [e for e in estimates if np.isfinite(e.relative_sd)] or list(estimates)
    samples = np.array([max(1, e.samples) for e in known], np.float64)
    share = samples / samples.sum()
    sd = float(np.sqrt(share @ np.array([e.sd for e in known]) ** 2))
    relative = float(np.sqrt(share**2 @ np.array([e.relative_sd for e in known]) ** 2))
    return NoiseEstimate(sd, max(e.resolution for e in known), relative, int(samples.sum()))


def resolution_of(values: FloatArray) -> float:
    """The step of which all differences of values (n,) are multiples, in their unit; 0: none.

    Euclid's algorithm, or where values are rounded, in single precision or to few decimals, the
    even step that their levels have but for that.

    With few levels they must be neighbours: what a signal jumps between is not its resolution.
    """
    return _resolution(values, np.unique(values))


def _resolution(values: FloatArray, levels: FloatArray) -> float:
    """The step of values (n,), which have those levels, sorted.

    A pressure in steps of 6104 Pa, written in hundreds of Pa, has levels 61 or 62 of those apart.
    A ramp has even levels too, by its speed, but comes to each of them once.
    """
    if len(levels) < 2:
        return 0.0
    step, single = _common_step(levels), SINGLE * float(np.abs(levels).max())
    changes = np.count_nonzero(np.diff(values))
    if step > 4.0 * single and changes < RECURS * len(levels):  # no bits of its last place
        return step
    return _even_step(levels, max(0.5 * step, single)) or step


def _even_step(levels: FloatArray, off: float) -> float:
    """The step of levels (m,), sorted, that are off it by so much at most; 0: there is none."""
    gaps = np.diff(levels)
    if len(levels) < FEW_LEVELS or gaps.min() < DISTINCT * off:
        return 0.0
    count = np.append(0.0, np.cumsum(np.round(gaps / gaps.min())))
    count -= count.mean()
    step = float(count @ levels / (count @ count))
    beside = np.abs(levels - levels.mean() - step * count).max()
    return step if beside <= 2.0 * off else 0.0


def _common_step(levels: FloatArray) -> float:
    """The step of which all differences of levels (m,), sorted, are multiples; 0: none."""
    rounding = ROUNDING * float(np.abs(levels).max())
    rest = np.unique(np.diff(levels))
    step, rest = float(rest[-1]), rest[rest > rounding]
    while len(rest):
        step = float(rest[0])
        rest_of = np.abs(rest - step * np.round(rest / step))
        rest_of = rest_of[rest_of > rounding]
        rest = np.unique(np.append(rest_of, step)) if len(rest_of) else rest_of
    span = float(levels[-1] - levels[0])
    apart = len(levels) < FEW_LEVELS and span > (len(levels) - 0.5) * step
    return 0.0 if apart or step < 10 * rounding else _refined(levels, step)


def _refined(levels: FloatArray, step: float) -> float:
    """The step by least squares over all levels."""
    count = np.round((levels - levels[0]) / step)
    return float(count @ (levels - levels[0]) / (count @ count))


def measurements(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One sample (n,) per measurement: without the repeats by which a slow message fills its gaps.

    Held values come at least twice nearly always; quantised ones often come once.
    """
    change = np.flatnonzero(np.diff(values) != 0.0) + 1
    if len(change) < 3 or 1.0 - len(change) / len(values) < HELD_SHARE:
        return t_s, values
    runs = np.diff(change)
    if np.mean(runs == 1) > SINGLE_RUNS:
        return t_s, values
    lengths, counts = np.unique(runs, return_counts=True)
    hold = int(lengths[counts.argmax()])
    times = np.maximum(1, np.round(runs / hold).astype(int))
    first = np.repeat(change[:-1], times)
    nth = np.arange(len(first)) - np.repeat(np.cumsum(times) - times, times)
    return t_s[np.minimum(first + nth * hold, len(t_s) - 1)], values[first]


@dataclass(frozen=True)
class _Spacing:
    """Instants t_s (n,), and the steps between them (n - 1,) that differ, or that are gaps."""

    t_s: FloatArray
    is_even: bool
    apart: tuple[BoolArray, BoolArray]

    @classmethod
    def of(cls, t_s: FloatArray) -> _Spacing:
        step = np.diff(t_s)
        if not len(step):
            return cls(t_s, True, (step > 0.0, step > 0.0))
        usual = np.median(step)
        uneven = np.abs(step - usual) > 0.5 * usual
        broken = (step > GAP * np.quantile(step, OFTEN)) | (step <= 0.0)
        return cls(t_s, bool(np.ptp(step) < EVEN * usual), (uneven, broken))


@dataclass(frozen=True)
class _Floor:
    sd: float
    relative_sd: float
    samples: int


def _floor(spacing: _Spacing, values: FloatArray, order: int) -> _Floor | None:
    """Noise from the order-th differences in quiet windows; None where there are too few."""
    squares = _windows(spacing, values, order)
    if len(squares) < FEWEST:
        return None
    squares = _of_a_sensor(squares, values)
    correlation = _correlation(order)
    dof = WINDOW / correlation
    floor = float(np.quantile(squares, QUIET)) * dof / _chi2(QUIET, dof)
    quiet = squares
    for _ in range(20):
        quiet = squares[squares <= floor * _chi2(LIKELY, dof) / dof]
        before, floor = floor, float(quiet.mean()) if len(quiet) else 0.0
        if abs(floor - before) <= 1e-9 * before:
            break
    n = len(quiet) * WINDOW
    return _Floor(float(np.sqrt(floor)), float(np.sqrt(correlation / (2 * max(n, 1)))), n)


def quantile_levels(
    t_s: FloatArray,
    values: FloatArray,
    order: int,
    stride: int,
    shares: Sequence[float],
    fewest: int,
) -> FloatArray:
    """Noise of values (n,) at t_s (n,), s, that quantiles of the windows tell, one by one.

    By order-th differences of samples a stride apart, all of them; shares (m,) of the windows lie
    below the quantiles.  NaN where there are not so many windows.
    """
    parts = (slice(begin, None, stride) for begin in range(stride))
    squares = np.concatenate([_windows(_Spacing.of(t_s[p]), values[p], order) for p in parts])
    if len(squares) < fewest * stride:
        return np.full(len(shares), np.nan)
    dof = WINDOW / _correlation(order)
    told = [float(np.quantile(squares, share)) * dof / _chi2(share, dof) for share in shares]
    return np.sqrt(told)


def _correlation(order: int) -> float:
    """Times fewer: independent squares that scatter like the correlated ones of a window."""
    return comb(4 * order, 2 * order) / comb(2 * order, order) ** 2


def _of_a_sensor(squares: FloatArray, values: FloatArray) -> FloatArray:
    """Windows in which a sensor can have measured; all where that leaves few.

    A value that is held, or computed at a standstill, says nothing of the noise of the motion.
    """
    shown = squares[squares > (FINEST * np.ptp(values)) ** 2]
    return shown if len(shown) > max(4, QUIET * len(squares)) else squares


def _windows(spacing: _Spacing, values: FloatArray, order: int) -> FloatArray:
    """Mean square of the scaled differences per window (windows,); none reaches over a gap."""
    if len(values) < order + WINDOW:
        return np.zeros(0)
    difference = (
        np.diff(values, order) / np.sqrt(comb(2 * order, order))
        if spacing.is_even
        else _divided(spacing.t_s, values, order)
    )
    n = len(difference) // WINDOW * WINDOW
    squares = np.mean(difference[:n].reshape(-1, WINDOW) ** 2, axis=1)
    for apart in spacing.apart:  # the latter where no two steps are alike
        whole = ~_over(apart, order)[:n].reshape(-1, WINDOW).any(axis=1)
        if np.count_nonzero(whole) >= FEWEST:
            break
    return np.asarray(squares[whole])


def _over(apart: BoolArray, order: int) -> BoolArray:
    """Differences (n - order,) that reach over one of the steps (n - 1,)."""
    across = np.zeros(len(apart) + 1 - order, bool)
    for k in range(order if apart.any() else 0):
        across |= apart[k : k + len(across)]
    return across


def _divided(t_s: FloatArray, values: FloatArray, order: int) -> FloatArray:
    """Divided differences at uneven instants, scaled to gain 1 on white noise."""
    weights = _weights(t_s, order)
    gain = np.sqrt((weights**2).sum(axis=0))
    total = (weights * _neighbours(values, order)).sum(axis=0)
    return np.divide(total, gain, out=np.zeros(len(total)), where=gain > 0)


def divided_squares(
    t_s: FloatArray, values: FloatArray, variance: FloatArray, order: int
) -> tuple[FloatArray, FloatArray]:
    """Squares (n - order,) of divided differences of values (n,), and what noise gives them.

    t_s (n,), s; variance (n,): of independent noise, unit of the values squared.  Both scaled to
    gain 1 on white noise.
    """
    weights2 = _weights(t_s, order) ** 2
    gain2 = weights2.sum(axis=0)
    known = (weights2 * _neighbours(variance, order)).sum(axis=0)
    of_noise = np.divide(known, gain2, out=np.zeros(len(gain2)), where=gain2 > 0)
    return _divided(t_s, values, order) ** 2, of_noise


def _weights(t_s: FloatArray, order: int) -> FloatArray:
    """Weights (order + 1, n - order) of the divided differences at t_s (n,), s."""
    t = _neighbours(t_s / _usual_step(t_s), order)
    weights = np.empty(t.shape)
    for i in range(order + 1):
        product = np.prod(t[i] - np.delete(t, i, axis=0), axis=0)
        weights[i] = np.divide(1.0, product, out=np.zeros(len(product)), where=product != 0)
    return weights


def _neighbours(values: FloatArray, order: int) -> FloatArray:
    """Each of order + 1 neighbours (order + 1, n - order) of values (n,)."""
    n = len(values) - order
    return np.stack([values[i : i + n] for i in range(order + 1)])


def _usual_step(t_s: FloatArray) -> float:
    """Median step that is one: half of the values of a batch may share one stamp."""
    steps = np.diff(t_s)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def _settled(floors: list[_Floor]) -> tuple[float, float, int]:
    """The lowest order from which on the floor no longer falls, and what is left of the fall.

    The orders see the same noise: their difference scatters by the difference of the variances.
    """
    lowest = min(floors, key=lambda f: f.sd)
    for f in floors:
        apart = np.sqrt(max(0.0, lowest.relative_sd**2 - f.relative_sd**2))
        if f.sd <= lowest.sd * (1.0 + 2.0 * apart):
            break
    fall = 1.0 - lowest.sd / f.sd if f.sd > 0 else 0.0
    return f.sd, float(np.hypot(f.relative_sd, fall)), f.samples


def _chi2(share: float, dof: float) -> float:
    """The quantile of chi2; `scipy.stats` takes half a second to import."""
    from scipy.special import gammaincinv  # noqa: PLC0415 - takes long to import

    return 2.0 * float(gammaincinv(0.5 * dof, share))
