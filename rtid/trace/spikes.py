"""Values of a sensor that jump away and back within milliseconds: no oil and no piston does that.

    s = max(c - opening(c), closing(o) - o),   c = closing(x), o = opening(x),

the grey opening and closing over more samples than such a jump lasts: what is narrower is left in
s, steps and slopes are not, and a peak's neighbour is no dip.  A spike stands out from what s
usually is, from the sensor's noise and from what the signal covers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from firmware_bridge.samples import GAP, Samples
from rtid.model import POSITION, PRESSURE, Machine, Signal
from rtid.plain import BoolArray, FloatArray

SPIKE = "spike"  # counter of the samples that are left out
LASTS_S, LASTS = 5e-3, 3  # at most; and samples, of which one may always be
USUAL, TIMES = 0.99, 10.0  # quantile of s, and how far a spike stands above it
LEAST_SD = 20.0  # of the sensor's noise
LEAST_SHARE, SPANNED = 0.05, (0.01, 0.99)  # of what the signal covers between these quantiles
FEWEST = 100  # samples, to know what is usual


def without_spikes(model: Machine, samples: Samples) -> tuple[Samples, dict[str, int]]:
    """The samples less those in which a pressure or the position spikes, and how many they are.

    The one behind them carries GAP: nothing is integrated across.
    """
    if len(samples) < FEWEST:
        return samples, {}
    step_s = 1e-6 * float(np.median(np.diff(samples.t_us)))
    longest = max(1, min(LASTS, int(LASTS_S / step_s)))
    spiked = np.zeros(len(samples), bool)
    for signal in model.signals:
        if signal.kind in (PRESSURE, POSITION) and signal.name in samples.names:
            spiked |= _spikes(samples.column(signal.name), signal, longest)
    if not spiked.any():
        return samples, {}
    behind = np.append(False, spiked[:-1])
    flags = np.where(behind, samples.flags | GAP, samples.flags)
    kept = ~spiked
    rest = replace(samples, t_us=samples.t_us[kept], values=samples.values[kept], flags=flags[kept])
    return rest, {SPIKE: int(spiked.sum())}


def _spikes(values: FloatArray, signal: Signal, longest: int) -> BoolArray:
    """Where values (n,) of a sensor, SI, belong to a spike of at most so many samples."""
    width = longest + 1
    filled, cut = -_opening(-values, width), _opening(values, width)
    s = np.maximum(filled - _opening(filled, width), -_opening(-cut, width) - cut)
    s[:longest] = s[-longest:] = 0.0  # what begins or ends there has no other side
    low, high = np.quantile(values, SPANNED)
    usual = TIMES * np.quantile(s, USUAL)
    return np.asarray(s > max(usual, LEAST_SD * signal.noise, LEAST_SHARE * (high - low)))


def _opening(values: FloatArray, width: int) -> FloatArray:
    """The grey opening of values (n,): the largest of the least of all runs of a width about it."""
    least = sliding_window_view(values, width).min(axis=1)
    return np.asarray(sliding_window_view(np.pad(least, width - 1, "edge"), width).max(axis=1))
