"""One measured signal judged alone: range, resolution, noise, spans in which it is frozen.

Noise is what remains of a smooth signal after divided differences of order d,

    e_k = sum_i w_i x_(k+i) / sqrt(sum_i w_i^2),   w_i = 1 / prod_(j != i) (t_(k+i) - t_(k+j)),

so that white noise keeps its size at any jitter of t: sigma = rms(e, outliers left out).  The
order with the smallest sigma counts, because a low order still holds motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_ORDER = 6
FROZEN_S = 0.2
FROZEN_SAMPLES = 20


@dataclass(frozen=True)
class Series:
    """A signal at its own instants: t_us int64 (n,), value float64 (n,), SI; NaN: not available."""

    name: str
    t_us: NDArray[np.int64]
    value: NDArray[np.float64]


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
        noise=estimate_noise(x, t_us),
        frozen_s=span_s,
        frozen_from_s=start_s,
    )


def smallest_step(x: NDArray[np.float64]) -> float:
    """Smallest change between two values that occur, rounding of the last bits aside."""
    change = np.diff(np.unique(x))
    change = change[change > 1e-9 * np.abs(x).max()]
    return float(change.min()) if len(change) else 0.0


def estimate_noise(x: NDArray[np.float64], t_us: NDArray[np.int64] | None = None) -> float:
    """Standard deviation of white noise on a smooth signal; NaN from fewer than 20 values.

    Without t_us the values are taken as equally spaced.
    """
    if len(x) < 20:
        return float("nan")
    t = np.arange(len(x), dtype=np.float64)
    if t_us is not None:
        t = (t_us - t_us[0]) / max(float(np.median(np.diff(t_us))), 1.0)
    return min(_robust_rms(_normed_difference(t, x, d)) for d in range(1, MAX_ORDER + 1))


def _normed_difference(
    t: NDArray[np.float64], x: NDArray[np.float64], order: int
) -> NDArray[np.float64]:
    """Divided difference of d + 1 neighbours, scaled to gain 1 on white noise."""
    n = len(x) - order
    total, gain = np.zeros(n), np.zeros(n)
    for i in range(order + 1):
        product = np.ones(n)
        for j in range(order + 1):
            if j != i:
                product *= t[i : i + n] - t[j : j + n]
        weight = np.divide(1.0, product, out=np.zeros(n), where=product != 0)
        total += weight * x[i : i + n]
        gain += weight**2
    return np.divide(total, np.sqrt(gain), out=np.zeros(n), where=gain > 0)


def _robust_rms(x: NDArray[np.float64]) -> float:
    """Root mean square without what lies beyond four robust standard deviations."""
    limit = 4 * 1.4826 * float(np.median(np.abs(x)))
    kept = x[np.abs(x) <= limit]
    return float(np.sqrt(np.mean(kept**2)))


def longest_frozen(t_us: NDArray[np.int64], x: NDArray[np.float64]) -> tuple[float, float]:
    """Length of the longest span without any change, and its start after the first value, s."""
    changes = np.flatnonzero(np.diff(x) != 0)
    first = np.concatenate([[0], changes + 1])
    last = np.concatenate([changes, [len(x) - 1]])
    span_us = t_us[last] - t_us[first]
    k = int(np.argmax(span_us))
    if last[k] - first[k] < FROZEN_SAMPLES or span_us[k] < FROZEN_S * 1e6:
        return 0.0, 0.0
    return float(span_us[k]) * 1e-6, float(t_us[first[k]] - t_us[0]) * 1e-6
