"""Least squares on filtered regressors: splines of the command times powers of the pressure drop.

Q = sum of a_ij B_i(w) r_j(dp), with cubic B-splines whose knots lie at quantiles of the commands,
and r = s, s |s|, s^3: orifice, gap, and what bends; s is the signed root of the drop.  scipy.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.interpolate import BSpline

from benchmarks.missing.front import Front, Working
from benchmarks.missing.linear import Basis, fitted
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

KNOTS, CUBIC, TOP_V = 14, 3, 10.0
UNIT_PA = 2e6


def knots_of(at: Working, edge: int) -> FloatArray:
    """Knots (k,), V: half of them at quantiles of the visited commands, half of the range."""
    w = at.w_v[at.open(edge), edge]
    share = np.linspace(0.0, 1.0, KNOTS)
    inner = 0.5 * (np.quantile(w, share) + w.min() + share**2 * (w.max() - w.min()))
    first, last = min(inner[0], at.machine.edges[edge].safe_band_v), max(inner[-1], TOP_V)
    return np.concatenate([[first] * CUBIC, inner, [last] * CUBIC])


def splines(knots: FloatArray, w_v: FloatArray, root: FloatArray) -> FloatArray:
    """The basis (n, 3 (KNOTS + 2))."""
    s = root / np.sqrt(UNIT_PA)
    powers = np.stack([s, s * np.abs(s), s**3], axis=-1)
    w = np.clip(w_v, knots[0], knots[-1] - 1e-9)
    at = BSpline.design_matrix(w, knots, CUBIC, extrapolate=True).toarray()
    return np.asarray((at[:, :, None] * powers[:, None, :]).reshape(len(at), -1))


def bases(at: Working) -> tuple[Basis, ...]:
    """One spline basis per edge."""
    return tuple(partial(splines, knots_of(at, e)) for e in range(at.w_v.shape[1]))


class LeastSquares:
    """One linear problem per chamber."""

    def name(self) -> str:
        """Its row."""
        return "least squares"

    def learn(self, train: Record) -> Learned:
        """Maps, moduli and their covariance."""
        front = Front(train)
        return fitted(front, bases(front.samples)).learned


METHODS = (LeastSquares(),)
