"""One block of a map as the joint estimate knows it: terms, covariance, status, progress."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtid.estimator.state import RecordArray, fitted_terms
from rtid.estimator.sums import Sums
from rtid.kernels.layout import TERMS
from rtid.model import Gates, Machine
from rtid.plain import FloatArray

EMPTY, LEARNING, VALID, STALE, INVALID = "empty", "learning", "valid", "stale", "invalid"


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
    progress: float = 1.0  # share of the way to a valid block

    @property
    def mean_flow_m3s(self) -> float:
        """Flow averaged over the data in the block."""
        return float(self.mean_phi @ self.theta)

    @property
    def mean_sd_m3s(self) -> float:
        """Its standard deviation from sensor noise."""
        return float(np.sqrt(self.mean_phi @ self.cov @ self.mean_phi))


def mean_phi(records: RecordArray) -> FloatArray:
    """Taylor terms averaged over the time spent in each block (m, 6)."""
    return np.asarray(records["phi_sum"] / np.maximum(records["dwell_s"], 1e-12)[:, None])


def mean_flows(model: Machine, sums: Sums, theta: FloatArray) -> FloatArray:
    """Flow averaged over the data of each block (m,), m3/s; theta (n,) in Taylor terms."""
    rated = np.array([edge.rated_q_m3s for edge in model.edges])
    terms = theta[sums.n_shared :].reshape(-1, TERMS)
    return np.asarray(rated[sums.blocks["edge"]] * (mean_phi(sums.blocks) * terms).sum(axis=1))


def rms_slopes(model: Machine, sums: Sums, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root mean squares of dQ/ddp and dQ/dw over the data of each block, both (m,); theta as above.

    In m3/s/Pa and m3/s/V.
    """
    one, xi, eta, xi2, eta2, both = mean_phi(sums.blocks).T
    _, a, b, a2, b2, c = theta[sums.n_shared :].reshape(-1, TERMS).T
    height = [np.tile(np.diff(e.grid.dp_pa), e.grid.shape[0]) for e in model.edges]
    width = [np.repeat(np.diff(e.grid.u_v), e.grid.shape[1]) for e in model.edges]
    return (
        _rms(model, sums, height, (b, 2 * b2, c), (one, eta, xi, eta2, xi2, both)),
        _rms(model, sums, width, (a, 2 * a2, c), (one, xi, eta, xi2, eta2, both)),
    )


def _rms(
    model: Machine,
    sums: Sums,
    size: list[FloatArray],
    slope: tuple[FloatArray, ...],
    means: tuple[FloatArray, ...],
) -> FloatArray:
    """Of a + b z + c y over the data of each block (m,), where z runs along size (cells,) by edge.

    slope: a, b and c; means: of 1, z, y, z^2, y^2 and z y; all (m,).
    """
    a, b, c = slope
    one, z, y, z2, y2, zy = means
    square = a**2 * one + b**2 * z2 + c**2 * y2 + 2 * (a * b * z + a * c * y + b * c * zy)
    edge, place = sums.blocks["edge"], sums.blocks["cell"]
    own = place - np.array(model.first_cells)[edge]
    rated = np.array([e.rated_q_m3s for e in model.edges])[edge]
    half = 0.5 * np.array([size[e][p] for e, p in zip(edge, own, strict=True)])
    return np.asarray(rated / half * np.sqrt(np.maximum(square, 0.0)))


def largest_flows(model: Machine, sums: Sums, theta: FloatArray) -> FloatArray:
    """Largest block-mean flow of each edge (edges,), m3/s; the rated flow where none is known."""
    flows = np.abs(mean_flows(model, sums, theta))
    enough = sums.blocks["rows"] >= model.gates.min_rows
    return np.array(
        [
            flows[enough & (sums.blocks["edge"] == i)].max(initial=0.0) or edge.rated_q_m3s
            for i, edge in enumerate(model.edges)
        ]
    )


class _Seen(NamedTuple):
    """What a block's record says of its data."""

    edge: int
    cell: int
    rows: int
    dwell_s: float
    last_s: float
    judged: float
    surprise: float


def read_blocks(
    model: Machine, sums: Sums, theta: FloatArray, cov: FloatArray, now_s: float
) -> Iterator[Block]:
    """All visited blocks.

    theta (n,) and cov (n, n) in Taylor terms.
    """
    ns, m, means = sums.n_shared, len(sums.blocks), mean_phi(sums.blocks)
    tiles = cov[ns:, ns:].reshape(m, TERMS, m, TERMS)[np.arange(m), :, np.arange(m)]
    rated = np.array([edge.rated_q_m3s for edge in model.edges])[sums.blocks["edge"]]
    variance = np.einsum("mi,mij,mj->m", means, tiles, means)
    most = largest_flows(model, sums, theta)[sums.blocks["edge"]]
    sd_share = (rated / most * np.sqrt(np.maximum(0.0, variance))).tolist()
    terms = theta[ns:].reshape(m, TERMS) * rated[:, None]
    tiles *= rated[:, None, None] ** 2
    condition = conditions(model, sums.blocks).tolist()
    seen = map(_Seen, *(sums.blocks[name].tolist() for name in _Seen._fields))
    for k, of in enumerate(seen):
        status, reason = _status(model.gates, of, condition[k], sd_share[k], now_s)
        progress = _progress(model.gates, of.rows, condition[k], sd_share[k])
        at = divmod(of.cell - model.first_cells[of.edge], model.edges[of.edge].grid.shape[1])
        yield Block(
            of.edge, *at, terms[k], tiles[k], means[k], of.rows, of.dwell_s, of.last_s,
            condition[k], status, reason, progress,
        )  # fmt: skip


def conditions(model: Machine, blocks: RecordArray) -> FloatArray:
    """Condition number of each block's Phi'Phi in local coordinates (m,), of the terms it has.

    inf where a term was never excited.
    """
    condition = np.full(len(blocks), np.inf)
    for k, edge in enumerate(model.edges):
        here, used = np.flatnonzero(blocks["edge"] == k), np.flatnonzero(fitted_terms(edge))
        values = np.linalg.eigvalsh(blocks["gram"][here[:, None, None], used[:, None], used])
        told = values[:, 0] > 0
        condition[here[told]] = values[told, -1] / values[told, 0]
    return condition


def _status(
    gates: Gates, of: _Seen, condition: float, sd_share: float, now_s: float
) -> tuple[str, str]:
    """Status and the reason why a block is not valid, in words."""
    if of.rows < gates.min_rows:
        return LEARNING, f"{of.rows} rows, {gates.min_rows} needed"
    if of.judged >= gates.min_rows and of.surprise > gates.max_surprise * of.judged:
        times = of.surprise / of.judged
        return INVALID, f"the machine contradicts it: misfit {times:.1f} times the noise's variance"
    if not condition <= gates.condition_limit:
        return LEARNING, f"condition number {condition:.1e} above {gates.condition_limit:.0e}"
    if sd_share > gates.max_sd_share:
        known, limit = 100 * sd_share, 100 * gates.max_sd_share
        return LEARNING, f"flow known to {known:.2g} % of the largest, limit {limit:.2g} %"
    if now_s - of.last_s > gates.stale_s:
        return STALE, f"not visited for {now_s - of.last_s:.0f} s"
    return VALID, ""


def _progress(gates: Gates, rows: int, condition: float, sd_share: float) -> float:
    """Share of the way to a valid block: variance falls as rows come in.

    It can fall when the data move to where the block is known less.
    """
    known = (gates.max_sd_share / max(sd_share, 1e-12)) ** 2
    share = gates.condition_limit / max(condition, 1.0)
    return float(min(1.0, rows / gates.min_rows, known, share))
