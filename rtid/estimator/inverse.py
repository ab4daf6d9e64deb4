"""The command for a wanted flow, w = Q^-1(q, dp), of a published map.

At a fixed pressure drop the map is one-dimensional: a polynomial a + b xi + c xi^2 per column of
blocks, blended by the windows along w.  On a lattice over w all flows of a batch are one matrix
product; where exactly one step of the lattice passes the wanted flow, bisection does the rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.windows import blend, foot, overlaps, rising
from rtid.model import Grid
from rtid.plain import FloatArray

Index = NDArray[np.intp]

STEPS = 40  # bisections: from a quarter of a block to 1e-12 of it
SCAN = 4  # lattice points per block; borders and middles must be among them
BATCH = 4096  # points that are inverted together
ROUNDING = 1e-12  # share of the largest flow by which a flow may lie beyond the map's ends


def invert(
    grid: Grid, safe_band_v: float, theta: FloatArray, q_m3s: FloatArray, dp_pa: FloatArray
) -> FloatArray:
    """Commands (n,) for flows (n,) at pressure drops (n,); NaN where there is none or several."""
    parts = [slice(k, k + BATCH) for k in range(0, len(q_m3s), BATCH)]
    pieces = [_invert(grid, safe_band_v, theta, q_m3s[part], dp_pa[part]) for part in parts]
    return np.concatenate([*pieces, np.zeros(0)])


def on_lattice(
    grid: Grid, safe_band_v: float, theta: FloatArray, w_v: FloatArray, dp_pa: FloatArray
) -> FloatArray:
    """The map's flows (n, m) at all pairs of commands (n,), above the safe band, and dp (m,)."""
    sections, windowed = _sections(grid, theta, dp_pa), _windowed(grid.u_v, safe_band_v, w_v)
    return windowed.reshape(len(w_v), -1) @ sections.reshape(len(dp_pa), -1).T


def _invert(
    grid: Grid, safe_band_v: float, theta: FloatArray, q: FloatArray, dp: FloatArray
) -> FloatArray:
    lattice, sections = _lattice(grid.u_v, safe_band_v), _sections(grid, theta, dp)
    windowed = _windowed(grid.u_v, safe_band_v, lattice)
    table = sections.reshape(len(q), -1) @ windowed.reshape(len(lattice), -1).T - q[:, None]
    sign = np.where(table[:, -1] >= table[:, 0], 1.0, -1.0)  # the map falls where dp < 0
    table *= sign[:, None]
    tiny = ROUNDING * np.abs(table).max(axis=1)
    table[:, 0] -= np.where(np.abs(table[:, 0]) <= tiny, 2 * tiny, 0.0)
    table[:, -1] += np.where(np.abs(table[:, -1]) <= tiny, 2 * tiny, 0.0)
    below = table < 0
    passing = below[:, :-1] != below[:, 1:]
    single = (passing.sum(axis=1) == 1) & below[:, 0] & np.isfinite(table).all(axis=1)
    at = passing.argmax(axis=1)
    low, high = lattice[at], lattice[at + 1]
    flow = _between(grid.u_v, safe_band_v, sections, 0.5 * (low + high))
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        under = sign * (flow(middle) - q) < 0
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    return np.where(single, 0.5 * (low + high), np.nan)


def _lattice(border: FloatArray, safe_band_v: float) -> FloatArray:
    steps = np.arange(SCAN) / SCAN
    fine = np.append((border[:-1, None] + np.diff(border)[:, None] * steps).ravel(), border[-1])
    start = max(safe_band_v, float(border[0]))
    return np.append(start, fine[fine > start])


def _sections(grid: Grid, theta: FloatArray, dp: FloatArray) -> FloatArray:
    """a, b, c of every column at each pressure drop (n, nu, 3); NaN off the grid."""
    border, nd = grid.dp_pa, grid.shape[1]
    inside = (dp >= border[0]) & (dp <= border[-1])
    dp = np.where(inside, dp, border[0])
    lower, weight, _ = blend(border, dp)
    out = np.zeros((len(dp), grid.shape[0], 3))
    for j, share in ((lower, 1.0 - weight), (np.minimum(lower + 1, nd - 1), weight)):
        eta = _local(border, j, dp)[:, None]
        constant, xi, eta1, xi2, eta2, mixed = theta[:, j].transpose(2, 1, 0)
        out[:, :, 0] += share[:, None] * (constant + eta * (eta1 + eta * eta2))
        out[:, :, 1] += share[:, None] * (xi + eta * mixed)
        out[:, :, 2] += share[:, None] * xi2
    out[~inside] = np.nan
    return out


def _windowed(border: FloatArray, safe_band_v: float, w: FloatArray) -> FloatArray:
    """Weights (m, nu, 3) of all columns' a, b, c in the flow at commands w (m,)."""
    out, last = np.zeros((len(w), len(border) - 1, 3)), len(border) - 2
    lower, weight, _ = blend(border, w)
    risen = foot(border, safe_band_v, w)[0]
    for i, share in ((lower, 1.0 - weight), (np.minimum(lower + 1, last), weight)):
        xi = _local(border, i, w)
        terms = np.stack([np.ones_like(xi), xi, xi * xi], axis=1)
        out[np.arange(len(w)), i] += (share * risen)[:, None] * terms
    return out


def _between(
    border: FloatArray, safe_band_v: float, sections: FloatArray, near_w: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    """The flow of each section (n, nu, 3) as a function of w (n,) near given commands (n,)."""
    lower, eta = blend(border, near_w)[0], overlaps(border)
    upper = np.minimum(lower + 1, len(border) - 2)
    rows = np.arange(len(sections))
    left, right = sections[rows, lower].T, sections[rows, upper].T

    def flow(w: FloatArray) -> FloatArray:
        first, second = _local(border, lower, w), _local(border, upper, w)
        below = left[0] + first * (left[1] + first * left[2])
        above = right[0] + second * (right[1] + second * right[2])
        weight = rising((w - border[upper]) / eta[upper])
        return np.asarray(foot(border, safe_band_v, w)[0] * (below + weight * (above - below)))

    return flow


def _local(border: FloatArray, i: Index, at: FloatArray) -> FloatArray:
    """Local coordinate in [-1, 1] of points in their blocks."""
    return np.asarray((2 * at - border[i] - border[i + 1]) / (border[i + 1] - border[i]))
