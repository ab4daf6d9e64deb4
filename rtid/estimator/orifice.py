"""What the visited blocks say about the rest of the map: the orifice law as a Gaussian process.

    Q(w, dp) = s(dp) [K(w) + e(w, dp)],     s(dp) = sign(dp) sqrt |dp|

K(w), the flow gain, is an integrated Wiener process that starts at zero at the edge of the safe
band: smooth where there are data, and less and less certain away from them.  e is what the law does
not explain, in proportion to K, with a correlation that fades over the command and over log |dp|.
How rough K is and how large e is follow from the scatter of Q / s(dp) among the blocks themselves
(largest marginal likelihood), so a valve that does not obey the law says so by wide intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from rtid.model import Edge, FloatArray

REACH_LOG_DP = 1.0  # e fades by 1/e over this change of log |dp| ...
REACH_W = 0.2  # ... and over this share of the command's range
JITTER = 1e-8


@dataclass(frozen=True)
class GainData:
    """Measured flow gains: gain (n,) = Q / s(dp) with sd (n,), m3/s/sqrt(Pa), at w_v, dp_pa (n,)."""

    w_v: FloatArray
    dp_pa: FloatArray
    gain: FloatArray
    sd: FloatArray


@dataclass(frozen=True)
class OrificeLaw:
    """The process of one edge conditioned on its data; see `fit_law`."""

    edge: Edge
    data: GainData
    rough: float  # variance rate of K'' in (rated gain per range)^2 / V
    deviation: float  # standard deviation of e as a share of K
    trend: FloatArray  # K at the data from a first pass: the size of e
    lower: FloatArray
    alpha: FloatArray

    def gain(self, w_v: FloatArray, dp_pa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and covariance (m, m) of Q / s(dp) at the points w_v, dp_pa (m,)."""
        mean, cov = self.gains(w_v[None], dp_pa[None])
        return mean[0], cov[0]

    def gains(self, w_v: FloatArray, dp_pa: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `gain` for c separate sets of m points (c, m): mean (c, m), covariance (c, m, m)."""
        size = self._size(w_v)
        cross = _kernel(self, w_v[..., None], dp_pa[..., None], size[..., None], *self._at_data)
        mean = _prior_gain(self.edge, w_v) + cross @ self.alpha
        flat = solve_triangular(self.lower, cross.reshape(-1, cross.shape[-1]).T, lower=True)
        half = flat.T.reshape(cross.shape)
        points = (w_v[:, :, None], dp_pa[:, :, None], size[:, :, None])
        others = (w_v[:, None, :], dp_pa[:, None, :], size[:, None, :])
        return mean, _kernel(self, *points, *others) - half @ half.transpose(0, 2, 1)

    def _size(self, w_v: FloatArray) -> FloatArray:
        """K from the first pass, which scales e."""
        order = np.argsort(self.data.w_v)
        if len(order) == 0:
            return _prior_gain(self.edge, w_v)
        known = np.interp(w_v, self.data.w_v[order], self.trend[order])
        beyond = np.maximum(w_v / self.data.w_v[order[-1]], 1.0)
        return known * beyond

    @property
    def _at_data(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.data.w_v, self.data.dp_pa, self.trend


def root(dp_pa: FloatArray) -> FloatArray:
    """s(dp) = sign(dp) sqrt |dp|."""
    return np.asarray(np.sign(dp_pa) * np.sqrt(np.abs(dp_pa)))
