"""Values of a sensor that jump away and back within milliseconds: no oil and no piston does that.

    s = max(x - opening(x), closing(x) - x),

the grey opening and closing over more samples than such a jump lasts: what is narrower is left in
s, steps and slopes are not, but for a slope's next sample.  A spike stands out from what s usually
is, from the sensor's noise and from what the signal covers.  It stands on what was before it: a
peak of the oil, which more samples lead up to, is higher above the opening over more of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_bridge.samples import GAP, Samples
from rtid.model import POSITION, PRESSURE, Machine, Signal
from rtid.plain import BoolArray, FloatArray

SPIKE = "spike"  # counter of the samples that are left out
LASTS_S, LASTS = 5e-3, 3  # at most, and samples; one of the position may always be
OFTEN = 0.95  # quantile of the steps that a spike's samples may be apart: most signals are on lines
USUAL, TIMES = 0.98, 12.0  # quantile of s, and how far a spike stands above it
LEAST_SD = 20.0  # of the sensor's noise
LEAST_SHARE, SPANNED = 0.05, (0.01, 0.99)  # of what the signal covers between these quantiles
WIDER, STEEP = 3, 0.5  # times as many samples, and the share that s is of that over them
FEWEST, PASSES = 100, 5  # samples, to know what is usual; times that it is asked anew


def without_spikes(model: Machine, samples: Samples) -> tuple[Samples, dict[str, int]]:
    """The samples less those in which a pressure or the position spikes, and how many they are.

    The one behind them carries GAP: nothing is integrated across.  Once the first are gone it is
    better known what is usual: others may stand out.
    """
    rest = samples
    for _ in range(PASSES):
        spiked = _any_spikes(model, rest)
        if not spiked.any():
            break
        flags = np.where(np.append(False, spiked[:-1]), rest.flags | GAP, rest.flags)
        kept = ~spiked
        rest = replace(rest, t_us=rest.t_us[kept], values=rest.values[kept], flags=flags[kept])
    left_out = len(samples) - len(rest)
    return rest, {SPIKE: left_out} if left_out else {}


def _any_spikes(model: Machine, samples: Samples) -> BoolArray:
    """Samples (n,) in which any pressure or the position spikes."""
    spiked = np.zeros(len(samples), bool)
    if len(samples) < FEWEST:
        return spiked
    step_s = 1e-6 * float(np.quantile(np.diff(samples.t_us), OFTEN))
    most = min(LASTS, int(LASTS_S / step_s))
    longest = {PRESSURE: most, POSITION: max(1, most)}  # a piston is slower than oil
    for signal in model.signals:
        if longest.get(signal.kind, 0) and signal.name in samples.names:
            spiked |= _spikes(samples.column(signal.name), signal, longest[signal.kind])
    return spiked


def _spikes(values: FloatArray, signal: Signal, longest: int) -> BoolArray:
    """Where values (n,) of a sensor, SI, belong to a spike of at most so many samples."""
    sides = values, -values
    above = [_above(side, longest) for side in sides]
    s = np.maximum(*above)
    low, high = np.quantile(values, SPANNED)
    usual, sd = TIMES * np.quantile(s, USUAL), np.hypot(signal.noise, signal.resolution)
    least = max(usual, LEAST_SD * sd, LEAST_SHARE * (high - low))
    if not (s > least).any():
        return np.zeros(len(s), bool)
    leads_up = [STEEP * _above(side, WIDER * longest) for side in sides]
    steep = [a > np.maximum(least, b) for a, b in zip(above, leads_up, strict=True)]
    return np.asarray(steep[0] | steep[1])


def _above(values: FloatArray, longest: int) -> FloatArray:
    """By how much values (n,) stand above the opening over more samples than these."""
    above = values - _opening(values, longest + 1)
    above[:longest] = above[-longest:] = 0.0  # what begins or ends there has no other side
    return above


def _opening(values: FloatArray, width: int) -> FloatArray:
    """The grey opening of values (n,): the largest of the least of all runs of a width about it."""
    least = np.pad(_of_runs(np.minimum, values, width), width - 1, "edge")
    return _of_runs(np.maximum, least, width)


def _of_runs(extreme: np.ufunc, values: FloatArray, width: int) -> FloatArray:
    """The extreme of every run of a width in values (n,): (n - width + 1,)."""
    n = len(values) - width + 1
    result = values[:n].copy()
    for k in range(1, width):
        extreme(result, values[k : k + n], out=result)
    return result
