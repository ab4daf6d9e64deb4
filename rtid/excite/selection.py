"""Choose segments that are worth their time, one after the other.

With P_b the information on block b (6 x 6, in units of the rated flow) and M the mean of phi phi'
over a block, the standard error of its map is s_b^2 = tr(M (P_b + prior)^-1), rms over the block.
What is maximised per second of motion:

    bounded     sum over blocks of w_b (ln(s_1 / s) below s_1 + a ln(s_0 / s)) + effects' ln 1 / sd,
                s^2 = s_b^2 + s_2^2: what is known well enough gains nothing more
    d-optimal   sum over blocks of ln det(P_b + prior) / 2

Information of segments is added up, see `information`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtid.excite.information import PRIOR, Information
from rtid.kernels.layout import TERMS
from rtid.plain import FloatArray

UNKNOWN = 1.0  # s_0: share of the rated flow
USEFUL, BEFORE = 0.1, 0.15  # s_1, from which on it counts whole, and its share a before
TARGET = 1e-3  # s_2, share of the rated flow to which a block is known well enough
ENOUGH_ROWS = 60.0
EXCHANGES = 2  # rounds at most
EFFECT_WEIGHT = 10.0  # blocks that halving the limit of one effect is worth


def _moments() -> FloatArray:
    """Mean of phi phi' over a block, phi = [1, xi, eta, xi^2, eta^2, xi eta] on [-1, 1]^2."""
    powers = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [0, 2], [1, 1]])
    total = powers[:, None, :] + powers[None, :, :]
    mean = np.where(total % 2 == 0, 1.0 / (total + 1.0), 0.0)
    return np.asarray(mean.prod(axis=2))


MOMENTS = _moments()


def standard_errors(blocks: FloatArray) -> FloatArray:
    """Rms standard error of the map over each block (m,), from its information (m, 6, 6)."""
    cov = np.linalg.inv(blocks + PRIOR)
    return np.asarray(np.sqrt(np.maximum(np.einsum("bij,ji->b", cov, MOMENTS), 0.0)))


@dataclass(frozen=True)
class Criterion:
    """value: of blocks' information and rows; effects: whether those count as well."""

    value: Callable[[FloatArray, FloatArray], FloatArray]
    effects: bool


def _bounded(blocks: FloatArray, rows: FloatArray) -> FloatArray:
    sd = np.minimum(np.hypot(standard_errors(blocks), TARGET), UNKNOWN)
    known = np.log(USEFUL / np.minimum(sd, USEFUL)) + BEFORE * np.log(UNKNOWN / sd)
    return np.asarray(known * np.minimum(rows / ENOUGH_ROWS, 1.0))


def _d_optimal(blocks: FloatArray, rows: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.linalg.slogdet(blocks + PRIOR)[1])


BOUNDED, D_OPTIMAL = Criterion(_bounded, True), Criterion(_d_optimal, False)


@dataclass
class KnownCells:
    """What is known so far, by grid cell: information (cells, 6, 6), rows (cells,), effects."""

    blocks: FloatArray
    rows: FloatArray
    effects: dict[tuple[str, str], float]

    @classmethod
    def nothing(cls, n_cells: int) -> KnownCells:
        """Before any motion."""
        return cls(np.zeros((n_cells, TERMS, TERMS)), np.zeros(n_cells), {})

    def copy(self) -> KnownCells:
        """The same, independent."""
        return KnownCells(self.blocks.copy(), self.rows.copy(), dict(self.effects))

    def add(self, news: Information) -> None:
        """Take in what a segment tells."""
        self.blocks[news.cells] += news.blocks
        self.rows[news.cells] += news.rows
        for key, value in news.effects.items():
            self.effects[key] = self.effects.get(key, 0.0) + value

    def gain(self, news: Information, criterion: Criterion, weights: FloatArray) -> float:
        """What the criterion would rise by, in its unit; weights (cells,): dimensionless."""
        old, rows = self.blocks[news.cells], self.rows[news.cells]
        new = criterion.value(old + news.blocks, rows + news.rows)
        total = float(weights[news.cells] @ (new - criterion.value(old, rows)))
        if criterion.effects:
            for key, value in news.effects.items():
                before = self.effects.get(key, 0.0)
                total += EFFECT_WEIGHT * _halvings(before, before + value)
        return total


def _halvings(before: float, after: float) -> float:
    """How often a standard deviation halves; from nothing: ten times at most."""
    least = after * 4.0**-10
    return float(0.5 * np.log2(after / max(before, least))) if after > 0 else 0.0


@dataclass(frozen=True)
class SelectionProblem:
    """Segments to choose from: what they tell, what they cost (segments,); weights (cells,)."""

    told: Sequence[Information]
    costs_s: FloatArray
    weights: FloatArray
    criterion: Criterion = BOUNDED

    def rates(self, known: KnownCells, left_s: float) -> FloatArray:
        """Gain per second of every segment (segments,); 0 where it does not fit."""
        rates = np.zeros(len(self.told))
        for k in np.flatnonzero(self.costs_s <= left_s).tolist():
            gain = known.gain(self.told[k], self.criterion, self.weights)
            rates[k] = gain / self.costs_s[k]
        return rates


def choose(problem: SelectionProblem, known: KnownCells, budget_s: float) -> list[int]:
    """Segments in the order of choice, each as often as it pays; then exchanged while that helps.

    What seems best first is not what is best beside the others: each in turn is taken out, and the
    time filled anew.
    """
    chosen = filled(problem, known.copy(), [], budget_s)
    for _ in range(EXCHANGES):
        before = list(chosen)
        for k in before:
            rest = list(chosen)
            rest.remove(k)
            other = filled(problem, known.copy(), rest, budget_s)
            if value(problem, known, other) > value(problem, known, chosen):
                chosen = other
        if chosen == before:
            break
    return chosen


def filled(
    problem: SelectionProblem, known: KnownCells, chosen: list[int], budget_s: float
) -> list[int]:
    """More segments, greedily, until the time is up; known is used up."""
    chosen, budget = list(chosen), budget_s - float(problem.costs_s[chosen].sum())
    for k in chosen:
        known.add(problem.told[k])
    while True:
        rates = problem.rates(known, budget)
        best = int(rates.argmax())
        if rates[best] <= 0.0:
            return chosen
        known.add(problem.told[best])
        chosen.append(best)
        budget -= float(problem.costs_s[best])


def value(problem: SelectionProblem, known: KnownCells, chosen: list[int]) -> float:
    """What the criterion rises by with all of the chosen segments."""
    after, gained = known.copy(), 0.0
    for k in chosen:
        gained += after.gain(problem.told[k], problem.criterion, problem.weights)
        after.add(problem.told[k])
    return gained
