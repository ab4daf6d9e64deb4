"""What a motion tells: standard errors per block, of beta, detection limits of the effects.

`assess` judges samples, whether simulated before the machine moves or measured after: the same
estimator and the same diagnosis, so that one can be held against the other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rtid.diagnose.fit import fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import physical
from rtid.diagnose.trials import detection_limit, scored
from rtid.estimator.blocks import VALID, Block
from rtid.estimator.record import refined, summed
from rtid.estimator.solution import Solution, sketch, solve
from rtid.excite.selection import MOMENTS
from rtid.model import Machine
from rtid.plain import FloatArray, Key

Cell = tuple[int, int, int]


@dataclass(frozen=True)
class BlockError:
    """One block of edge `edge`; sds as shares of the edge's largest flow.

    sd: of the map, rms over the block; mean_sd: of the flow averaged over the data in it.
    """

    edge: int
    i: int
    j: int
    rows: int
    sd: float
    mean_sd: float
    valid: bool

    @property
    def cell(self) -> Cell:
        """Edge and place in its grid."""
        return self.edge, self.i, self.j


@dataclass(frozen=True)
class Limit:
    """The smallest size of an effect that would be seen (4 sd); inf: it cannot be."""

    effect: str
    where: str
    value: float
    unit: str


@dataclass(frozen=True)
class Prediction:
    """What one motion tells; beta per chamber."""

    name: str
    duration_s: float
    blocks: tuple[BlockError, ...]
    beta_pa: FloatArray
    beta_sd_pa: FloatArray
    limits: tuple[Limit, ...]

    @property
    def valid(self) -> int:
        """Number of valid blocks."""
        return sum(block.valid for block in self.blocks)

    def sds(self, cells: Iterable[Cell]) -> FloatArray:
        """Standard errors of the map in some blocks (n,), m3/s; inf where one was not visited."""
        known = {b.cell: b.sd for b in self.blocks}
        return np.array([known.get(cell, np.inf) for cell in cells])

    def limit(self, effect: str, where: str) -> float:
        """Detection limit of an effect at a place; inf where it has no column."""
        key = effect, where
        return next((x.value for x in self.limits if (x.effect, x.where) == key), np.inf)


def assess(model: Machine, chunk: FloatArray, name: str = "", effects: bool = True) -> Prediction:
    """Judge samples (n, 2 + signals), SI, with noise; effects: also the detection limits."""
    weights = refined(model, sketch(model, summed(model, chunk)), model.lag.nominal_s)
    solution = solve(model, summed(model, chunk, weights))
    return Prediction(
        name,
        float(chunk[-1, 0] - chunk[0, 0]),
        tuple(_errors(solution)),
        solution.beta_pa,
        solution.beta_sd_pa,
        tuple(limits(model, chunk).values()) if effects else (),
    )


def _errors(solution: Solution) -> Iterable[BlockError]:
    largest = largest_flows(solution.blocks, len(solution.model.edges))
    for b in solution.blocks:
        q = largest[b.edge] or solution.model.edges[b.edge].rated_q_m3s
        sd = float(np.sqrt(max(0.0, np.einsum("ij,ji", b.cov, MOMENTS)))) / q
        yield BlockError(b.edge, b.i, b.j, b.rows, sd, b.mean_sd_m3s / q, b.status == VALID)


def largest_flows(blocks: Iterable[Block], n_edges: int) -> FloatArray:
    """Largest mean flow of a valid block per edge (edges,), m3/s; 0 where there is none."""
    largest = np.zeros(n_edges)
    for b in blocks:
        if b.status == VALID:
            largest[b.edge] = max(largest[b.edge], abs(b.mean_flow_m3s))
    return largest


def limits(model: Machine, chunk: FloatArray) -> dict[Key, Limit]:
    """Detection limit, SI, of every effect that is known; chunk (n, 2 + signals): the record."""
    result: dict[Key, Limit] = {}
    fitted = fit(model, chunk, prepare(model, chunk), Revision())
    for candidate, score in scored(fitted):
        value = float(physical(fitted, candidate, detection_limit(score, fitted.rho)))
        if candidate.parameter != "share" and value < result.get(candidate.key, _NONE).value:
            result[candidate.key] = Limit(*candidate.key, value, candidate.unit)
    return result


_NONE = Limit("", "", np.inf, "")


def median_ratio(better: Prediction, than: Prediction) -> float:
    """Ratio of the median standard errors over the blocks that both visit with enough rows."""
    enough = {b.cell for b in better.blocks if b.rows >= ENOUGH}
    cells = [b.cell for b in than.blocks if b.rows >= ENOUGH and b.cell in enough]
    if not cells:
        return float("nan")
    return float(np.median(better.sds(cells)) / np.median(than.sds(cells)))


ENOUGH = 20  # rows
