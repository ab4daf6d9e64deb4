"""Noise of a filtered sensor as it was before its filter, which is what slow rows are made of.

Behind a low-pass H(f) white noise of variance s^2 has s^2 mean |H|^2 in all, but its density at low
frequencies is what it was.  The rows of a fit are band-limited to some 10 Hz: there the noise
counts as white of variance s^2, and by what the filter has left a healthy record had 2.6 and 14
times its noise.  Differences of order m of every k-th sample see of s^2

    share_k = mean(|H(f)|^2 (2 sin(pi k f dt))^2m) / C(2m, m),   |H|^2 = 1 / (1 + (f / f_c)^2n),

with f warped as a digital filter has it.  By what several k see n, f_c and s are told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.coloured import Coloured, sensor_noise
from rtid.estimator.noise import measurements, quantile_levels
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

DIFFERENCE = 8  # order of the differences
STRIDES = (1, 2, 3, 4, 6, 8, 12, 16)
POLES = (1, 2, 3, 4)
QUANTILES = (0.1, 0.25, 0.5)  # of the windows, by which noise is told from motion
ALIKE = 1.12  # ratio of two quantiles' levels that are of one noise
FEWEST_WINDOWS = 20
FEWEST_LEVELS = 3  # strides, to tell size, cut-off and poles
FARTHEST = 4.0  # times the largest level, that the noise before the filter may be to be told
FITS = 0.03  # rms of the logarithms up to which the levels are those of a filter
CUTS = np.geomspace(0.01, 0.4, 150)  # cut-offs times the sampling interval


@dataclass(frozen=True)
class LowPass:
    """A filter of so many poles that has made noise of sd before it; cut: f_c dt; rms: misfit."""

    poles: int
    cut: float
    sd: float
    rms: float


def noise_before(
    model: Machine, name: str, t_s: NDArray[np.floating], values: NDArray[np.floating]
) -> Coloured:
    """`sensor_noise` of values (n,), SI, at t_s (n,), s; of a filtered sensor that before it.

    As it is behind the filter where the differences do not tell which filter it was.
    """
    behind = sensor_noise(model, name, t_s, values)
    if not behind.is_filtered:
        return behind
    known = np.isfinite(t_s) & np.isfinite(values)
    t, y = measurements(np.asarray(t_s[known], float), np.asarray(values[known], float))
    # in SI rounding may hide the steps of what was written in another unit
    steps = {behind.noise.resolution, model.signals[model.column(name)].resolution}
    low_passes = [f for step in steps if (f := filter_of(t, y, step)) is not None]
    best = min(low_passes, key=lambda f: f.rms, default=None)
    if best is None or best.sd < behind.noise.sd:
        return behind
    noise = replace(behind.noise, sd=float(np.hypot(best.sd, max(steps) / np.sqrt(12.0))))
    return Coloured(noise, True, best.cut / float(np.median(np.diff(t))))


def filter_of(t_s: FloatArray, values: FloatArray, step: float) -> LowPass | None:
    """The filter behind which values (n,) at t_s (n,), s, were rounded to steps; None: not told."""
    levels2 = _levels2(t_s, values, step**2 / 12.0)
    known = np.flatnonzero(levels2)
    for m in range(len(known), FEWEST_LEVELS - 1, -1):  # of the longest strides motion may be part
        seen = 0.5 * np.log(levels2[known[:m]])
        best = min((_nearest(poles, seen, known[:m]) for poles in POLES), key=lambda f: f.rms)
        if best.rms < FITS:
            return best if np.log(best.sd / FARTHEST) < seen[-1] else None
    return None


def _levels2(t_s: FloatArray, values: FloatArray, rounding2: float) -> FloatArray:
    """Mean squares (strides,) that differences see of the noise beside that of rounding.

    0 where rounding hides it, and from where motion begins.
    """
    seen = np.zeros(len(STRIDES))
    for k, stride in enumerate(STRIDES):
        levels = quantile_levels(t_s, values, DIFFERENCE, stride, QUANTILES, FEWEST_WINDOWS)
        is_one = np.max(levels) < ALIKE * np.min(levels)  # never of nan
        if seen.any() and not is_one:
            break
        of_noise2 = float(levels[1]) ** 2 - rounding2
        seen[k] = of_noise2 if is_one and of_noise2 > rounding2 else 0.0
    return seen


def _nearest(poles: int, seen: FloatArray, strides: IntArray) -> LowPass:
    """The filter of so many poles by which logarithms (m,) of levels come nearest to one sd."""
    sds = seen - _log_shares(poles)[:, strides]
    scatter = sds.std(axis=1)
    at = int(scatter.argmin())
    return LowPass(poles, float(CUTS[at]), float(np.exp(sds[at].mean())), float(scatter[at]))


@cache
def _log_shares(poles: int) -> FloatArray:
    """Logarithms (cut-offs, strides) of what differences see, times the deviation before."""
    f = np.linspace(0.0, 0.5, 5001)[1:-1]
    passed = 1.0 / (1.0 + (np.tan(np.pi * f) / np.tan(np.pi * CUTS[:, None])) ** (2 * poles))
    order = 2 * DIFFERENCE
    gains = [(2.0 * np.sin(k * np.pi * f)) ** order / comb(order, DIFFERENCE) for k in STRIDES]
    return 0.5 * np.log(passed @ np.array(gains).T / len(f))
