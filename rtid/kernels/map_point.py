"""The published map at one point: what `rtid.estimator.flowmap.EdgeMap.flow` is over arrays.

The Taylor terms of the cells around a point, blended by the squares of the windows of (12), C1
everywhere; beyond the grid along dp the map goes on along its tangent, where that does not fall.
"""

from __future__ import annotations

import math
from typing import Any

from rtid.kernels.basis import locate
from rtid.kernels.jit import part
from rtid.plain import FloatArray


@part
def map_flow(
    e: Any, theta: FloatArray, i: int, overlap: float, w: float, dp: float
) -> tuple[float, bool]:
    """Q of edge i, m3/s, at one point by theta (cells, 6); True where dp is off the grid."""
    nu, nd = e.n_u[i], e.n_dp[i]
    w = min(max(w, e.u_border[i, 0]), e.u_border[i, nu])
    inside = min(max(dp, e.dp_border[i, 0]), e.dp_border[i, nd])
    a, share_a = _blend(e.u_border[i], nu, overlap, w)
    b, share_b = _blend(e.dp_border[i], nd, overlap, inside)
    q, slope = 0.0, 0.0
    for di in range(2):
        g = share_a if di == 1 else 1.0 - share_a
        if g == 0.0:
            continue
        for dj in range(2):
            weight = g * (share_b if dj == 1 else 1.0 - share_b)
            if weight != 0.0:
                value, by_dp = _cell_flow(e, theta, i, a + di, b + dj, w, inside)
                q += weight * value
                slope += weight * by_dp
    return q + max(0.0, slope) * (dp - inside), dp != inside


@part
def _cell_flow(
    e: Any, theta: FloatArray, i: int, iu: int, ip: int, w: float, dp: float
) -> tuple[float, float]:
    """The six Taylor terms of one cell at a point, and their slope in dp."""
    u0, p0 = e.u_border[i, iu], e.dp_border[i, ip]
    hp = 2.0 / (e.dp_border[i, ip + 1] - p0)
    xi = 2.0 * (w - u0) / (e.u_border[i, iu + 1] - u0) - 1.0
    eta = (dp - p0) * hp - 1.0
    t = theta[e.first_cell[i] + iu * e.n_dp[i] + ip]
    q = t[0] + xi * (t[1] + xi * t[3] + eta * t[5]) + eta * (t[2] + eta * t[4])
    return q, hp * (t[2] + 2.0 * eta * t[4] + xi * t[5])


@part
def _blend(border: FloatArray, n: int, overlap: float, at: float) -> tuple[int, float]:
    """First of the two cells that share a point, and the share of the second (`windows.blend`)."""
    if n == 1:
        return 0, 0.0
    home = locate(border, n, at)
    is_lower = at < 0.5 * (border[home] + border[home + 1])
    first = max(0, min(home - 1 if is_lower else home, n - 2))
    eta = overlap * min(border[first + 1] - border[first], border[first + 2] - border[first + 1])
    return first, rise((at - border[first + 1]) / eta)


@part
def rise(t: float) -> float:
    """beta^2(t) of the published windows, from 0 at t = -1 to 1 at t = 1."""
    if t <= -1.0:
        return 0.0
    if t >= 1.0:
        return 1.0
    angle = math.sin(0.25 * math.pi * (1.0 + t))
    return math.sin(0.5 * math.pi * angle * angle) ** 2


@part
def foot_width(e: Any, i: int, overlap: float) -> float:
    """Half the width over which a map rises from zero above its safe band; 0: it has none."""
    safe, n = e.safe_v[i], e.n_u[i]
    if not math.isfinite(safe):
        return 0.0
    k = 0
    while k < n - 1 and e.u_border[i, k + 1] <= safe:
        k += 1
    border = e.u_border[i]
    width = border[k + 1] - border[k]
    if k + 2 <= n:
        width = min(width, border[k + 2] - border[k + 1])
    return 0.5 * overlap * width
