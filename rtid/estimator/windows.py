"""Lapped windows, eq. (12): the smooth weights with which neighbouring blocks are blended.

The profile beta(t) rises from 0 at t <= -1 to 1 at t >= 1 with beta^2(t) + beta^2(-t) = 1,

    beta(t) = sin(pi/2 sin^2(pi/4 (1 + t))),

whose square is continuous with three derivatives.  The squares of the windows of all blocks sum to
1 at every point,

    g_i(t) = beta^2((t - b_i) / eta_i) beta^2((b_i+1 - t) / eta_i+1),

as long as the overlaps of one block do not meet: eta_i + eta_i+1 <= b_i+1 - b_i.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtid.plain import FloatArray

# Half the overlap at a border, in widths of the narrower neighbour; 0.5 is the most that fits.
OVERLAP = 0.25


def profile(t: FloatArray) -> FloatArray:
    """beta(t), dimensionless, for t (...): the sine of an angle that eases from 0 to pi / 2."""
    return np.asarray(np.sin(_angle(t)))


def rising(t: FloatArray) -> FloatArray:
    """beta^2(t) for t (...), dimensionless."""
    return np.asarray(np.sin(_angle(t)) ** 2)


def rising_slope(t: FloatArray) -> FloatArray:
    """Derivative of `rising` at t (...), dimensionless; zero outside [-1, 1] and continuous."""
    slope = 0.125 * np.pi**2 * np.sin(0.5 * np.pi * (1.0 + np.clip(t, -1.0, 1.0)))
    return np.asarray(np.sin(2.0 * _angle(t)) * slope)


def _angle(t: FloatArray) -> FloatArray:
    """pi/2 sin^2(pi/4 (1 + t)): its relative error stays small where it vanishes, at t = -1."""
    return np.asarray(0.5 * np.pi * np.sin(0.25 * np.pi * (1.0 + np.clip(t, -1.0, 1.0))) ** 2)


def overlaps(border: FloatArray, share: float = OVERLAP) -> FloatArray:
    """eta (n + 1,) per border of n blocks: share (<= 0.5) of the narrower neighbour's width."""
    width = np.diff(border)
    return share * np.minimum(np.append(width, width[-1]), np.insert(width, 0, width[0]))


def blend(border: FloatArray, at: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """The two blocks that share each point, and how.

    border (n + 1,), at (m,) inside it.  Returns lower (m,), the first of the blocks lower and
    lower + 1 (n - 2 at the most; 0 where n = 1), the weight (m,) of the second, and the weight's
    derivative (m,).
    """
    n, eta = len(border) - 1, overlaps(border)
    if n == 1:
        return np.zeros(len(at), np.intp), np.zeros(len(at)), np.zeros(len(at))
    middle = 0.5 * (border[1:] + border[:-1])
    lower = np.clip(np.searchsorted(middle, at) - 1, 0, n - 2)
    t = (at - border[lower + 1]) / eta[lower + 1]
    return lower, rising(t), rising_slope(t) / eta[lower + 1]


def foot(border: FloatArray, start: float, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weight (m,) that lets a map rise from zero at `start`, and its derivative.

    It is 1 from one half overlap of the border above `start` on, everywhere where start is -inf.
    """
    if not np.isfinite(start):
        return np.ones(len(at)), np.zeros(len(at))
    i = int(np.clip(np.searchsorted(border, start, side="right") - 1, 0, len(border) - 2))
    eta = overlaps(border)[i + 1] / 2
    t = (at - start) / eta - 1.0
    return rising(t), rising_slope(t) / eta
