"""A map that was known before: a data sheet, or what another machine has learned.

Its flows are believed to a declared share,

    Q(w, dp) = Q_prior(w, dp) + e(w, dp),    sd of e = share |Q_prior|, and LEAST_SIZE of the rated
                                             gain, because dead bands end elsewhere,

with the reach of the orifice law's deviations, and to the prior's own standard deviation.  In cells
that are not known from data the law and the prior are combined as two Gaussians:

    gain = S (S + P)^-1,    theta = m + gain (p - m),    cov = S - gain S.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.cells import mean, projection, quadrature
from rtid.estimator.flowmap import EXTRAPOLATED, PRIOR, VALID, EdgeMap, FlowMap
from rtid.estimator.orifice import LEAST_SIZE, REACH_LOG_DP, REACH_W, root
from rtid.kernels.layout import TERMS
from rtid.model import Edge, FloatArray, Model

SHARE = 0.1  # relative standard deviation of a prior's flows


def reference_map(model: Model, theta_cells: FloatArray) -> FlowMap:
    """A data sheet as a prior: terms (cells, 6) of all edges, NaN where the sheet has nothing."""
    edges, first = [], 0
    for edge in model.edges:
        nu, nd = edge.grid.shape
        theta = theta_cells[first : first + nu * nd].reshape(nu, nd, TERMS)
        first += nu * nd
        exact, status = np.zeros((nu, nd, TERMS, TERMS)), np.full((nu, nd), PRIOR)
        edges.append(EdgeMap(edge.name, edge.grid, edge.safe_band_v, theta, exact, status, {}))
    return FlowMap(tuple(edges))


def add_prior(
    edge: Edge,
    prior: EdgeMap,
    share: float,
    theta: FloatArray,
    cov: FloatArray,
    status: NDArray[np.str_],
) -> None:
    """Combine the law's terms with the prior's in every cell that is not valid, in place.

    A cell without data is PRIOR where the prior is surer of its mean flow than the law, else
    EXTRAPOLATED.  Cells that the prior does not cover stay as they are.
    """
    p, P = prior_terms(edge, prior, share)
    open_ = np.isfinite(p).all(axis=2) & (status != VALID)
    m, S = theta[open_], cov[open_]
    surer = _mean_variance(P[open_]) < _mean_variance(S)
    gain = np.linalg.solve(S + P[open_], S).transpose(0, 2, 1)
    theta[open_] = m + (gain @ (p[open_] - m)[:, :, None])[:, :, 0]
    cov[open_] = _symmetric(S - gain @ S)
    empty = np.isin(status[open_], (EXTRAPOLATED, PRIOR))
    status[open_] = np.where(empty, np.where(surer, PRIOR, EXTRAPOLATED), status[open_])


def prior_terms(edge: Edge, prior: EdgeMap, share: float) -> tuple[FloatArray, FloatArray]:
    """Taylor terms (nu, nd, 6) and covariance of the prior on the edge's grid; NaN off its own."""
    (nu, nd), project = edge.grid.shape, projection()
    theta, cov = np.empty((nu, nd, TERMS)), np.empty((nu, nd, TERMS, TERMS))
    for i in range(nu):
        w, dp = quadrature(edge.grid, i)
        q, own = prior.flow(w, dp), prior.sd(w, dp)
        least = LEAST_SIZE * edge.rated_q_m3s * np.abs(root(dp / edge.rated_dp_pa))
        spread = np.hypot(share * q, least)[:, :, None] * _alike(edge, w, dp)
        spread = spread * np.hypot(share * q, least)[:, None, :] + own[:, :, None] * own[:, None, :]
        theta[i] = q @ project.T
        cov[i] = project @ spread @ project.T
    return theta, cov


def _alike(edge: Edge, w: FloatArray, dp: FloatArray) -> FloatArray:
    """Correlation (nd, 16, 16) of the prior's errors within each cell."""
    reach_v = REACH_W * (edge.grid.u_v[-1] - edge.grid.u_v[0])
    log_dp = np.log(np.abs(dp) + 0.01 * np.diff(edge.grid.dp_pa).min())
    far = np.abs(w[:, :, None] - w[:, None, :]) / reach_v
    far += np.abs(log_dp[:, :, None] - log_dp[:, None, :]) / REACH_LOG_DP
    return np.asarray(np.exp(-far))


def _mean_variance(cov: FloatArray) -> FloatArray:
    """Variance of the cells' mean flows."""
    return np.asarray(mean() @ cov @ mean())


def _symmetric(cov: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (cov + cov.transpose(0, 2, 1)))
