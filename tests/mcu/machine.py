"""One chamber of the third-party rig on a controller's grid, and the Python estimate beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from rtid.estimator.factor import factorize
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import State, Weights, build
from rtid.estimator.sums import Normal, normal_equations
from rtid.mcu.emulated import Record
from rtid.mcu.valve import one_valve
from rtid.model import Grid, Machine
from rtid.plain import FloatArray
from rtid.project import load
from tests.mcu.compiled import Outcome
from tests.rig import PROJECT
from tools.table_to_can import read_table

# 30 cells per edge, of which the rig visits 22 to 29 with both edges together
SMALL = Grid(
    np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0]), np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0]) * 1e6
)
BLOCKS = 32
EPS = float(np.finfo(float).eps)
# Condition numbers of a block's information.  Its sums are rounded at least once on either side, so
# its terms may differ by 2 EPS times the condition number: by 1e-10 at SURE.
SURE, LIMIT = 1e-10 / (2 * EPS), 1e6


def full_valve(chamber: str = "a") -> Machine:
    """A chamber of the packaged example project, on its fine grid."""
    return one_valve(load(PROJECT).model, chamber)


def small_valve(chamber: str = "a") -> Machine:
    """The same with blocks as a controller has room for."""
    full = full_valve(chamber)
    return replace(full, edges=tuple(replace(edge, grid=SMALL) for edge in full.edges))


@cache
def rig_table(shared: Path, run: int) -> dict[str, FloatArray]:
    """Channels of one measured run, SI."""
    return read_table(shared / "data" / "rig" / "measured" / f"rig_{run:02}.parquet")


def rig_record(shared: Path, run: int, model: Machine) -> Record:
    """A run of the rig as the samples of a model; its clock starts at zero."""
    table = rig_table(shared, run)
    t_us = np.rint((table["t"] - table["t"][0]) * 1e6).astype(np.int64)
    values = np.column_stack([table[signal.name] for signal in model.signals])
    return Record(t_us, values, np.ones(len(t_us)))


@dataclass(frozen=True)
class Reference:
    """What the Python estimator makes of a record."""

    state: State
    normal: Normal
    solution: Solution

    @classmethod
    def of(cls, model: Machine, record: Record, weights: Weights | None = None) -> Reference:
        """All samples in one call."""
        state = build(model, weights)
        state.advance(record.chunk)
        now_s = float(state.engine[0]["t_s"])
        return cls(state, normal_equations(state), solve(model, state, now_s))

    @property
    def counts(self) -> dict[str, int]:
        """Counters that the C has too."""
        counters = self.state.counters
        return {name: counters[name] for name in counters if name not in ("outlier", "reopened")}


@cache
def rig_reference(shared: Path, run: int) -> tuple[Record, Reference]:
    """A run of the rig and what Python makes of it, on the small grid."""
    model = small_valve()
    record = rig_record(shared, run, model)
    return record, Reference.of(model, record)


def sums_apart(outcome: Outcome, reference: Reference) -> float:
    """Largest difference of the sums, each in units of its two columns' sizes."""
    ours = outcome.layout.normal(outcome.memory, outcome.matrix)
    return matrix_apart(ours, reference.normal)


def matrix_apart(ours: Normal, theirs: Normal) -> float:
    """The same of two normal equations."""
    size = np.sqrt(np.where(np.diag(theirs.gram) > 0, np.diag(theirs.gram), 1.0))
    gram = np.abs(ours.gram - theirs.gram) / np.outer(size, size)
    right = np.abs(ours.right - theirs.right) / size / np.sqrt(theirs.square)
    square, noise = abs(ours.square / theirs.square - 1), np.abs(ours.noise / theirs.noise - 1)
    return float(max(gram.max(), right.max(), square, noise.max()))


def beta_in_sd(ours: np.void, theirs: Solution) -> float:
    """Difference of two bulk moduli, in standard deviations as large as the residual is."""
    sd = float(np.sqrt(max(1.0, theirs.rho) * theirs.compliance_cov[0, 0]))
    return abs(float(ours["shared"][0] - theirs.compliance[0])) / sd


@dataclass(frozen=True)
class Apart:
    """Differences of two solutions.

    beta, beta_sd: relative; flows: of block means, in shares of the rated flow, on blocks whose
    condition number is at most LIMIT; sds: the same in standard deviations; terms (sure, limit): in
    shares of the largest unknown, on blocks of condition at most SURE and LIMIT; roundings: of all
    unknowns, in units of `rounding_of`.
    """

    beta: float
    beta_sd: float
    flows: float
    sds: float
    terms: tuple[float, float]
    roundings: float


def rounding_of(reference: Reference) -> FloatArray:
    """What an error of EPS in every sum, of its two columns' sizes, may do to each unknown (n,).

    To first order A d_theta = d_r - d_A theta, so |d_theta_i| <= EPS sum_j |A^-1|_ij g_j m_j with
    g_j^2 = A_jj and m_j = |y| + sum of g_k |theta_k| over the columns k that j ever met.
    """
    normal, theta = reference.normal, reference.solution.unknowns
    cov = factorize(normal, len(theta) - 6 * len(reference.solution.blocks)).cov()
    size = np.sqrt(np.diag(normal.gram))
    met = (normal.gram != 0) @ (size * np.abs(theta)) + np.sqrt(normal.square)
    return np.asarray(EPS * np.abs(cov) @ (size * met))


def solutions_apart(outcome: Outcome, reference: Reference) -> Apart:
    """The solution in C beside Python's."""
    theirs, ours = reference.solution, outcome.solution
    blocks, maps = theirs.blocks, outcome.maps
    condition = np.array([block.condition for block in blocks])
    unknowns = outcome.work["theta"][: len(theirs.unknowns)]
    off = np.abs(unknowns - theirs.unknowns)
    apart = off / np.abs(theirs.unknowns).max()
    per_block = apart[len(apart) - 6 * len(blocks) :].reshape(-1, 6).max(axis=1)
    flow = np.abs(maps["mean_m3s"] - [block.mean_flow_m3s for block in blocks])
    rated = np.array([theirs.model.edges[block.edge].rated_q_m3s for block in blocks])
    sd = np.array([block.mean_sd_m3s for block in blocks])
    known = condition <= LIMIT
    theirs_sd = float(np.sqrt(theirs.compliance_cov[0, 0]))
    return Apart(
        abs(float(ours["shared"][0] / theirs.compliance[0]) - 1),
        abs(float(ours["shared_sd"][0]) / theirs_sd - 1),
        float((flow / rated)[known].max()),
        float((flow / sd)[known].max()),
        (float(per_block[condition <= SURE].max()), float(per_block[known].max())),
        float((off / np.maximum(rounding_of(reference), 1e-300)).max()),
    )
