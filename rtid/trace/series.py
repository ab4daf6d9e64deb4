"""One measured signal judged alone: range, resolution, noise, spans in which it is frozen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.noise import estimate_noise
from rtid.plain import FloatArray, IntArray

FROZEN_S = 0.2
FROZEN_SAMPLES = 20


@dataclass(frozen=True)
class Series:
    """A signal at its own instants: t_us int64 (n,), value float64 (n,), SI; NaN: not available."""

    name: str
    t_us: IntArray
    value: FloatArray


@dataclass(frozen=True)
class SignalReport:
    """What a series shows, SI.  `step` is the smallest change (0: it never changes)."""

    name: str
    count: int
    missing: int
    minimum: float
    maximum: float
    step: float
    noise: float
    frozen_s: float
    frozen_from_s: float


def describe(series: Series) -> SignalReport:
    """Judge one series; all statistics are NaN if it has no value."""
    known = np.isfinite(series.value)
    x, t_us = series.value[known], series.t_us[known]
    nan = float("nan")
    if len(x) == 0:
        return SignalReport(series.name, 0, len(known), nan, nan, nan, nan, 0.0, 0.0)
    span_s, start_s = longest_frozen(t_us, x)
    return SignalReport(
        name=series.name,
        count=len(x),
        missing=int((~known).sum()),
        minimum=float(x.min()),
        maximum=float(x.max()),
        step=smallest_step(x),
        noise=estimate_noise(1e-6 * t_us, x).sd,
        frozen_s=span_s,
        frozen_from_s=start_s,
    )


def smallest_step(x: FloatArray) -> float:
    """Smallest change between two values of x (n,) that occur, in its unit.

    Rounding of the last bits aside.
    """
    change = np.diff(np.unique(x))
    change = change[change > 1e-9 * np.abs(x).max()]
    return float(change.min()) if len(change) else 0.0


def longest_frozen(t_us: IntArray, x: FloatArray) -> tuple[float, float]:
    """Length of the longest span without any change, and its start after the first value, s.

    t_us (n,): times in us; x (n,): values in any unit.
    """
    changes = np.flatnonzero(np.diff(x) != 0)
    first = np.concatenate([[0], changes + 1])
    last = np.concatenate([changes, [len(x) - 1]])
    span_us = t_us[last] - t_us[first]
    k = int(np.argmax(span_us))
    if last[k] - first[k] < FROZEN_SAMPLES or span_us[k] < FROZEN_S * 1e6:
        return 0.0, 0.0
    return float(span_us[k]) * 1e-6, float(t_us[first[k]] - t_us[0]) * 1e-6
