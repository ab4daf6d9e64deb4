"""A map that was known before: a data sheet, or what another machine has learned.

Its flows are believed to a declared share,

    Q(w, dp) = Q_prior(w, dp) + e(w, dp),    sd of e = share |Q_prior|, and LEAST_SIZE of the rated
                                             gain, because dead bands end elsewhere,

with the reach of the orifice law's deviations, and to the prior's own standard deviation.  In cells
that are not known from data the law and the prior are combined as two Gaussians:

    gain = S (S + P)^-1,    theta = m + gain (p - m),    cov = S - gain S.

Beside dp = 0 the law is one guess of how a flow turns laminar, with one size for all six terms; to
combine it would take its shape for certain, so there the surer of the two counts alone.  A prior
that misses the blocks that are known is believed less everywhere: its share is at least the rms of
its misses there over the rms of its flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtid.estimator.blocks import Block
from rtid.estimator.cells import mean, projection, quadrature, terms
from rtid.estimator.flowmap import EXTRAPOLATED, PRIOR, VALID, EdgeMap, FlowMap
from rtid.estimator.orifice import LEAST_SIZE, REACH_LOG_DP, REACH_W, root
from rtid.kernels.layout import TERMS
from rtid.model import Edge, Machine
from rtid.plain import FloatArray

SHARE = 0.1  # relative standard deviation of a prior's flows
FEWEST = 3  # blocks that tell how well a prior fits


@dataclass(frozen=True)
class Prior:
    """A map known before, and the relative standard deviation of its flows."""

    name: str
    flowmap: FlowMap
    share: float = SHARE


def reference_map(model: Machine, theta_cells: FloatArray) -> FlowMap:
    """A data sheet as a prior: terms (cells, 6) of all edges, m3/s; NaN where it has nothing."""
    edges, first = [], 0
    for edge in model.maps:
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
    known: Sequence[Block],
    theta: FloatArray,
    cov: FloatArray,
    status: NDArray[np.str_],
) -> None:
    """Combine the law's terms with the prior's in every cell that is not valid, in place.

    A cell without data is PRIOR where the prior is surer of its mean flow than the law, else
    EXTRAPOLATED.  Cells that the prior does not cover stay as they are.  known: the blocks that the
    prior is held against; theta (nu, nd, 6) m3/s, cov (nu, nd, 6, 6), status (nu, nd).
    """
    every, spread = prior_terms(edge, prior, share, known)
    open_ = np.isfinite(every).all(axis=2) & (status != VALID)
    (m, S), (p, P) = (theta[open_], cov[open_]), (every[open_], spread[open_])
    surer = _mean_variance(P) < _mean_variance(S)
    apart = (p - m)[:, :, None]
    gain = np.linalg.solve(S + P, S).transpose(0, 2, 1)
    at_zero = np.broadcast_to(edge.grid.dp_pa[1:] * edge.grid.dp_pa[:-1] <= 0, open_.shape)[open_]
    gain[at_zero] = 0.0
    replaced = surer & at_zero
    theta[open_] = m + np.where(replaced[:, None], p - m, (gain @ apart)[:, :, 0])
    cov[open_] = np.where(replaced[:, None, None], P, _symmetric(S - gain @ S))
    empty = np.isin(status[open_], (EXTRAPOLATED, PRIOR))
    status[open_] = np.where(empty, np.where(surer, PRIOR, EXTRAPOLATED), status[open_])


def prior_terms(
    edge: Edge, prior: EdgeMap, share: float, known: Sequence[Block] = ()
) -> tuple[FloatArray, FloatArray]:
    """Taylor terms (nu, nd, 6), m3/s, and covariance (nu, nd, 6, 6), m6/s2, of the prior.

    On the edge's grid; NaN off its own.
    """
    points = [quadrature(edge.grid, i) for i in range(edge.grid.shape[0])]
    q = np.stack([prior.flow(w, dp) for w, dp in points])
    theta = q @ projection().T
    share = max(share, seen_share(theta, known))
    cov = np.stack([_cov(edge, share, w, dp, q_block, prior.sd(w, dp))
                    for q_block, (w, dp) in zip(q, points, strict=True)])  # fmt: skip
    cov[..., 0, 0] += np.mean((q - theta @ terms().T) ** 2, axis=-1)  # beyond six terms
    return theta, cov


def _cov(
    edge: Edge, share: float, w: FloatArray, dp: FloatArray, q: FloatArray, q_block: FloatArray
) -> FloatArray:
    """Covariance (nd, 6, 6) of a column of cells' terms; q, q_block (nd, 16) at its points."""
    least = LEAST_SIZE * edge.rated_q_m3s * np.abs(root(dp / edge.rated_dp_pa))
    sd = np.hypot(share * q, least)
    spread = sd[:, :, None] * _alike(edge, w, dp) * sd[:, None, :]
    spread += q_block[:, :, None] * q_block[:, None, :]
    return np.asarray(projection() @ spread @ projection().T)


def seen_share(theta: FloatArray, known: Sequence[Block]) -> float:
    """Rms miss of the prior's terms (nu, nd, 6), m3/s, in the blocks' mean flows, of the rms flow.

    0 where the prior covers fewer than three blocks.
    """
    at = [b for b in known if np.isfinite(theta[b.i, b.j]).all()]
    if len(at) < FEWEST:
        return 0.0
    flow = np.array([b.mean_phi @ theta[b.i, b.j] for b in at])
    miss = np.array([b.mean_flow_m3s for b in at]) - flow
    return float(np.linalg.norm(miss) / (float(np.linalg.norm(flow)) or np.inf))


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
