"""Blocks of the u-dp plane, eq. (5)-(7): six Taylor terms in local coordinates scaled to [-1, 1].

phi = [1, xi, eta, xi^2, eta^2, xi eta],  xi = (w - w_c) / half width, eta = (dp - dp_c) / ...

And the lapped basis: local cosines under the overlapping windows of (12), six per block,

    g_i(w) g_j(dp) cos(pi (k + 1/2) s) cos(pi (l + 1/2) r),   k + l <= 2,   s, r in [0, 1],

with g_i(t) = beta((t - b_i) / eta_i) beta((b_i+1 - t) / eta_i+1), beta(t) = sin(pi/4 (1 + t)).
With this profile and the largest overlap the first cosines of equal blocks sum to a constant.

And the blended basis: Taylor terms under the squares of the same windows, which sum to one, so that
any quadratic flow is met exactly and the map has no jumps; not orthogonal.

And the proportional one, of a pump: D w with one D per block, nothing where w = 0.
"""

from __future__ import annotations

import math

import numpy as np

from rtid.kernels.jit import inlined, kernel, part
from rtid.kernels.layout import BLENDED, PROPORTIONAL
from rtid.plain import FloatArray


@inlined
def locate(border: FloatArray, n: int, value: float) -> int:
    """Index of the interval of border (n + 1,) that holds value, in its unit; -1 outside."""
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
    """As `locate` in border (n + 1,), but stay in `current` until left by a share of its width."""
    if current >= 0:
        margin = hysteresis * (border[current + 1] - border[current])
        if value >= border[current] - margin and value <= border[current + 1] + margin:
            return current
    return locate(border, n, value)


@inlined
def taylor(xi: float, eta: float, phi: FloatArray) -> None:
    """The six terms at one point, dimensionless; phi (6,) is changed in place."""
    phi[0] = 1.0
    phi[1] = xi
    phi[2] = eta
    phi[3] = xi * xi
    phi[4] = eta * eta
    phi[5] = xi * eta


OVERLAP = 0.5  # half the overlap at a border, in widths of the narrower neighbour: the most


@inlined
def locate_pair(border: FloatArray, n: int, value: float) -> tuple[int, int]:
    """(First of the two blocks whose windows share value, the block that holds it); -1 outside."""
    home = locate(border, n, value)
    if home < 0:
        return -1, -1
    is_lower = value < 0.5 * (border[home] + border[home + 1])
    return max(0, min(home - 1 if is_lower else home, n - 2)), home


@inlined
def _rise(t: float) -> float:
    """beta(t) of (12): beta^2(t) + beta^2(-t) = 1."""
    if t <= -1.0:
        return 0.0
    return 1.0 if t >= 1.0 else math.sin(0.25 * math.pi * (1.0 + t))


@part
def window_axis(
    border: FloatArray, n: int, i: int, value: float, basis: int, out: FloatArray
) -> None:
    """Window i times its three functions, dimensionless, at one value; out (3,) changed in place.

    The outer borders have no neighbour: no window falls there, and the last block's cosines are
    even about its end instead of odd.
    """
    width = border[i + 1] - border[i]
    if basis == PROPORTIONAL:
        is_inside = locate(border, n, value) == i
        out[0] = value / max(abs(border[i]), abs(border[i + 1])) if is_inside else 0.0
        out[1], out[2] = 0.0, 0.0
        return
    g, shift = 1.0, 0.5
    if i > 0:
        eta = OVERLAP * min(width, border[i] - border[i - 1])
        g = _rise((value - border[i]) / eta)
    if i < n - 1:
        eta = OVERLAP * min(width, border[i + 2] - border[i + 1])
        g *= _rise((border[i + 1] - value) / eta)
    else:
        shift = 0.0
    s = (value - border[i]) / width
    if basis == BLENDED:
        xi = 2.0 * s - 1.0
        out[0], out[1], out[2] = g * g, g * g * xi, g * g * xi * xi
        return
    for k in range(3):
        out[k] = g * math.cos(math.pi * (k + shift) * s)


@inlined
def window_terms(a: FloatArray, b: FloatArray, phi: FloatArray) -> None:
    """phi (6,): products of the axes' functions (3,) as in `taylor`, dimensionless."""
    phi[0] = a[0] * b[0]
    phi[1] = a[1] * b[0]
    phi[2] = a[0] * b[1]
    phi[3] = a[2] * b[0]
    phi[4] = a[0] * b[2]
    phi[5] = a[1] * b[1]


@kernel
def window_terms_at(
    basis: int,
    u: FloatArray,
    dp: FloatArray,
    i: int,
    j: int,
    points: FloatArray,
    phi: FloatArray,
) -> None:
    """The six windowed terms of block (i, j) at points (n, 2) = [w, dp]; phi (n, 6) is changed.

    u (nu + 1,) V, dp (nd + 1,) Pa: the borders of the grid.
    """
    a, b = np.empty(3), np.empty(3)
    for k in range(len(points)):
        window_axis(u, len(u) - 1, i, points[k, 0], basis, a)
        window_axis(dp, len(dp) - 1, j, points[k, 1], min(basis, BLENDED), b)
        window_terms(a, b, phi[k])
