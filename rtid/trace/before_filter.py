"""Noise of a filtered sensor as it was before its filter, which is what slow rows are made of.

Behind a low-pass H(f) white noise of variance s^2 has s^2 mean |H|^2 in all, but its density at low
frequencies is what it was.  The rows of a fit are band-limited to some 10 Hz: there the noise
counts as white of variance s^2, and by what the filter has left a healthy record had 2.6 and 14
times its noise.  Differences of order m of every k-th sample see of s^2

    share_k = mean(|H(f)|^2 (2 sin(pi k f dt))^2m) / C(2m, m),   |H|^2 = 1 / (1 + (f / f_c)^2n),

with f warped as a digital filter has it.  By what several k see n, f_c and s are told.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from math import comb

import numpy as np

from rtid.estimator.coloured import Coloured, sensor_noise
from rtid.estimator.noise import measurements, quantile_levels
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray
from rtid.trace.series import Series

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


def noises_before(model: Machine, series: Iterable[Series]) -> dict[str, Coloured]:
    """`sensor_noise` of each of several signals by name, SI; of a filtered sensor that before it.

    A logger filters all that it writes alike: where motion hides of one sensor which filter it was,
    it is that of the others, and the shortest differences tell the noise.  Two pressures whose
    motion did had a third of their variance, beside two that told 58 and 62 Hz: 1.5 times the noise
    was left.  As it is behind the filter where no sensor tells which it was.
    """
    sensors = [_Sensor.of(model, item) for item in series]
    told = [f for s in sensors if (f := s.told) is not None]
    usual = min(told, key=lambda f: f.rms, default=None)
    return {s.name: s.before(s.told or usual) for s in sensors}


@dataclass(frozen=True)
class _Sensor:
    """A signal: its noise behind the filter, and what differences see (strides,) beside each step.

    told: the filter by its own differences; a cut-off there is one in Hz.
    """

    name: str
    behind: Coloured
    step_s: float
    step: float
    levels2: tuple[FloatArray, ...] = ()
    told: LowPass | None = None

    @classmethod
    def of(cls, model: Machine, item: Series) -> _Sensor:
        t_s = 1e-6 * item.t_us
        behind = sensor_noise(model, item.name, t_s, item.value)
        # in SI rounding may hide the steps of what was written in another unit
        steps = {behind.noise.resolution, model.signals[model.column(item.name)].resolution}
        if not behind.is_filtered:
            return cls(item.name, behind, 0.0, max(steps))
        known = np.isfinite(t_s) & np.isfinite(item.value)
        t, y = measurements(np.asarray(t_s[known], float), np.asarray(item.value[known], float))
        step_s = float(np.median(np.diff(t)))
        levels2 = tuple(_levels2(t, y, step**2 / 12.0) for step in sorted(steps))
        low_passes = [f for seen in levels2 if (f := filter_of(seen)) is not None]
        best = min(low_passes, key=lambda f: f.rms, default=None)
        told = replace(best, cut=best.cut / step_s) if best else None
        return cls(item.name, behind, step_s, max(steps), levels2, told)

    def before(self, by: LowPass | None) -> Coloured:
        """Its noise before a filter, which has its cut-off in Hz; behind it where that is more."""
        if by is None or not self.behind.is_filtered:
            return self.behind
        sd = by.sd if by is self.told else self._sd_behind(by)
        if sd < self.behind.noise.sd:
            return self.behind
        noise = replace(self.behind.noise, sd=float(np.hypot(sd, self.step / np.sqrt(12.0))))
        return Coloured(noise, True, by.cut)

    def _sd_behind(self, by: LowPass) -> float:
        """The noise before another sensor's filter, by the shortest differences; 0 if none tell."""
        seen = [(k, float(of[k])) for of in self.levels2 for k in np.flatnonzero(of)[:1]]
        if not seen:
            return 0.0
        k, level2 = max(seen, key=lambda s: s[1])
        at = int(np.argmin(np.abs(CUTS - by.cut * self.step_s)))
        return float(np.exp(0.5 * np.log(level2) - _log_shares(by.poles)[at, k]))


def filter_of(levels2: FloatArray) -> LowPass | None:
    """The filter behind which differences see squares (strides,), in SI; None: not told."""
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
