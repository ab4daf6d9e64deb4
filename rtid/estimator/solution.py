"""Solve the joint normal equations and read the result: maps, compliances, intervals, statuses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rtid.estimator.blocks import Block, mean_flows, read_blocks, rms_slopes
from rtid.estimator.correction import correct, leverage_of, plain
from rtid.estimator.factor import PRIOR_SD, factor_of, misfit, one_thread
from rtid.estimator.state import State
from rtid.estimator.sums import Sums, sums_of
from rtid.estimator.windowed import overlaps, to_taylor
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

ROWS_AT_ONCE = 256  # of a covariance that is changed in place


@dataclass(frozen=True)
class Solution:
    """The joint estimate.

    beta_pa and beta_sd_pa (chambers,); rho: residual variance in units of the declared noise, 1
    when the model explains the rows to the sensors' noise; leverage (chambers,): `leverage_of`.
    In units of the unknowns, scale_pa (chambers,) for the compliances: unknowns (n,), terms of the
    grid cells `cells` (slots,) in the basis of their maps, their covariance cell_cov (slots, 6, 6);
    influence (chambers, n), covariance of the compliances with the unknowns; basis (n, chambers),
    how the former move what is published.
    terms (terms,) and terms_cov: coefficients of the model's shared terms.
    """

    model: Machine
    compliance: FloatArray
    compliance_cov: FloatArray
    blocks: tuple[Block, ...]
    rho: float
    dof: int
    leverage: FloatArray
    basis: FloatArray
    influence: FloatArray
    unknowns: FloatArray
    cells: IntArray
    cell_cov: FloatArray
    scale_pa: FloatArray
    terms: FloatArray
    terms_cov: FloatArray
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def beta_pa(self) -> FloatArray:
        """Effective bulk modulus (chambers,) in Pa; infinite where no compliance is seen."""
        with np.errstate(divide="ignore"):
            return 1.0 / self.compliance

    @property
    def terms_theta(self) -> FloatArray:
        """Coefficients of the shared terms in units of their scales (terms,)."""
        return self.terms / np.array([term.scale for term in self.model.terms])

    @property
    def beta_sd_pa(self) -> FloatArray:
        """Its standard deviation (chambers,) in Pa."""
        with np.errstate(divide="ignore"):
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
class Sketch:
    """First estimate, no variances: compliance (chambers,), flow_m3s (blocks,), NaN: few rows.

    slope, gain (blocks,): root mean squares of dQ/ddp and dQ/dw over the data, m3/s/Pa and m3/s/V;
    cells (blocks,): the grid cells of the blocks; unknowns, influence, scale_pa: as of `Solution`,
    every term taken as learned.
    """

    compliance: FloatArray
    flow_m3s: FloatArray
    slope: FloatArray
    gain: FloatArray
    cells: IntArray
    leverage: FloatArray
    unknowns: FloatArray
    influence: FloatArray
    scale_pa: FloatArray


def sketch(model: Machine, sums: Sums) -> Sketch:
    """The estimate that weighs the next pass: no covariance, every term taken as learned."""
    n_c = len(model.chambers)
    with one_thread():
        factor = factor_of(sums)
        leverage = leverage_of(model, sums, np.ones(len(factor.prior)))
        first = plain(sums, factor)
        corrected = correct(sums, *first, leverage)
        unknowns = theta = corrected.theta
        if overlaps(model):
            theta = to_taylor(model, sums, factor.cov(), PRIOR_SD)[0] @ theta
    flow = mean_flows(model, sums, theta)
    flow[sums.blocks["rows"] < model.gates.min_rows] = np.nan
    slopes = rms_slopes(model, sums, theta)
    influence = first[1].T + corrected.cov_change @ corrected.basis.T
    return Sketch(
        theta[:n_c] * sums.compliance, flow, *slopes, sums.cells, leverage, unknowns, influence,
        sums.compliance,
    )  # fmt: skip


def solve(
    model: Machine,
    learned: State | Sums,
    now_s: float = -np.inf,
    counters: dict[str, int] | None = None,
) -> Solution:
    """Joint estimate of everything seen so far; `learned` is not changed.

    now_s: sample time, for blocks that have not been visited for long; counters: passed on.
    """
    sums = sums_of(learned)
    n_c, ns = len(model.chambers), sums.n_shared
    with one_thread():
        factor = factor_of(sums)
        first = plain(sums, factor)
        cov = factor.cov(is_last=True)
        effective = 1.0 - factor.prior * cov.diagonal()  # of cov @ gram, as cov inverts both
        leverage = leverage_of(model, sums, effective)
        corrected = correct(sums, *first, leverage)
        _add(cov, corrected.basis @ corrected.cov_change, corrected.basis)
    influence, m = cov[:n_c].copy(), len(sums.blocks)
    tiles = cov[ns:, ns:].reshape(m, TERMS, m, TERMS)[np.arange(m), :, np.arange(m)]
    theta, basis = corrected.theta, corrected.basis
    if overlaps(model):
        change, cov = to_taylor(model, sums, cov, PRIOR_SD)
        theta, basis = change @ theta, change @ basis
    dof = max(1, round(sums.rows * n_c - float(effective.sum())))
    scales = np.array([term.scale for term in model.terms])
    return Solution(
        model=model,
        compliance=theta[:n_c] * sums.compliance,
        compliance_cov=cov[:n_c, :n_c] * np.outer(sums.compliance, sums.compliance),
        blocks=tuple(read_blocks(model, sums, theta, cov, now_s)),
        rho=misfit(sums, corrected.theta) / dof,
        dof=dof,
        leverage=leverage,
        basis=basis,
        influence=influence,
        unknowns=corrected.theta,
        cells=sums.cells,
        cell_cov=tiles.copy(),
        scale_pa=sums.compliance,
        terms=theta[n_c:ns] * scales,
        terms_cov=cov[n_c:ns, n_c:ns] * np.outer(scales, scales),
        counters=counters or {},
    )


def _add(cov: FloatArray, moved: FloatArray, basis: FloatArray) -> None:
    """Add moved @ basis.T, both (n, chambers), to cov (n, n) in place, which is large."""
    for k in range(0, len(cov), ROWS_AT_ONCE):
        cov[k : k + ROWS_AT_ONCE] += moved[k : k + ROWS_AT_ONCE] @ basis.T


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
