"""One chamber between two valves of a parametric law, for filters and fits that integrate it.

    V dP/dt = beta (sign_1 Q_1 + sign_2 Q_2 - s A v),   Q = K(w) dp / (dp^2 + lam^2)^(1/4)
    short law   K = e^g (r + c r^2),  r = (z + sqrt(z^2 + 0.15^2)) / 2,  z = w - band
    knots       K linear between values at knots

Heun's rule, twice per sample: a chamber between wide open valves is stiff.  P in MPa.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from benchmarks.missing.front import Front, Working, smooth
from rtid.plain import FloatArray

MPA, FLOW = 1e6, 1e-4  # units of P and of K sqrt(2 MPa) in the unknowns
CORNER_V = 0.15
SHORT = 4  # ln gain, dead band in V, curvature in 1/V, ln(lam / MPa)
USUAL_PA = 2e6
FAST_S = 2e-3
jit = njit(cache=True)


@jit
def short_gain(theta: FloatArray, w: float) -> float:
    """K sqrt(2 MPa) / FLOW of the short law, theta (SHORT,)."""
    z = w - theta[1]
    r = 0.5 * (z + np.sqrt(z * z + CORNER_V**2))
    return float(np.exp(theta[0]) * (r + theta[2] * r * r))


@jit
def knot_gain(knots: FloatArray, theta: FloatArray, w: float) -> float:
    """The same of values theta (k + 1,) at knots (k,), V."""
    k = len(knots)
    if w <= knots[0]:
        return float(theta[0])
    for i in range(1, k):
        if w < knots[i]:
            share = (w - knots[i - 1]) / (knots[i] - knots[i - 1])
            return float(theta[i - 1] + share * (theta[i] - theta[i - 1]))
    return float(theta[k - 1])


@jit
def shaped(gain: float, dp: float, log_lam: float) -> float:
    """Q in m3/s; dp in Pa, lam = e^log_lam MPa."""
    lam = MPA * np.exp(min(max(log_lam, -12.0), 3.0))
    return float(gain * FLOW * dp / np.sqrt(np.sqrt(dp * dp + lam * lam)) / np.sqrt(USUAL_PA))


@jit
def edge_flow(knots: FloatArray, theta: FloatArray, w: float, dp: float) -> float:
    """Q in m3/s of a valve: the short law where there are no knots."""
    gain = short_gain(theta, w) if len(knots) == 0 else knot_gain(knots, theta, w)
    return shaped(gain, dp, theta[-1])


@jit
def slope(
    p: float, theta: FloatArray, knots: FloatArray, sign: FloatArray, row: FloatArray
) -> float:
    """dP/dt in Pa/s; theta (1 + 2 m,): 1/beta in 1/GPa, then both valves.

    row (6,): w_1, w_2, the pressure at the far end of each, s A v, V.
    """
    m, flow = (len(theta) - 1) // 2, -row[4]
    for e in range(2):
        if row[e] > 1.0:
            other = row[2 + e]
            dp = other - p if sign[e] > 0 else p - other
            flow += sign[e] * edge_flow(knots[e], theta[1 + e * m : 1 + (e + 1) * m], row[e], dp)
    return float(1e9 * flow / (max(theta[0], 0.1) * row[5]))


@jit
def step(
    p: float, theta: FloatArray, knots: FloatArray, sign: FloatArray,
    row: FloatArray, after: FloatArray, dt_s: float,
) -> float:  # fmt: skip
    """P one sample later, Pa."""
    middle = 0.5 * (row + after)
    ends = (row, middle, after)
    h = 0.5 * dt_s
    for k in range(2):
        a = slope(p, theta, knots, sign, ends[k])
        b = slope(p + h * a, theta, knots, sign, ends[k + 1])
        p += 0.5 * h * (a + b)
    return float(min(max(p, -5e6), 5e7))


@jit
def windows(
    start: FloatArray, theta: FloatArray, knots: FloatArray, sign: FloatArray, rows: FloatArray,
    length: int, every: int, dt_s: float, out: FloatArray,
) -> None:  # fmt: skip
    """Free runs of `length` samples from start (n,), Pa; out (windows, length // every), Pa."""
    for k in range(len(out)):
        p = start[k * length]
        for i in range(length):
            at = k * length + i
            p = step(p, theta, knots, sign, rows[at], rows[at + 1], dt_s)
            if (i + 1) % every == 0:
                out[k, (i + 1) // every - 1] = p


@dataclass(frozen=True)
class ChamberData:
    """What drives a chamber: rows (n, 6) of `slope`, p_pa (n,) measured, sign (2,), edges."""

    rows: FloatArray
    p_pa: FloatArray
    sign: FloatArray
    edges: tuple[int, int]
    dt_s: float


def velocity(front: Front) -> FloatArray:
    """Slow motion by the position, fast by the velocity's sensor (n,), m/s.

    The filter alone would weaken the oscillation of the mass on its oil, and make it look stiffer.
    """
    record, dt_s = front.record, front.dt_s
    x, v = record.column(front.samples.machine.position)[:, None], record.column("v")
    slow = smooth(x, dt_s, 1)[:, 0] - smooth(v[:, None], dt_s)[:, 0]
    return np.asarray(slow + gaussian_filter1d(v, FAST_S / dt_s))


def chambers(front: Front) -> list[ChamberData]:
    """All chambers of a record, in order."""
    at = front.samples
    v, data = velocity(front), []
    for c, chamber in enumerate(at.machine.chambers):
        first, second = at.edges_of(c)[:2]
        sign = at.sign[c, [first, second]]
        own = at.p_pa[:, c]
        far = [own + sign[k] * at.dp_pa[:, e] for k, e in enumerate((first, second))]
        moved = chamber.sign * chamber.area_m2 * v
        rows = np.column_stack([at.w_v[:, [first, second]], *far, moved, at.volume[:, c]])
        data.append(ChamberData(np.ascontiguousarray(rows), own, sign, (first, second), front.dt_s))
    return data


def start_short(at: Working, edge: int) -> FloatArray:
    """The data sheet in the short law, (SHORT,)."""
    e = at.machine.edges[edge]
    gain = e.rated_q_m3s / 4.0 * np.sqrt(USUAL_PA / e.rated_dp_pa) / FLOW
    return np.array([np.log(gain), 1.8, 0.0, np.log(0.03)])


def flow_of(
    names: tuple[str, ...], thetas: dict[int, FloatArray], knots: dict[int, FloatArray]
) -> Callable[[str, ArrayLike, ArrayLike], FloatArray]:
    """The map of all edges."""

    def flow(edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        e = names.index(edge)
        w, dp = np.broadcast_arrays(np.asarray(w_v, float), np.asarray(dp_pa, float))
        pairs = zip(w.ravel(), dp.ravel(), strict=True)
        return np.array([edge_flow(knots[e], thetas[e], a, b) for a, b in pairs]).reshape(w.shape)

    return flow
