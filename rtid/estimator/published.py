"""From the joint estimate to the map that is published: every cell gets six terms and a status.

A visited cell combines what it has learned itself with what the orifice law says from all other
blocks, as two Gaussians: strongly excited terms stay its own, weakly excited ones come from the
law.  A cell without data has the law alone, or a prior map with it (`prior`); and where the map is
known it must not fall with the command (`monotone`).  In information form, with the law's (m, S),
the cell's own (theta, C) and its mean flow phi' theta, which the law has already used and which
counts once:

    (S^-1 + C^-1 - phi phi' / (phi' C phi)) theta_new = S^-1 m + C^-1 theta - phi phi' theta / (...)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rtid.errors import door
from rtid.estimator.blocks import VALID as BLOCK_VALID
from rtid.estimator.blocks import Block
from rtid.estimator.cells import mean_square, projection, quadrature, terms
from rtid.estimator.factor import PRIOR_SD, on_one_thread
from rtid.estimator.flowmap import EXTRAPOLATED, LEARNING, PRIOR, SHUT, VALID, EdgeMap, FlowMap
from rtid.estimator.monotone import monotone
from rtid.estimator.orifice import GainData, OrificeLaw, fit_law, root
from rtid.estimator.prior import SHARE as PRIOR_SHARE
from rtid.estimator.prior import add_prior
from rtid.estimator.solution import Solution
from rtid.estimator.state import MASKS
from rtid.kernels.layout import TERMS
from rtid.model import COMMAND_ONLY, Edge, Grid
from rtid.plain import BoolArray, FloatArray

SHAPE = np.arange(1, TERMS)  # all terms but the constant
COLUMN_PRIOR = 0.05  # share of the rise of K over a column by which its shape may differ
ROUNDED = 1e-13  # of a correlation: less is what rounding left of it


@door
@on_one_thread
def publish(
    solution: Solution, prior: FlowMap | None = None, prior_sd: float = PRIOR_SHARE
) -> FlowMap:
    """The maps of all edges, a shared one once.

    prior: a map known before (see `prior.reference_map` for a data sheet), by the edges' names; its
    flows are believed to the share prior_sd, where this map does not know better.
    """
    edges = solution.model.edges
    of = [[b for b in solution.blocks if b.edge == i] for i in range(len(edges))]
    own = [(e, b) for e, b in zip(edges, of, strict=True) if not e.shares]
    before = {} if prior is None else {e.name: e for e in prior.edges}
    return FlowMap(
        tuple(
            _publish_edge(e, b, before.get(e.name), prior_sd)
            if (e.source or e.sink) and not _over_command_alone(e)
            else _without_pressures(e, b)
            for e, b in own
        )
    )


def _over_command_alone(edge: Edge) -> bool:
    """Declared as Q(u): one interval of dp, and no term in it, so that the law says nothing."""
    return edge.terms == COMMAND_ONLY and edge.grid.shape[1] == 1


def _without_pressures(edge: Edge, blocks: list[Block]) -> EdgeMap:
    """No orifice: each cell says what it has learned, and nothing of its neighbours."""
    shape = edge.grid.shape
    theta = np.zeros((*shape, TERMS))
    cov = np.broadcast_to(
        (PRIOR_SD * edge.rated_q_m3s) ** 2 * np.eye(TERMS), (*shape, TERMS, TERMS)
    )
    cov, status = cov.copy(), np.full(shape, PRIOR, dtype="<U12")
    for b in blocks:
        theta[b.i, b.j], cov[b.i, b.j] = b.theta, _declared(edge, b.cov)
        status[b.i, b.j] = VALID if b.status == BLOCK_VALID else LEARNING
    shut = edge.grid.u_v[1:] <= edge.safe_band_v
    theta[shut], cov[shut], status[shut] = 0.0, 0.0, SHUT
    reason = {(b.i, b.j): b.reason for b in blocks if b.reason}
    return EdgeMap(edge.name, edge.grid, edge.safe_band_v, theta, cov, status, reason)


def _declared(edge: Edge, cov: FloatArray) -> FloatArray:
    """A covariance (6, 6) in which the terms that the map is declared not to have are zero."""
    has = MASKS[edge.terms]
    return np.asarray(cov * np.outer(has, has))


def _publish_edge(
    edge: Edge, blocks: list[Block], prior: EdgeMap | None, prior_sd: float
) -> EdgeMap:
    """Law first, then the prior, then each visited cell combined with them."""
    shut = edge.grid.u_v[1:] <= edge.safe_band_v
    blocks = [b for b in blocks if not shut[b.i]]
    used = [b for b in blocks if _informative(edge, b)]
    law = fit_law(edge, gain_data(edge.grid, used))
    theta, cov = extrapolated(edge.grid, law)
    refine_columns(edge.grid, law, used, theta, cov)
    status = np.full(edge.grid.shape, EXTRAPOLATED if used else PRIOR, dtype="<U12")
    for b in blocks:
        status[b.i, b.j] = VALID if b.status == BLOCK_VALID else LEARNING
    if prior is not None:
        add_prior(edge, prior, prior_sd, used, theta, cov, status)
    reason = {}
    for b in blocks:
        counted = any(b is other for other in used)
        theta[b.i, b.j], cov[b.i, b.j] = combined(theta[b.i, b.j], cov[b.i, b.j], b, counted)
        if b.reason:
            reason[b.i, b.j] = b.reason
    missed = misfit(theta, cov, np.isin(status, (VALID, LEARNING)))
    spread = cov + missed[:, :, None, None] * np.linalg.inv(TERMS * mean_square())
    cov[:, :, 0, 0] += missed
    theta[shut], cov[shut], status[shut] = 0.0, 0.0, SHUT
    free = EdgeMap(edge.name, edge.grid, edge.safe_band_v, theta, cov, status, reason)
    return monotone(free, spread)


def _informative(edge: Edge, block: Block) -> bool:
    """Its mean flow is known at all, at a pressure drop that is not zero."""
    at_dp = mean_root(edge.grid, block)
    return bool(block.mean_sd_m3s < edge.rated_q_m3s and at_dp**2 > 1e-3 * edge.rated_dp_pa)


def gain_data(grid: Grid, blocks: list[Block]) -> GainData:
    """Mean flow over mean root of dp of each block, at the mean point of its data."""
    w = [_mean(grid.u_v, b.i, b.mean_phi[1]) for b in blocks]
    dp = [_mean(grid.dp_pa, b.j, b.mean_phi[2]) for b in blocks]
    s = np.array([mean_root(grid, b) for b in blocks])
    q = np.array([b.mean_flow_m3s for b in blocks])
    sd = np.array([b.mean_sd_m3s for b in blocks])
    return GainData(np.array(w), np.array(dp), q / s, sd / np.abs(s))


def _mean(border: FloatArray, i: int, local: float) -> float:
    return float(0.5 * (border[i] + border[i + 1]) + 0.5 * local * (border[i + 1] - border[i]))


def mean_root(grid: Grid, block: Block) -> float:
    """Mean of s(dp) over the block's data, exact to second order."""
    _, dp = quadrature(grid, block.i)
    return float(block.mean_phi @ projection() @ root(dp[block.j]))


def extrapolated(grid: Grid, law: OrificeLaw) -> tuple[FloatArray, FloatArray]:
    """The law's Taylor terms of every cell, theta (nu, nd, 6), m3/s, and cov (nu, nd, 6, 6)."""
    nu, nd = grid.shape
    theta, cov = np.empty((nu, nd, TERMS)), np.empty((nu, nd, TERMS, TERMS))
    project, phi = projection(), terms()
    for i in range(nu):
        w, dp = quadrature(grid, i)
        s = root(dp)
        mean, spread = law.gains(w, dp)
        q = s * mean
        theta[i] = q @ project.T
        cov[i] = project @ (s[:, :, None] * spread * s[:, None, :]) @ project.T
        rest = q - theta[i] @ phi.T  # what six terms cannot follow
        missed = np.mean(rest**2, axis=1)
        cov[i, :, 0, 0] += missed
        # Over a cell astride dp = 0 the law is odd: it would know the even terms without any error.
        astride = np.flatnonzero((dp.min(axis=1) < 0) & (dp.max(axis=1) > 0))
        cov[i, astride[:, None], SHAPE, SHAPE] += missed[astride, None]
    return theta, cov


def refine_columns(
    grid: Grid, law: OrificeLaw, blocks: list[Block], theta: FloatArray, cov: FloatArray
) -> None:
    """Give each cell what the other visited cells of its column say about K(w) within it.

    The law is smooth; where the dead band ends K(w) is not.  Per column K gets a correction
    c0 + c1 xi + c2 xi^2 from its blocks' terms, with a share of K's rise as prior.  theta
    (nu, nd, 6), m3/s, and cov (nu, nd, 6, 6) are changed in place.
    """
    for i in sorted({b.i for b in blocks}):
        _, dp = quadrature(grid, i)
        shapes = projection() @ (root(dp)[:, :, None] * terms()[:, [0, 1, 3]])
        ends = law.gains(grid.u_v[i : i + 2, None], np.full((2, 1), law.scale.dp_pa))[0]
        prior_sd = COLUMN_PRIOR * abs(float(ends[1, 0] - ends[0, 0])) + 1e-12 * law.scale.gain
        info, right = np.zeros((len(dp), 3, 3)), np.zeros((len(dp), 3))
        for b in (b for b in blocks if b.i == i):
            weight = np.linalg.inv(b.cov + cov[i, b.j]) @ shapes[b.j]
            info[b.j] = shapes[b.j].T @ weight
            right[b.j] = weight.T @ (b.theta - theta[i, b.j])
        spread = np.linalg.inv(info.sum(axis=0) - info + np.eye(3) / prior_sd**2)
        shift = spread @ (right.sum(axis=0) - right)[:, :, None]
        theta[i] += (shapes @ shift)[:, :, 0]
        cov[i] += shapes @ spread @ shapes.transpose(0, 2, 1)


def cell_terms(grid: Grid, flow: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
    """Taylor terms (nu * nd, 6), m3/s, of a known flow in every cell, by least squares over it."""
    points = [quadrature(grid, i) for i in range(grid.shape[0])]
    return np.concatenate([flow(w, dp) @ projection().T for w, dp in points])


def information_of(cov: FloatArray, least: float) -> FloatArray:
    """Inverse (6, 6), s2/m6, of a covariance (6, 6), m6/s2.

    least: of a correlation; nothing is known to less.  A block that one motion has crossed knows
    some directions 1e16 times better than others.
    """
    scale = np.sqrt(np.diag(cov))
    outer = np.outer(scale, scale)
    return np.asarray(np.linalg.inv(cov / outer + least * np.eye(len(cov))) / outer)


def combined(
    m: FloatArray, S: FloatArray, block: Block, counted: bool
) -> tuple[FloatArray, FloatArray]:
    """Law (m, S) and block as two Gaussians; counted: the law contains the block's mean flow."""
    scale, phi = np.sqrt(np.diag(S)), block.mean_phi
    law, information = information_of(S, 1e-9), information_of(block.cov, ROUNDED)
    if counted:
        information = information - np.outer(phi, phi) / block.mean_sd_m3s**2
    total = (law + information) * np.outer(scale, scale)
    cov = np.linalg.inv(0.5 * (total + total.T)) * np.outer(scale, scale)
    return cov @ (law @ m + information @ block.theta), cov


def misfit(theta: FloatArray, cov: FloatArray, visited: BoolArray) -> FloatArray:
    """Variance (nu, nd), m6/s2, of each visited cell's own misfit, from steps at its borders.

    Six terms miss a cubic flow by opposite amounts at the two ends of a block, so that half of the
    step to a neighbour beyond what noise explains is the misfit of either.
    """
    excess, count = np.zeros(visited.shape), np.zeros(visited.shape)
    for axis, term in ((0, 1), (1, 2)):
        end = np.zeros(TERMS)
        end[[0, term, term + 2]] = 1.0
        start = end * np.where(np.arange(TERMS) == term, -1.0, 1.0)
        first, second = _pairs(axis)
        step = theta[first] @ end - theta[second] @ start
        noise = end @ cov[first] @ end + start @ cov[second] @ start
        both = visited[first] & visited[second]
        for side in (first, second):
            excess[side] += np.where(both, step**2 - noise, 0.0) / 4
            count[side] += both
    return np.maximum(excess, 0.0) / np.maximum(count, 1.0)


def _pairs(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    first, second = [slice(None)] * 2, [slice(None)] * 2
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(second)
