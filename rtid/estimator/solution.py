"""Solve the joint normal equations and read the result: maps, compliances, intervals, statuses."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from threadpoolctl import ThreadpoolController

from rtid.estimator.lapped import overlaps, to_taylor
from rtid.estimator.state import MASKS, State
from rtid.kernels.layout import COUNTERS, ROWS, TERMS
from rtid.kernels.normal import assemble, mirror
from rtid.model import FloatArray, Model

# One standard deviation of the prior on a flow term: ten times the rated flow, so that directions
# without data stay finite and are seen as unknown by their variance.
PRIOR_SD = 10.0
SHARED_PRIOR = 1e-2  # information on beta_nominal / beta: worth knowing it to a factor of ten

EMPTY, LEARNING, VALID = "empty", "learning", "valid"


@dataclass(frozen=True)
class Block:
    """One visited block of one edge's map.

    theta (6,) and cov (6, 6) in m3/s, terms of `rtid.kernels.basis`; mean_phi (6,) is the basis
    averaged over the time spent here, so mean_phi @ theta is the block-mean flow.  cov is marginal
    over the shared parameters and all other blocks.
    """

    edge: int
    i: int
    j: int
    theta: FloatArray
    cov: FloatArray
    mean_phi: FloatArray
    rows: int
    dwell_s: float
    last_s: float
    condition: float
    status: str
    reason: str

    @property
    def mean_flow_m3s(self) -> float:
        """Flow averaged over the data in the block."""
        return float(self.mean_phi @ self.theta)

    @property
    def mean_sd_m3s(self) -> float:
        """Its standard deviation from sensor noise."""
        return float(np.sqrt(self.mean_phi @ self.cov @ self.mean_phi))


@dataclass(frozen=True)
class Solution:
    """The joint estimate.

    beta_pa and beta_sd_pa (chambers,); rho: residual variance in units of the declared noise, 1
    when the model explains the rows to the sensors' noise; leverage (chambers,): `leverage_of`.
    In units of the unknowns, scale_pa (chambers,) for the compliances: unknowns (n,), terms of the
    grid cells `cells` (slots,) in the basis of their maps; influence (chambers, n), covariance of
    the compliances with them; basis (n, chambers), how the former move what is published.
    terms (terms,) and terms_cov: coefficients of the model's shared terms.
    """

    model: Model
    compliance: FloatArray
    compliance_cov: FloatArray
    blocks: tuple[Block, ...]
    rho: float
    dof: int
    leverage: FloatArray
    basis: FloatArray
    influence: FloatArray
    unknowns: FloatArray
    cells: NDArray[np.int64]
    scale_pa: FloatArray
    terms: FloatArray
    terms_cov: FloatArray
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def beta_pa(self) -> FloatArray:
        """Effective bulk modulus per chamber."""
        return 1.0 / self.compliance

    @property
    def terms_theta(self) -> FloatArray:
        """Coefficients of the shared terms in units of their scales (terms,)."""
        return self.terms / np.array([term.scale for term in self.model.terms])

    @property
    def beta_sd_pa(self) -> FloatArray:
        """Its standard deviation."""
        return np.sqrt(np.diag(self.compliance_cov)) / self.compliance**2

    def block(self, edge: int, i: int, j: int) -> Block | None:
        """The block of a cell, None if it was never visited."""
        return self._index.get((edge, i, j))

    @property
    def _index(self) -> dict[tuple[int, int, int], Block]:
        cache: dict[tuple[int, int, int], Block] | None = self.__dict__.get("_by_cell")
        if cache is None:
            cache = {(b.edge, b.i, b.j): b for b in self.blocks}
            object.__setattr__(self, "_by_cell", cache)
        return cache


@dataclass(frozen=True)
class Normal:
    """Normal equations in scaled units, without prior.

    gram (n, n), right (n,), square = y'y; noise (chambers,): what pressure noise adds on average to
    the diagonal of gram for -V dP; rows: pairs of rows.
    """

    gram: FloatArray
    right: FloatArray
    square: float
    noise: FloatArray
    rows: int


def normal_equations(state: State) -> Normal:
    """Read a settled state; n = shared + 6 x visited blocks."""
    e = state.engine[0]
    n = int(e["n_shared"] + TERMS * e["n_slots"])
    gram, right = np.zeros((n, n)), np.zeros(n)
    square = assemble(state.engine, state.blocks, state.pairs, gram, right)
    noise = e["noise_gram"][: int(e["n_chambers"])].copy()
    return Normal(gram, right, square, noise, int(e["counters"][ROWS]))


@dataclass(frozen=True)
class Corrected:
    """The estimate with the noise in -V dP taken out: errors in variables, least squares corrected.

    theta (n,); basis (n, chambers): how theta follows the compliances; cov_change (chambers,
    chambers): what the correction adds to their covariance; cost: the minimum of
    |y - rows theta|^2 - theta' noise theta, comparable between nuisance parameters.
    """

    theta: FloatArray
    basis: FloatArray
    cov_change: FloatArray
    cost: float


def correct(normal: Normal, factor: Factor, leverage: FloatArray) -> Corrected:
    """Take the noise out of the compliances' information, and let the flow terms follow.

    leverage (chambers,): share of the noise that the flow terms absorb (see `leverage_of`).  Where
    the motion holds no more information than the noise pretends, little is left, and the
    variance says so.
    """
    n_c = len(normal.noise)
    theta = factor.theta(normal.right)
    columns = factor.columns(n_c)
    information = np.linalg.inv(columns[:n_c])
    noise = np.diag(normal.noise * (1 - leverage))
    least = SHARED_PRIOR + 3 * np.sqrt(2 / max(1, normal.rows)) * normal.noise
    left, drawn = _at_least(information - noise, least)
    cov = np.linalg.inv(left)
    basis = columns @ information
    shift = cov @ information @ theta[:n_c] - theta[:n_c]
    # noise times noise: its share of the rows' own variance adds to that of the product
    own = normal.noise / max(1, normal.rows)
    cov_change = cov + cov @ (noise * (1 + own)) @ cov - columns[:n_c] + drawn
    told = theta[:n_c] + shift
    cost = misfit(normal, theta) + shift @ information @ shift - told @ noise @ told
    return Corrected(theta + basis @ shift, basis, cov_change, float(cost))


def _at_least(information: FloatArray, least: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Symmetric matrix with its eigenvalues, in units of `least`, raised to 1; and the error.

    At 1, three standard deviations of what noise alone pretends, nothing may be known at all, and
    the estimate is drawn to zero; from 2 on the variance tells.  The second result is the square
    of the error so made, for compliances of the nominal size.
    """
    scale = np.sqrt(least)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    missing = np.clip(2.0 - values, 0.0, 1.0)
    raised = (vectors * np.maximum(values, 1.0)) @ vectors.T
    drawn = (vectors / scale[:, None]) * missing * (vectors.T @ scale)
    return np.asarray(raised * np.outer(scale, scale)), np.asarray(drawn @ drawn.T)


def leverage_of(state: State, effective: FloatArray) -> FloatArray:
    """Share (chambers,) of the noise in each column -V dP that the flow terms absorb.

    Noise that the maps can follow never reaches theta_beta.  effective (n,): degrees of freedom
    per unknown.  Terms of the chamber's own edges lie in the same direction of the pair of
    whitened rows as the noise; those of the other chamber at the angle whose cosine is the
    correlation of the two innovations.
    """
    e = state.engine[0]
    n_c, n_slots = int(e["n_chambers"]), int(e["n_slots"])
    feeds = e["sign"][state.blocks["edge"][:n_slots], :n_c] != 0
    terms = effective[int(e["n_shared"]) :].reshape(n_slots, TERMS).sum(axis=1)
    s00, s01, s11 = e["innovation"]
    alike = s01**2 / (s00 * s11) if n_c == 2 and s00 * s11 > 0 else 0.0
    cosines = np.where(np.eye(n_c, dtype=bool), 1.0, alike)
    return np.clip(cosines @ (terms @ feeds) / max(1, int(e["counters"][ROWS])), 0.0, 0.9)


@dataclass(frozen=True)
class Sketch:
    """First estimate, no variances: compliance (chambers,), flow_m3s (slots,), NaN: few rows."""

    compliance: FloatArray
    flow_m3s: FloatArray
    leverage: FloatArray


def sketch(model: Model, state: State) -> Sketch:
    """The estimate that weighs the next pass: no covariance, every term taken as learned."""
    settled = state.settled()
    e, normal = settled.engine[0], normal_equations(settled)
    n_c, ns, n_slots = int(e["n_chambers"]), int(e["n_shared"]), int(e["n_slots"])
    leverage = leverage_of(settled, np.ones(len(normal.right)))
    with one_thread():
        factor = factorize(normal, ns)
        theta = correct(normal, factor, leverage).theta
        if overlaps(model):
            theta = to_taylor(model, settled, factor.cov(), PRIOR_SD)[0] @ theta
    flow = _mean_flows(settled, theta)
    flow[settled.blocks["rows"][:n_slots] < model.gates.min_rows] = np.nan
    return Sketch(theta[:n_c] * e["compliance"][:n_c], flow, leverage)


def solve(model: Model, state: State) -> Solution:
    """Joint estimate of everything seen so far; `state` is not changed."""
    settled = state.settled()
    e, normal = settled.engine[0], normal_equations(settled)
    n_c = int(e["n_chambers"])
    with one_thread():
        factor = factorize(normal, int(e["n_shared"]))
        cov = factor.cov()
        effective = np.einsum("ij,ij->i", cov, normal.gram)
        leverage = leverage_of(settled, effective)
        found = correct(normal, factor, leverage)
        cov += found.basis @ found.cov_change @ found.basis.T
    influence = cov[:n_c].copy()
    theta, basis, left = found.theta, found.basis, misfit(normal, found.theta)
    if overlaps(model):
        change, cov = to_taylor(model, settled, cov, PRIOR_SD)
        theta, basis = change @ theta, change @ basis
    dof = max(1, normal.rows * n_c - round(float(effective.sum())))
    c0 = e["compliance"][:n_c]
    scales = np.array([term.scale for term in model.terms])
    counters = {name: int(count) for name, count in zip(COUNTERS, e["counters"], strict=True)}
    largest = _largest_flows(model, settled, theta)
    blocks = tuple(
        _block(model, settled, theta, cov, normal, s, largest) for s in range(int(e["n_slots"]))
    )
    return Solution(
        model=model,
        compliance=theta[:n_c] * c0,
        compliance_cov=cov[:n_c, :n_c] * np.outer(c0, c0),
        blocks=blocks,
        rho=left / dof,
        dof=dof,
        leverage=leverage,
        basis=basis,
        influence=influence,
        unknowns=found.theta,
        cells=settled.blocks["cell"][: int(e["n_slots"])].copy(),
        scale_pa=c0.copy(),
        terms=theta[n_c : int(e["n_shared"])] * scales,
        terms_cov=cov[n_c : int(e["n_shared"]), n_c : int(e["n_shared"])]
        * np.outer(scales, scales),
        counters=counters,
    )


def widen(solution: Solution, more: FloatArray) -> Solution:
    """The solution with `more` (chambers, chambers) added to the covariance of the compliances.

    In units of the nominal compliances; the flow terms follow the compliances as in the fit.
    """
    n_c = len(more)
    c0 = solution.scale_pa
    blocks = []
    for slot, block in enumerate(solution.blocks):
        at = n_c + len(solution.terms) + TERMS * slot
        follow = solution.basis[at : at + TERMS] * solution.model.edges[block.edge].rated_q_m3s
        blocks.append(replace(block, cov=block.cov + follow @ more @ follow.T))
    cov = solution.compliance_cov + more * np.outer(c0, c0)
    return replace(solution, compliance_cov=cov, blocks=tuple(blocks))


@cache
def _linear_algebra() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Keep linear algebra on the calling thread.

    Its worker threads spin while they wait: measured 40 times slower when another process computes,
    and on the device they would take the controller's core.
    """
    return _linear_algebra().limit(limits=1, user_api="blas")


def misfit(normal: Normal, theta: FloatArray) -> float:
    """Sum of squares of the rows that theta leaves."""
    return float(normal.square - 2 * normal.right @ theta + theta @ normal.gram @ theta)


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of the scaled normal matrix: columns scaled to unit information."""

    matrix: FloatArray
    scale: FloatArray
    lower: FloatArray

    def theta(self, right: FloatArray) -> FloatArray:
        """Solution for right-hand sides (n,) or (n, m), with one step of refinement."""
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        right = right * scale
        theta = cho_solve((self.lower, True), right)
        theta += cho_solve((self.lower, True), right - self.matrix @ theta)
        return np.asarray(theta * scale)

    def columns(self, m: int) -> FloatArray:
        """The first m columns (n, m) of the inverse."""
        return self.theta(np.eye(len(self.scale), m))

    def cov(self) -> FloatArray:
        """Inverse of the normal matrix (n, n)."""
        inverse, _ = dpotri(self.lower, lower=1)
        mirror(inverse.T, self.scale)  # Fortran order: the transpose holds the upper triangle
        return np.asarray(inverse)


def factorize(normal: Normal, n_shared: int) -> Factor:
    """Factor of information + prior."""
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram + np.diag(prior)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    matrix *= scale[:, None]
    matrix *= scale
    lower = cho_factor(matrix, lower=True)[0]
    return Factor(matrix, scale, lower)


def _mean_flows(state: State, theta: FloatArray) -> FloatArray:
    """Flow averaged over the data of each slot (slots,), m3/s."""
    e = state.engine[0]
    records = state.blocks[: int(e["n_slots"])]
    mean_phi = records["phi_sum"] / np.maximum(records["dwell_s"], 1e-12)[:, None]
    terms = theta[int(e["n_shared"]) :].reshape(-1, TERMS)
    return np.asarray(e["scale_m3s"][records["edge"]] * (mean_phi * terms).sum(axis=1))


def _largest_flows(model: Model, state: State, theta: FloatArray) -> FloatArray:
    """Largest block-mean flow of each edge (edges,), m3/s; the rated flow where none is known."""
    flows, records = (
        np.abs(_mean_flows(state, theta)),
        state.blocks[: int(state.engine[0]["n_slots"])],
    )
    enough = records["rows"] >= model.gates.min_rows
    return np.array(
        [
            flows[enough & (records["edge"] == i)].max(initial=0.0) or edge.rated_q_m3s
            for i, edge in enumerate(model.edges)
        ]
    )


def _block(
    model: Model,
    state: State,
    theta: FloatArray,
    cov: FloatArray,
    normal: Normal,
    slot: int,
    largest_m3s: FloatArray,
) -> Block:
    record, e = state.blocks[slot], state.engine[0]
    edge = int(record["edge"])
    at = int(e["n_shared"]) + TERMS * slot
    own = slice(at, at + TERMS)
    q = model.edges[edge].rated_q_m3s
    i, j = divmod(int(record["cell"] - e["first_cell"][edge]), int(e["n_dp"][edge]))
    mean_phi = record["phi_sum"] / max(record["dwell_s"], 1e-12)
    used = at + np.flatnonzero(MASKS[model.edges[edge].terms])
    condition = _condition(normal.gram[np.ix_(used, used)])
    sd_share = q / largest_m3s[edge] * float(np.sqrt(max(0.0, mean_phi @ cov[own, own] @ mean_phi)))
    status, reason = _status(model, int(record["rows"]), condition, sd_share)
    return Block(
        edge,
        i,
        j,
        theta[own] * q,
        cov[own, own] * q * q,
        mean_phi,
        int(record["rows"]),
        float(record["dwell_s"]),
        float(record["last_s"]),
        condition,
        status,
        reason,
    )


def _condition(gram: FloatArray) -> float:
    """Condition number of Phi'Phi in local coordinates; inf where a term was never excited."""
    values = np.linalg.eigvalsh(gram)
    return float(values[-1] / values[0]) if values[0] > 0 else np.inf


def _status(model: Model, rows: int, condition: float, sd_share: float) -> tuple[str, str]:
    """Status and the reason why a block is not valid, in words."""
    gates = model.gates
    if rows < gates.min_rows:
        return LEARNING, f"{rows} rows, {gates.min_rows} needed"
    if not condition <= gates.condition_limit:
        return LEARNING, f"condition number {condition:.1e} above {gates.condition_limit:.0e}"
    if sd_share > gates.max_sd_share:
        known, limit = 100 * sd_share, 100 * gates.max_sd_share
        return LEARNING, f"flow known to {known:.2g} % of the largest, limit {limit:.2g} %"
    return VALID, ""
