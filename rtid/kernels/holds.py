"""Exact responses over one sampling interval: first-order lag and the second-order filter (10).

The command is held (zero-order hold), sensors run linearly between samples (first-order hold), so a
regressor runs from phi(u_k, dp_k) to phi(u_k, dp_k+1) over [t_k, t_k+1].
"""

from __future__ import annotations

import math

from rtid.kernels.jit import inlined, kernel
from rtid.plain import FloatArray


@kernel
def second_order(wn: float, zeta: float, dt: float, a: FloatArray, b: FloatArray) -> None:
    """Discretise H_f for an input that is linear over dt: x+ = a x + b [u_start, u_end].

    State x = (output, output' / wn).  a, b (2, 2) are changed in place.  wn in rad/s, zeta < 1.
    The continuous system is x' = wn [[0, 1], [-1, -2 zeta]] x + wn [0, 1] u; with G = A^-1,
    int e^{As} B ds = G (a - I) B and the ramp part follows by parts.
    """
    wd = wn * math.sqrt(1.0 - zeta * zeta)
    decay = math.exp(-zeta * wn * dt)
    c, s = decay * math.cos(wd * dt), decay * math.sin(wd * dt)
    r = zeta * wn / wd
    a[0, 0], a[0, 1] = c + r * s, wn / wd * s
    a[1, 0], a[1, 1] = -wn / wd * s, c - r * s
    # step response g = (1 - a00, -a10); its mean over dt, m = A^-1 (g / dt - B)
    g0, g1 = 1.0 - a[0, 0], -a[1, 0]
    h0, h1 = g0 / (wn * dt), g1 / (wn * dt) - 1.0
    m0, m1 = -2.0 * zeta * h0 - h1, h0
    b[0, 1], b[1, 1] = m0, m1
    b[0, 0], b[1, 0] = g0 - m0, g1 - m1


# Two Gauss points of an interval, in steps from its middle: exact to the third power of time.
GAUSS = 0.5 / math.sqrt(3.0)


@inlined
def lagged_moments(
    u: float, w0: float, lag: float, decay: float, dt: float
) -> tuple[float, float, float, float]:
    """Moments over dt of w(t) = u + (w0 - u) e^{-t / lag}, decay = e^{-dt / lag}.

    Returns (w at dt, mean of w, mean of w^2, mean of w (t/dt - 1/2)).
    """
    if lag <= 0.0:
        return u, u, u * u, 0.0
    g = w0 - u
    k = lag / dt
    m1 = k * (1.0 - decay)
    m2 = 0.5 * k * (1.0 - decay * decay)
    mt = k * (k * (1.0 - decay) - decay) - 0.5 * m1
    return u + g * decay, u + g * m1, u * u + 2.0 * u * g * m1 + g * g * m2, g * mt
