"""When does the model begin to fail: recursive residuals and their cumulative sum.

Brown, Durbin and Evans (1975).  Each combination of open blocks has a constant of its own; the
recursive residual of a row is its innovation less the mean of all earlier ones there,

    w_r = (e_r - mean) / sqrt(1 + 1 / n),        W_r = sum of w / s,

white and of equal variance as long as the model stays the same.  With probability `level` W leaves

    +- a sqrt(m) (1 + 2 r / m),      Q(3 a) + exp(-4 a^2) (1 - Q(a)) = level / 2,

m rows, Q the upper tail of the normal distribution: a = 0.948 for 5 %.  The level is shared out
among the chambers.  s^2 is the long-run variance, from differences of neighbouring batches: what
the blocks' terms miss comes again and again and is no change.  The sum crosses some time after the
change; the change itself is placed where, before that, a step in the mean of w fits best.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, exp, sqrt

import numpy as np

from rtid.compare.comparison import Comparison
from rtid.model import Machine
from rtid.plain import FloatArray

LEVEL = 0.05
TRIM = 0.02  # of the rows at either end cannot be told from the rest
BATCHES = (160, 40, 16)  # of the record, into which the long-run variance is cut


@dataclass(frozen=True)
class Cusum:
    """Cumulative sum of one chamber's recursive residuals, m rows.

    t_s, value, boundary (m,): the sum and the (upper) boundary, in standard deviations of a
    residual.  crosses_s: when the sum first leaves the boundaries, None: never; change_s: where the
    change behind it is placed, None without one.
    """

    chamber: str
    level: float
    t_s: FloatArray
    value: FloatArray
    boundary: FloatArray
    crosses_s: float | None
    change_s: float | None

    @property
    def largest(self) -> float:
        """Largest share of the boundary that the sum reaches; above 1 it has crossed."""
        return float(np.max(np.abs(self.value) / self.boundary)) if len(self.value) else 0.0


def cusums(
    model: Machine, part: Comparison, before: Comparison | None = None, level: float = LEVEL
) -> list[Cusum]:
    """One per chamber; a block's mean goes on from what it was in the part `before`."""
    share = level / max(1, len(model.chambers))
    return [_cusum(model, part, before, c, share) for c in range(len(model.chambers))]


def factor(level: float) -> float:
    """The boundary's a for a probability to leave it, by bisection."""
    low, high = 0.1, 4.0
    for _ in range(60):
        a = 0.5 * (low + high)
        tail = 0.5 * erfc(3 * a / sqrt(2)) + exp(-4 * a * a) * (1 - 0.5 * erfc(a / sqrt(2)))
        low, high = (a, high) if tail > 0.5 * level else (low, a)
    return low


def recursive_residuals(e: FloatArray, group: np.ndarray) -> FloatArray:
    """w (n,) of whitened innovations e (n,) whose group (n,) has one constant; NaN at its first."""
    order = np.argsort(group, kind="stable")
    sorted_e, start = e[order], np.diff(group[order], prepend=-2) != 0
    first = np.maximum.accumulate(np.where(start, np.arange(len(e)), 0))
    before = np.concatenate([[0.0], np.cumsum(sorted_e)[:-1]])
    count = np.arange(len(e)) - first
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (before - before[first]) / count
        w = (sorted_e - mean) / np.sqrt(1.0 + 1.0 / count)
    residuals = np.empty(len(e))
    residuals[order] = np.where(count > 0, w, np.nan)
    return residuals


def _cusum(
    model: Machine, part: Comparison, before: Comparison | None, c: int, level: float
) -> Cusum:
    parts = [part] if before is None else [before, part]
    edges = [i for i, edge in enumerate(model.edges) if edge.sign(model.chambers[c]) != 0]
    rows = [_rows(p, edges, c, model.n_cells + 1, before is None) for p in parts]
    t_s, e, key = (np.concatenate(columns) for columns in zip(*rows, strict=True))
    new = np.arange(len(e)) >= len(e) - len(rows[-1][0])
    w = recursive_residuals(e, key)
    kept = np.isfinite(w) & new
    t_s, w, m = t_s[kept], w[kept], int(kept.sum())
    name = model.chambers[c].name
    if m < 10:
        return Cusum(name, level, t_s, np.cumsum(w), np.full(m, np.inf), None, None)
    value = np.cumsum(w) / _spread(w)
    boundary = factor(level) * sqrt(m) * (1.0 + 2.0 * np.arange(1, m + 1) / m)
    out = np.flatnonzero(np.abs(value) > boundary)
    crosses = float(t_s[out[0]]) if len(out) else None
    change = float(t_s[_change(value, int(out[0]))]) if len(out) else None
    return Cusum(name, level, t_s, value, boundary, crosses, change)


def _rows(
    part: Comparison, edges: list[int], c: int, base: int, fitted: bool
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Instants, innovations and open blocks of the rows of chamber c, a number per combination.

    fitted: of the fit's own terms, whose innovations are white in its own data.
    """
    inner = part.intervals
    e = (inner.own if fitted else inner.innovation)[:, c]
    known, key = np.isfinite(e), np.zeros(len(e), np.int64)
    for k in edges:
        key = key * base + inner.cell[:, k] + 1
    return inner.t_s[1:][known], e[known], key[known]


def _spread(w: FloatArray) -> float:
    """Long-run standard deviation of w; a step in its mean counts in one pair of batches only."""
    variance = float(np.var(w))
    for batches in BATCHES:
        size = len(w) // batches
        if size >= 2:
            sums = w[: size * batches].reshape(batches, size).sum(axis=1)
            variance = max(variance, float(np.mean(np.diff(sums) ** 2)) / (2.0 * size))
    return sqrt(max(variance, 1e-300))


def _change(value: FloatArray, crosses: int) -> int:
    """Row after which the mean of the residuals steps (Bai 1994), before the sum crosses."""
    m = len(value)
    r = np.arange(1, m)
    bridge = np.abs(value[:-1] - r / m * value[-1]) / np.sqrt(r * (m - r))
    edge = max(1, round(TRIM * m))
    last = max(edge + 1, min(crosses, m - edge))
    return int(min(crosses, edge + bridge[edge:last].argmax()))
