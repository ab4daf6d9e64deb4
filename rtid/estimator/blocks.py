"""One block of a map as the joint estimate knows it: terms, covariance, status, progress."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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


def rms_slopes(model: Machine, sums: Sums, theta: FloatArray) -> FloatArray:
    """Root mean square of dQ/ddp over the data of each block (m,), m3/s/Pa; theta (n,) as above."""
    one, xi, eta, xi2, eta2, both = mean_phi(sums.blocks).T
    _, _, a, _, b, c = theta[sums.n_shared :].reshape(-1, TERMS).T
    square = a**2 * one + 4 * b**2 * eta2 + c**2 * xi2
    square += 4 * a * b * eta + 2 * a * c * xi + 4 * b * c * both
    edge, place = sums.blocks["edge"], sums.blocks["cell"]
    scale = [
        2 * e.rated_q_m3s / np.tile(np.diff(e.grid.dp_pa), e.grid.shape[0]) for e in model.edges
    ]
    first = np.array(model.first_cells)[edge]
    per_height = np.array([scale[e][p] for e, p in zip(edge, place - first, strict=True)])
    return np.asarray(per_height * np.sqrt(np.maximum(square, 0.0)))


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


def read_blocks(
    model: Machine, sums: Sums, theta: FloatArray, cov: FloatArray, now_s: float
) -> Iterator[Block]:
    """All visited blocks.

    theta (n,) and cov (n, n) in Taylor terms.
    """
    largest, means = largest_flows(model, sums, theta), mean_phi(sums.blocks)
    first = model.first_cells
    for place, record in enumerate(sums.blocks):
        at = sums.n_shared + TERMS * place
        columns, edge = slice(at, at + TERMS), int(record["edge"])
        shape, rated = model.edges[edge].grid.shape, model.edges[edge].rated_q_m3s
        i, j = divmod(int(record["cell"]) - first[edge], shape[1])
        used = np.flatnonzero(fitted_terms(model.edges[edge]))
        condition = condition_of(record["gram"][used[:, None], used])
        variance = float(means[place] @ cov[columns, columns] @ means[place])
        sd_share = rated / largest[edge] * max(0.0, variance) ** 0.5
        status, reason = _status(model.gates, record, condition, sd_share, now_s)
        yield Block(
            edge,
            i,
            j,
            theta[columns] * rated,
            cov[columns, columns] * rated**2,
            means[place],
            int(record["rows"]),
            float(record["dwell_s"]),
            float(record["last_s"]),
            condition,
            status,
            reason,
            _progress(model.gates, int(record["rows"]), condition, sd_share),
        )


def condition_of(gram: FloatArray) -> float:
    """Condition number of Phi'Phi (n, n), scaled units; inf where a term was never excited."""
    values = np.linalg.eigvalsh(gram)
    return float(values[-1] / values[0]) if values[0] > 0 else np.inf


def _status(
    gates: Gates, record: np.void, condition: float, sd_share: float, now_s: float
) -> tuple[str, str]:
    """Status and the reason why a block is not valid, in words."""
    rows, judged = int(record["rows"]), float(record["judged"])
    if rows < gates.min_rows:
        return LEARNING, f"{rows} rows, {gates.min_rows} needed"
    if judged >= gates.min_rows and record["surprise"] > gates.max_surprise * judged:
        times = float(record["surprise"]) / judged
        return INVALID, f"the machine contradicts it: misfit {times:.1f} times the noise's variance"
    if not condition <= gates.condition_limit:
        return LEARNING, f"condition number {condition:.1e} above {gates.condition_limit:.0e}"
    if sd_share > gates.max_sd_share:
        known, limit = 100 * sd_share, 100 * gates.max_sd_share
        return LEARNING, f"flow known to {known:.2g} % of the largest, limit {limit:.2g} %"
    if now_s - record["last_s"] > gates.stale_s:
        return STALE, f"not visited for {now_s - record['last_s']:.0f} s"
    return VALID, ""


def _progress(gates: Gates, rows: int, condition: float, sd_share: float) -> float:
    """Share of the way to a valid block: variance falls as rows come in.

    It can fall when the data move to where the block is known less.
    """
    known = (gates.max_sd_share / max(sd_share, 1e-12)) ** 2
    share = gates.condition_limit / max(condition, 1.0)
    return float(min(1.0, rows / gates.min_rows, known, share))
