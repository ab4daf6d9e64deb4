"""Noise that a filter has coloured: differences of neighbours see next to none of it.

A low-pass at f leaves little near half the sampling rate, which is where differences of high order
look.  Of every k-th sample they look near 1 / (2 k dt): their mean square grows with k until k dt
is longer than the filter remembers, and is then the noise's own.  Motion grows so, too, but noise
is the same at all times: the quantiles of the windows must be those of one noise.  A line of
the spectrum, as a pump's, has windows that are all alike, and is none either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.noise import NoiseEstimate, estimate_noise, measurements, quantile_levels
from rtid.model import SENSORS, Machine
from rtid.plain import FloatArray

ORDER = 8  # of the differences
STRIDES = (1, 2, 4, 8, 16)
SHARES = (0.1, 0.25, 0.5)  # of the windows, by which noise is told from motion
GROWS = 1.3  # times, from each sample to every second one: white noise does not
MOST = 100.0  # times, so far: a filter of fourth order is at 40, a motion at up to 2^ORDER
TOLD = 2.0  # times, from the last stride but one: with so much the cut-off is still known
STEEP = 4.0  # times, that second order grows by an octave: what rounds values may hide it first
HALF, ALL = 0.7, 0.95  # shares of the noise
TINY = 1e-300
ALIKE = 1.12  # ratio of levels by two quantiles of one noise
NEARLY = 1.25  # the same, where motion may begin to show
FEWEST = 20  # windows of the longest stride


@dataclass(frozen=True)
class Coloured:
    """Noise of one signal; filtered_hz: cut-off of its filter, 0 where none is seen or known."""

    noise: NoiseEstimate
    is_filtered: bool = False
    filtered_hz: float = 0.0


def noise_in(t_s: NDArray[np.floating], values: NDArray[np.floating]) -> Coloured:
    """Noise of a signal at t_s (n,), s, white or not; values (n,), any unit; NaN are left out."""
    white = estimate_noise(t_s, values)
    known = np.isfinite(t_s) & np.isfinite(values)
    t, y = measurements(np.asarray(t_s[known], float), np.asarray(values[known], float))
    levels = _levels(t, y, white.sd)
    if len(levels) < 2:
        return Coloured(white)
    sd, growth = float(levels.max()), float(levels[-1] / levels[-2])
    noise = replace(white, sd=sd, relative_sd=float(np.hypot(white.relative_sd, growth - 1.0)))
    if growth > TOLD:  # the motion hides what it grows to
        return Coloured(noise, is_filtered=True)
    return Coloured(noise, True, _cut_off(levels / sd) / float(np.median(np.diff(t))))


def sensor_noise(
    model: Machine, name: str, t_s: NDArray[np.floating], values: NDArray[np.floating]
) -> Coloured:
    """Noise of a signal of a model at t_s (n,), s, values (n,) in SI.

    A filter is looked for in sensors of chambers: a command is what was commanded, and what a rate
    is learned from does not rest on how its noise is coloured.
    """
    if model.has_pressures and model.signals[model.column(name)].kind in SENSORS:
        return noise_in(t_s, values)
    return Coloured(estimate_noise(t_s, values))


def _levels(t_s: FloatArray, values: FloatArray, white_sd: float) -> FloatArray:
    """Noise of every second sample, every fourth ..., as long as it is one; none of a white one.

    Of a filter it grows less from stride to stride; where it grows more, motion has begun.
    """
    levels, growth = [white_sd], MOST
    for stride in STRIDES:
        low, level, high = quantile_levels(t_s, values, ORDER, stride, SHARES, FEWEST)
        is_early = stride <= 2
        is_one = low / ALIKE <= level <= low * (ALIKE if is_early else NEARLY)
        is_one &= not is_early or level / ALIKE <= high <= level * ALIKE
        least = GROWS if stride == 2 else 1.0 / ALIKE
        if not (is_one and least <= level / max(levels[-1], TINY) <= growth):  # never of nan
            break
        if stride > 1:
            growth = max(level / max(levels[-1], TINY), STEEP if stride == 2 else 0.0)
            levels.append(level)
    return np.array(levels[1:])


def _cut_off(shares: FloatArray) -> float:
    """Cut-off times the sampling interval, by the shares of its noise that the strides from 2 show.

    By the one that is nearest to `HALF`: there the order of the filter matters least.
    """
    rising = shares[: max(1, int((shares >= ALL).argmax()))]  # the largest share is 1
    at = int(np.abs(np.log(rising / HALF)).argmin())
    cuts, seen = _seen(STRIDES[1 + at])
    return float(np.exp(np.interp(shares[at], seen, np.log(cuts))))


@cache
def _seen(stride: int) -> tuple[FloatArray, FloatArray]:
    """Cut-offs (m,), 1 / samples, of digital filters of second order, and what a stride sees."""
    cuts = np.geomspace(0.01, 0.25, 30)
    f = np.linspace(0.0, 0.5, 5001)[1:-1]
    passed = 1.0 / (1.0 + (np.tan(np.pi * f) / np.tan(np.pi * cuts[:, None])) ** 4)
    gain = (2.0 * np.sin(stride * np.pi * f)) ** (2 * ORDER) / comb(2 * ORDER, ORDER)
    shares = np.sqrt((passed * gain).sum(axis=1) / passed.sum(axis=1))
    return cuts, np.maximum.accumulate(shares)
