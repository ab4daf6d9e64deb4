"""Recursive filters and fitted parabolas along a record; `scipy.signal` takes long to import.

    y_k = b_0 x_k + b_1 x_k-1 + b_2 x_k-2 - a_1 y_k-1 - a_2 y_k-2

A parabola's weights are a row of the pseudo-inverse of [1, t, t^2] over the window.
"""

from __future__ import annotations

from functools import cache
from math import factorial

import numpy as np
from scipy.linalg import expm

from rtid.kernels.jit import kernel
from rtid.kernels.smoothing import correlate
from rtid.plain import FloatArray

Taps = tuple[float, float, float]


def filtered(b: Taps, a: Taps, values: FloatArray) -> FloatArray:
    """Values (n,), any unit, through the filter b / a with a[0] = 1, from rest."""
    out = np.empty(len(values))
    _filter(b, a, np.ascontiguousarray(values, dtype=np.float64), out)
    return out


@kernel
def _filter(b: Taps, a: Taps, values: FloatArray, out: FloatArray) -> None:
    z0, z1 = 0.0, 0.0
    for k in range(len(values)):
        x = values[k]
        y = z0 + b[0] * x
        z0, z1 = z1 + b[1] * x - a[1] * y, b[2] * x - a[2] * y
        out[k] = y


def held_second_order(wn: float, zeta: float, dt_s: float) -> tuple[Taps, Taps]:
    """(b, a) of a second-order lag, wn in rad/s, whose input is held over each step."""
    system = np.array([[0.0, 1.0, 0.0], [-wn * wn, -2.0 * zeta * wn, wn * wn], [0.0, 0.0, 0.0]])
    (a00, a01, g0), (a10, a11, g1), _ = expm(system * dt_s).tolist()
    return (0.0, g0, a01 * g1 - a11 * g0), (1.0, -a00 - a11, a00 * a11 - a01 * a10)


@cache
def _parabola(
    half: int, derivative: int, step_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights (2 half + 1) of a parabola's value: at the first points, the middle, the last."""
    m = 2 * half + 1
    at = [
        np.linalg.pinv(np.vander(np.arange(m) - float(k), 3, increasing=True))[derivative]
        * (factorial(derivative) / step_s**derivative)
        for k in range(m)
    ]
    return np.array(at[:half]), at[half], np.array(at[half + 1 :])


def fitted(values: FloatArray, half: int, derivative: int, step_s: float) -> FloatArray:
    """Values (n,), any unit, or a derivative, of parabolas through 2 half + 1 <= n neighbours."""
    means, m = np.empty(len(values)), 2 * half + 1
    first, middle, last = _parabola(half, derivative, step_s)
    means[:half], means[-half:] = first @ values[:m], last @ values[-m:]
    correlate(np.ascontiguousarray(values), middle, means[half : len(values) - half])
    return means


def noise_left(half: int) -> float:
    """What parabolas through 2 half + 1 neighbours leave of the deviation of white noise."""
    return float(np.linalg.norm(_parabola(half, 0, 1.0)[1]))
