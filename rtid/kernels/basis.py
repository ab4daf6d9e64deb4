"""Blocks of the u-dp plane, eq. (5)-(7): six Taylor terms in local coordinates scaled to [-1, 1].

phi = [1, xi, eta, xi^2, eta^2, xi eta],  xi = (w - w_c) / half width, eta = (dp - dp_c) / ...
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtid.kernels.jit import inlined

FloatArray = NDArray[np.float64]


@inlined
def locate(border: FloatArray, n: int, value: float) -> int:
    """Index of the interval of border[0..n] that holds value; -1 outside.  Bisection."""
    if not (value >= border[0] and value <= border[n]):
        return -1
    low, high = 0, n
    while high - low > 1:
        mid = (low + high) // 2
        if value >= border[mid]:
            low = mid
        else:
            high = mid
    return low


@inlined
def relocate(border: FloatArray, n: int, value: float, current: int, hysteresis: float) -> int:
    """As `locate`, but stay in `current` until value leaves it by hysteresis * its width."""
    if current >= 0:
        margin = hysteresis * (border[current + 1] - border[current])
        if value >= border[current] - margin and value <= border[current + 1] + margin:
            return current
    return locate(border, n, value)


@inlined
def taylor(xi: float, eta: float, out: FloatArray) -> None:
    """The six terms at one point; out (6,) is changed in place."""
    out[0] = 1.0
    out[1] = xi
    out[2] = eta
    out[3] = xi * xi
    out[4] = eta * eta
    out[5] = xi * eta
