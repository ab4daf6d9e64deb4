"""What the visited blocks say about the rest of the map: the orifice law as a Gaussian process.

    Q(w, dp) = s(dp) |dp|^delta [K(w) + K(w) h(w, log |dp|) + a K(w) l(dp) + e(w, dp)],

    s(dp) = sign(dp) sqrt |dp|,     l(dp) = 1 - (1 + (dp_laminar / dp)^2)^(-1/4)

K(w), the flow gain, is an integrated Wiener process that starts at zero at the edge of the safe
band: smooth where there are data, and less and less certain away from them.  delta is 0 unless the
data clearly want another exponent than 1/2 (a load-compensated valve, a laminar gap); what has
another one where it was seen need not have it elsewhere, so that h is as large at the least.  h,
another integrated Wiener process of log |dp|, is how the valve deviates from the law; most of its
variance is the whole valve's, a quarter changes over the command (a notch that becomes an edge, a
gap that opens, a spool that the jet closes).  Towards dp = 0 every edge
turns laminar, at dp_laminar or elsewhere: a has the standard deviation 1.  e is what is left, in
proportion to K, with a correlation that fades over the command and over log |dp|.  How rough K is
and how large h and e are follow from the scatter of Q / s(dp) among the blocks themselves (largest
marginal likelihood), so a valve that does not obey the law says so by wide intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from rtid.model import Edge
from rtid.plain import FloatArray

REACH_LOG_DP = 1.0  # e fades by 1/e over this change of log |dp| ...
REACH_W = 0.2  # ... and over this share of the command's range
SLOPE_SD = 2.0  # of K' before any data, in units of the rated gain per range
LAMINAR_DP_PA = 1.5e5  # about where metering edges turn laminar
LEAST_SIZE = 0.02  # of the rated gain: e does not vanish in the dead band
BLOCK_ERROR = 3e-4  # share of K by which a block's polynomial misses its data at the least
# Log rough, log exponent, log deviation, delta: starts (law obeyed, or not) and bounds.
ORIFICE, OTHER_LAW = (1.0, -5.0, -5.0, 0.0), (1.0, -3.0, -4.0, 0.0)
SEARCH = ((-8.0, 8.0), (-8.0, 1.0), (-7.0, 1.0), (-0.5, 0.5))
OWN = 0.25  # of h: its part that changes over the command, as where a notch becomes an edge
UNSURE = 0.75  # of another exponent than 1/2: by so much it may change per unit of log |dp|
CLEARLY = 10.0  # gain in log likelihood that another exponent must bring


Strength = tuple[float, float, float, float]


@dataclass(frozen=True)
class GainData:
    """Measured flow gains Q / s(dp) with their sd, m3/s/sqrt(Pa), at w_v, dp_pa: all (n,)."""

    w_v: FloatArray
    dp_pa: FloatArray
    gain: FloatArray
    sd: FloatArray


@dataclass(frozen=True)
class KernelPoints:
    """Arguments of the kernel, arrays of one shape, dimensionless; size: that of e."""

    opening: FloatArray
    log_dp: FloatArray
    size: FloatArray
    laminar: FloatArray

    def rows(self) -> KernelPoints:
        """The same points with a new last axis."""
        return KernelPoints(*(a[..., None] for a in self._arrays()))

    def columns(self) -> KernelPoints:
        """The same points with a new last axis but one."""
        return KernelPoints(*(a[..., None, :] for a in self._arrays()))

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.opening, self.log_dp, self.size, self.laminar


@dataclass(frozen=True)
class RatedScale:
    """The edge's rated size: foot of the range, its length, gain there; mean and least |dp|."""

    foot_v: float
    range_v: float
    gain: float
    dp_pa: float
    least_dp_pa: float

    def points(self, w_v: FloatArray, dp_pa: FloatArray, size: FloatArray) -> KernelPoints:
        """Kernel arguments of physical points (n,); size (n,) in units of the rated gain."""
        opening = np.maximum((w_v - self.foot_v) / self.range_v, 0.0)
        log_dp = np.log((np.abs(dp_pa) + self.least_dp_pa) / self.dp_pa)
        ratio = LAMINAR_DP_PA / (np.abs(dp_pa) + self.least_dp_pa)
        return KernelPoints(opening, log_dp, size, 1.0 - (1.0 + ratio**2) ** -0.25)


@dataclass(frozen=True)
class OrificeLaw:
    """The process of one edge conditioned on its data; gains in units of the rated gain.

    strength: variance rate of K'', standard deviations of h' and of e / K, and delta.
    """

    scale: RatedScale
    strength: Strength
    sizes: FloatArray  # size of e at `knots` of the opening
    knots: FloatArray
    points: KernelPoints
    alpha: FloatArray
    lower: FloatArray

    def gains(self, w_v: FloatArray, dp_pa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Q / s(dp) at c separate sets of m points (c, m): mean (c, m) and covariance (c, m, m)."""
        opening = np.maximum((w_v - self.scale.foot_v) / self.scale.range_v, 0.0)
        points = self.scale.points(w_v, dp_pa, np.interp(opening, self.knots, self.sizes))
        flat = points.rows()
        cross = self._kernel(flat, self.points)
        solved = solve_triangular(self.lower, cross.reshape(w_v.size, -1).T, lower=True)
        half = np.asarray(solved).T.reshape(cross.shape)
        gains = self._kernel(flat, points.columns())
        mean = opening + cross @ self.alpha
        unit = self.scale.gain * np.exp(self.strength[3] * points.log_dp)
        cov = gains - half @ half.transpose(0, 2, 1)
        return mean * unit, cov * unit[:, :, None] * unit[:, None, :]

    def _kernel(self, a: KernelPoints, b: KernelPoints) -> FloatArray:
        return KernelShapes.between(a, b).covariance(*self.strength[:3])


@dataclass(frozen=True)
class KernelShapes:
    """What the covariance of two sets of points consists of, arrays of one shape; sizes: of e."""

    known: FloatArray
    rough: FloatArray
    exponent: FloatArray
    deviation: FloatArray
    laminar: FloatArray
    sizes: FloatArray

    @classmethod
    def between(cls, a: KernelPoints, b: KernelPoints) -> KernelShapes:
        """Of broadcast points."""
        low, high = np.minimum(a.opening, b.opening), np.maximum(a.opening, b.opening)
        both = np.abs(a.log_dp), np.abs(b.log_dp)
        shared = a.log_dp * b.log_dp + np.where(
            a.log_dp * b.log_dp > 0.0, wiener(np.minimum(*both), np.maximum(*both)), 0.0
        )
        apart = (high - low) / REACH_W
        far = apart + np.abs(a.log_dp - b.log_dp) / REACH_LOG_DP
        shared *= 1.0 - OWN + OWN * np.exp(-apart)
        known, rough = SLOPE_SD**2 * low * high, wiener(low, high)
        laminar, sizes = a.laminar * b.laminar, a.size * b.size
        return cls(known, rough, shared, np.exp(-far), laminar, sizes)

    def covariance(self, rough: float, exponent: float, deviation: float) -> FloatArray:
        """Of Q / s(dp) between the points (...), in squares of the rated gain."""
        smooth = self.known + rough * self.rough
        deviations = exponent**2 * self.exponent + deviation**2 * self.deviation + self.laminar
        return np.asarray(smooth + self.sizes * deviations)


def _descend(
    surprise: Callable[[FloatArray], float],
    start: tuple[float, ...],
    bounds: tuple[tuple[float, float], ...],
) -> Any:
    from scipy.optimize import minimize  # noqa: PLC0415 - takes long to import

    steps = np.diag([1.5, 1.5, 1.5, 0.2][: len(start)])
    simplex = np.vstack([start, np.array(start) + steps])
    return minimize(
        surprise,
        np.array(start),
        method="Nelder-Mead",
        bounds=bounds,
        options={"xatol": 0.05, "fatol": 0.05, "initial_simplex": simplex},
    )


def wiener(low: FloatArray, high: FloatArray) -> FloatArray:
    """Covariance of an integrated Wiener process at 0 <= low <= high (...), dimensionless."""
    return np.asarray(low**2 * (3.0 * high - low) / 6.0)


def fit_law(edge: Edge, data: GainData) -> OrificeLaw:
    """The law of one edge from the flow gains of its blocks (n >= 0 of them)."""
    scale = scale_of(edge, data)
    knots = np.linspace(0.0, 1.0, 65)
    first = _Conditioned(scale, data, knots, np.full(65, 0.3)).law((10.0, 0.01, 0.1, 0.0))
    gain, _ = first.gains(scale.foot_v + scale.range_v * knots[:, None], np.full((65, 1), 1e6))
    sizes = np.maximum(gain[:, 0] / scale.gain, LEAST_SIZE)
    if len(data.gain) < 3:
        return replace(first, sizes=sizes)
    conditioned = _Conditioned(scale, data, knots, sizes)
    orifice = _descend(lambda x: conditioned.surprise(np.append(x, 0.0)), ORIFICE[:3], SEARCH[:3])
    other = _descend(conditioned.surprise, OTHER_LAW, SEARCH)
    clear = other.fun < orifice.fun - CLEARLY
    best = other.x if clear else np.append(orifice.x, 0.0)
    return conditioned.law(_strength(best))


def scale_of(edge: Edge, data: GainData) -> RatedScale:
    """Rated size of an edge, and where its data lie."""
    u, dp = edge.grid.u_v, edge.grid.dp_pa
    foot = edge.safe_band_v if np.isfinite(edge.safe_band_v) else u[0]
    gain = edge.rated_q_m3s / np.sqrt(edge.rated_dp_pa)
    least = float(0.01 * np.diff(dp).min())
    usual = np.median(np.abs(data.dp_pa)) if len(data.dp_pa) else edge.rated_dp_pa
    return RatedScale(float(foot), float(u[-1] - foot), float(gain), float(usual), least)


def root(dp_pa: FloatArray) -> FloatArray:
    """s(dp) = sign(dp) sqrt |dp|, (...) in sqrt(Pa)."""
    return np.asarray(np.sign(dp_pa) * np.sqrt(np.abs(dp_pa)))


def _strength(x: FloatArray) -> Strength:
    rough, exponent, deviation = np.exp(x[:3])
    exponent = max(float(exponent), UNSURE * abs(float(x[3])))
    return float(rough), exponent, float(deviation), float(x[3])


class _Conditioned:
    """The process of one edge on its data, for any strength: what no strength changes, once."""

    def __init__(
        self, scale: RatedScale, data: GainData, knots: FloatArray, sizes: FloatArray
    ) -> None:
        self._scale, self._data, self._knots, self._sizes = scale, data, knots, sizes
        opening = np.maximum((data.w_v - scale.foot_v) / scale.range_v, 0.0)
        self._points = scale.points(data.w_v, data.dp_pa, np.interp(opening, knots, sizes))
        self._shapes = KernelShapes.between(self._points.rows(), self._points)
        self._missed = (BLOCK_ERROR * self._points.size) ** 2

    def law(self, strength: Strength) -> OrificeLaw:
        """The law."""
        lower, alpha, _, _ = self._solved(strength)
        scale, sizes, knots = self._scale, self._sizes, self._knots
        return OrificeLaw(scale, strength, sizes, knots, self._points, alpha, lower)

    def surprise(self, x: FloatArray) -> float:
        """Minus the log likelihood of logarithms of the strengths, and delta (4,)."""
        lower, alpha, y, tilt = self._solved(_strength(x))
        return float(0.5 * y @ alpha + np.log(np.diag(lower)).sum() - np.log(tilt).sum())

    def _solved(self, strength: Strength) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Cholesky factor (n, n) of the data's covariance, its solution, data and tilt (n,)."""
        tilt = np.exp(-strength[3] * self._points.log_dp)
        cov = self._shapes.covariance(*strength[:3])
        unit = tilt / self._scale.gain
        cov[np.diag_indices_from(cov)] += (unit * self._data.sd) ** 2 + self._missed
        lower = cholesky(cov.T, lower=True, overwrite_a=True, check_finite=False)
        y = unit * self._data.gain - self._points.opening
        return lower, cho_solve((lower, True), y, check_finite=False), y, tilt
