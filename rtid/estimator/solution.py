"""Solve the joint normal equations and read the result: maps, compliances, intervals, statuses."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from threadpoolctl import ThreadpoolController

from rtid.estimator.state import State
from rtid.kernels.layout import COUNTERS, TERMS
from rtid.kernels.normal import assemble
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
    """The joint estimate.  beta_pa and beta_sd_pa (chambers,); rho: residual variance in units of
    the declared noise, 1 when the model explains the rows to the sensors' noise.
    """

    model: Model
    compliance: FloatArray
    compliance_cov: FloatArray
    blocks: tuple[Block, ...]
    rho: float
    dof: int
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def beta_pa(self) -> FloatArray:
        """Effective bulk modulus per chamber."""
        return 1.0 / self.compliance

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
    """Normal equations in scaled units: gram and right without prior, bias = noise in the gram."""

    gram: FloatArray
    right: FloatArray
    square: float
    bias: FloatArray


def normal_equations(state: State) -> Normal:
    """Read a settled state; n = shared + 6 x visited blocks."""
    e = state.engine[0]
    n = int(e["n_shared"] + TERMS * e["n_slots"])
    gram, right = np.zeros((n, n)), np.zeros(n)
    square = assemble(state.engine, state.blocks, state.pairs, gram, right)
    bias = np.zeros(n)
    n_chambers = int(e["n_chambers"])
    if state.form_is_integral:
        bias[:n_chambers] = e["noise_gram"][:n_chambers]
    return Normal(gram, right, square, bias)


def solve(model: Model, state: State) -> Solution:
    """Joint estimate of everything seen so far; `state` is not changed.

    Pressure noise in the column -V dP inflates its information; what it adds on average is known
    from the declared noise and taken out, so that theta_beta is not biased towards zero.
    """
    settled = state.settled()
    normal = normal_equations(settled)
    e = settled.engine[0]
    n_chambers = int(e["n_chambers"])
    with one_thread():
        factor = factorize(normal, int(e["n_shared"]))
        theta, cov = factor.theta(normal.right), factor.cov()
    rows = int(e["counters"][1]) * n_chambers
    active = int(np.sum(np.diag(normal.gram) * np.diag(cov) > 0.5))
    dof = max(1, rows - active)
    sse = misfit(normal, theta)
    c0 = e["compliance"][:n_chambers]
    compliance = theta[:n_chambers] * c0
    compliance_cov = cov[:n_chambers, :n_chambers] * np.outer(c0, c0)
    blocks = tuple(_block(model, settled, theta, cov, normal, s) for s in range(int(e["n_slots"])))
    counters = {name: int(count) for name, count in zip(COUNTERS, e["counters"], strict=True)}
    return Solution(model, compliance, compliance_cov, blocks, float(sse / dof), dof, counters)


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
        """Solution for one right-hand side (n,), with one step of refinement."""
        right = right * self.scale
        theta = cho_solve((self.lower, True), right)
        theta += cho_solve((self.lower, True), right - self.matrix @ theta)
        return np.asarray(theta * self.scale)

    def cov(self) -> FloatArray:
        """Inverse of the normal matrix (n, n)."""
        inverse, _ = dpotri(self.lower, lower=1)
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        return np.asarray(inverse * np.outer(self.scale, self.scale))


def factorize(normal: Normal, n_shared: int) -> Factor:
    """Factor of information - known bias + prior."""
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram + np.diag(prior - normal.bias)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    matrix *= scale[:, None]
    matrix *= scale
    lower = cho_factor(matrix, lower=True)[0]
    return Factor(matrix, scale, lower)


def _block(
    model: Model, state: State, theta: FloatArray, cov: FloatArray, normal: Normal, slot: int
) -> Block:
    record, e = state.blocks[slot], state.engine[0]
    edge = int(record["edge"])
    at = int(e["n_shared"]) + TERMS * slot
    own = slice(at, at + TERMS)
    q = model.edges[edge].rated_q_m3s
    i, j = divmod(int(record["cell"] - e["first_cell"][edge]), int(e["n_dp"][edge]))
    mean_phi = record["phi_sum"] / max(record["dwell_s"], 1e-12)
    condition = _condition(normal.gram[own, own])
    sd_share = float(np.sqrt(max(0.0, mean_phi @ cov[own, own] @ mean_phi)))
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
        return LEARNING, f"flow known to {100 * sd_share:.1f} % of rated, limit {100 * gates.max_sd_share:.1f} %"
    return VALID, ""
