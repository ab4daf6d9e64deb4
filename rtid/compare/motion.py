"""Position without its noise, for the free run: the smoother of a body with random jerk.

    minimise  sum over measured samples of (x_k - s_k)^2 + sum of (s'''_k / wc^3)^2

with third differences for s'''; wc in rad/sample.  It is what a Kalman filter with the model
D^3 s = white noise and a Rauch-Tung-Striebel pass over it give, as one banded system; wc, the
bandwidth, by generalised cross-validation: n RSS / (n - trace)^2 least.
"""

from __future__ import annotations

import numpy as np

from rtid.kernels.engine import GAP_FLAG, ROW_FLAG
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray

ORDER = 3
# rad/sample that are tried; a narrower one would leave no digits: its system's condition is wc^-6
BANDWIDTHS = np.geomspace(0.012, 1.2, 13)
LEAST = 32  # samples of a stretch without gap; a shorter one is taken as measured


def smooth_position(model: Machine, chunk: FloatArray) -> FloatArray:
    """Smooth position (n,), m, of samples chunk (n, 2 + signals), each stretch alone."""
    t_s, flags = chunk[:, 0], chunk[:, 1].astype(int)
    x = np.ascontiguousarray(chunk[:, 2 + model.column(model.position)])
    measured = ((flags & ROW_FLAG) != 0) & np.isfinite(x)
    if not len(x):
        return x
    gap = ((flags[1:] & GAP_FLAG) != 0) | (np.diff(t_s) > model.gates.max_gap_s)
    gap |= (np.diff(t_s) <= 0) | ~np.isfinite(np.diff(x))
    for part in np.split(np.arange(len(x)), np.flatnonzero(gap) + 1):
        if measured[part].sum() >= LEAST:
            x[part] = smoothed(t_s[part], x[part], measured[part])
    return x


def smoothed(t_s: FloatArray, x: FloatArray, measured: BoolArray) -> FloatArray:
    """Smooth x (n,) at rising t_s (n,); only measured values count."""
    bands, wc_best, best = _roughness(t_s), BANDWIDTHS[0], np.inf
    for wc in BANDWIDTHS:
        rss = float(((x - _solve(bands, x, measured, wc))[measured] ** 2).sum())
        free = measured.sum() - _trace(wc, float(measured.mean())) * len(x)
        if free > 0 and rss / free**2 < best:
            wc_best, best = wc, rss / free**2
    return _solve(bands, x, measured, wc_best)


def _solve(bands: FloatArray, x: FloatArray, measured: BoolArray, wc: float) -> FloatArray:
    from scipy.linalg import solveh_banded  # noqa: PLC0415 - lazily: not on the daemon's path

    banded = bands / wc ** (2 * ORDER)
    banded[-1] += measured
    return np.asarray(solveh_banded(banded, np.where(measured, x, 0.0), check_finite=False))


def _roughness(t_s: FloatArray) -> FloatArray:
    """D'D of the third differences in upper banded form (4, n), for a step of 1 on average."""
    step = float(np.median(np.diff(t_s)))
    t = (t_s - t_s[0]) / step
    n, knots = len(t), np.stack([t[k : len(t) - ORDER + k] for k in range(ORDER + 1)])
    weights = np.empty_like(knots)
    for a in range(ORDER + 1):
        others = [knots[a] - knots[b] for b in range(ORDER + 1) if b != a]
        weights[a] = 6.0 / np.prod(others, axis=0)
    weights *= np.sqrt((knots[-1] - knots[0]) / ORDER)
    bands = np.zeros((ORDER + 1, n))
    for a in range(ORDER + 1):
        for b in range(a, ORDER + 1):
            bands[ORDER - (b - a), b : n - ORDER + b] += weights[a] * weights[b]
    return bands


def _trace(wc: float, share: float) -> float:
    """Trace of the smoother per sample, where `share` of them are measured."""
    w = np.linspace(0.0, np.pi, 2000)
    return float(np.mean(share / (share + (2 * np.sin(w / 2) / wc) ** (2 * ORDER))))
