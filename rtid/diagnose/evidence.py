"""What a record says about every column at once: products of whitened rows, by segment of time.

A segment holds the Gram matrix of the columns that move within it,

    G_s = sum over its rows of [y | theta_beta | given | map]' [y | theta_beta | given | map],

so that totals, folds, robust variances and what is left after the maps are taken out follow from
linear algebra alone, without another pass over the record.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dtrtri

from rtid.estimator.factor import PRIOR_SD, one_thread
from rtid.estimator.state import Weights, build
from rtid.kernels import evidence as kernel
from rtid.kernels.engine import ROW_FLAG
from rtid.kernels.layout import TERMS
from rtid.model import FloatArray, Model

IntArray = NDArray[np.int64]

ROW_S = 10e-3  # positions measured within so long make one row
SEGMENT_S = 0.5
PLACES = 256  # blocks that can ring within one segment
QUIET = 1e-3  # a column whose whitened state is smaller adds nothing to an innovation


@dataclass(frozen=True)
class Given:
    """Columns known beforehand: series (n - 1, s) volumes per interval in m3.

    Column j takes sign[j, c] times series source[j, c] in chamber c; both (columns, chambers).
    """

    series: FloatArray
    source: IntArray
    sign: FloatArray

    @property
    def n(self) -> int:
        """Number of columns."""
        return len(self.source)


@dataclass(frozen=True)
class Segment:
    """Rows between two instants: the columns that moved (k,) and their products (k, k)."""

    columns: IntArray
    gram: FloatArray
    rows: int
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Evidence:
    """All segments; n_head = 1 + chambers + given columns; cells (V,): blocks in their order."""

    segments: tuple[Segment, ...]
    n_head: int
    n_chambers: int
    cells: IntArray

    @property
    def rows(self) -> int:
        """Number of scalar rows."""
        return self.n_chambers * sum(s.rows for s in self.segments)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.n_head + TERMS * len(self.cells)

    def squares(self) -> FloatArray:
        """Squares of all columns (size,)."""
        total = np.zeros(self.size)
        for segment in self.segments:
            total[segment.columns] += segment.gram.diagonal()
        return total

    def gram(self) -> FloatArray:
        """Products of all columns (size, size)."""
        total = np.zeros((self.size, self.size))
        for segment in self.segments:
            kernel.add_products(total, segment.columns, segment.gram)
        return total


def collect(
    model: Model,
    chunk: FloatArray,
    weights: Weights,
    given: Given,
    row_s: float = ROW_S,
    segment_s: float = SEGMENT_S,
) -> Evidence:
    """One pass over a record, chunk (n, 2 + signals), with all given columns."""
    group = rows_per_group(chunk, row_s)
    e = build(model, weights)
    e.engine[0]["x_var_m2"] /= group
    e.engine[0]["p_var_pa2"] /= group
    n_c = len(model.chambers)
    head, step_s = 1 + n_c + given.n, float(np.median(np.diff(chunk[:, 0])))
    pass_ = _Pass(head, n_c, model.n_cells, max(1, round(segment_s / (group * step_s))))
    segments, at = [], 0
    starts = np.arange(0, len(chunk), max(1, round(segment_s / step_s)))
    ends = np.append(starts[1:], len(chunk))
    for end in ends:
        while at < end:
            begun = at
            at = kernel.collect(
                e.engine, e.cells, chunk, at, int(end), group,
                given.series, given.source, given.sign, *pass_.arrays,
            )  # fmt: skip
            segments.append(pass_.take(chunk[begun, 0], chunk[at - 1, 0]))
    return _compact(segments, head, n_c)


def rows_per_group(chunk: FloatArray, row_s: float) -> int:
    """Measured positions per row: as many as come within row_s."""
    measured = chunk[(chunk[:, 1].astype(int) & ROW_FLAG) != 0, 0]
    return max(1, round(row_s / float(np.median(np.diff(measured)))) if len(measured) > 1 else 1)


class _Pass:
    """The arrays that `kernel.collect` changes, from segment to segment."""

    def __init__(self, head: int, n_c: int, n_cells: int, most_rows: int) -> None:
        width = head + TERMS * PLACES
        self.head = head
        self.d, self.later = np.zeros((n_c, width)), np.zeros((n_c, width))
        self.place = np.full(n_cells, -1)
        self.cell_of = np.full(PLACES, -1)
        self.counts = np.array([0, 0, 0, head])
        self.noise = np.zeros((4, 2, 2))
        self.rows = np.zeros((most_rows + 2, n_c, width))

    @property
    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        return self.d, self.later, self.place, self.cell_of, self.counts, self.noise, self.rows

    def take(self, start_s: float, end_s: float) -> Segment:
        """The rows so far as one segment; blocks that have fallen silent give their places back."""
        n, local = int(self.counts[kernel.N_ROWS]), int(self.counts[kernel.N_LOCAL])
        used = self.head + TERMS * local
        rows = self.rows[:n, :, :used].reshape(n * len(self.d), used)
        columns = np.concatenate([np.arange(self.head), self._global(local)])
        with one_thread():
            segment = Segment(columns, rows.T @ rows, n, start_s, end_s)
        self._forget_silent(rows, local)
        self.rows[:n, :, :used] = 0.0  # blocks to come take up columns in the middle of a segment
        self.counts[kernel.N_ROWS] = 0
        return segment

    def _global(self, local: int) -> IntArray:
        first = self.head + TERMS * self.cell_of[:local]
        return np.asarray((first[:, None] + np.arange(TERMS)).ravel())

    def _forget_silent(self, rows: FloatArray, local: int) -> None:
        """Keep the blocks whose last rows still move, and those with something due."""
        head = self.head
        tail = np.abs(rows[-len(self.d) :, head:]).reshape(-1, local, TERMS)
        loud = tail.max(axis=(0, 2), initial=0.0) > QUIET if len(rows) else np.ones(local, bool)
        due = self.later[:, head : head + TERMS * local].reshape(-1, local, TERMS)
        loud |= np.abs(due).max(axis=(0, 2), initial=0.0) > 0
        old = self.cell_of[:local].copy()
        kept = np.flatnonzero(loud)
        for state in (self.d, self.later):
            moved = state[:, head:].reshape(len(state), -1, TERMS)[:, kept].copy()
            state[:, head:] = 0.0
            state[:, head : head + TERMS * len(kept)] = moved.reshape(len(state), -1)
        self.place[old] = -1
        self.cell_of[:] = -1
        self.cell_of[: len(kept)] = old[kept]
        self.place[old[kept]] = np.arange(len(kept))
        self.counts[kernel.N_LOCAL] = len(kept)


def _compact(segments: list[Segment], head: int, n_c: int) -> Evidence:
    """Number the map columns by visited block."""
    firsts = [s.columns[head::TERMS] for s in segments]
    cells = np.unique(np.concatenate(firsts)) if firsts else np.zeros(0, np.int64)
    found = []
    for segment, first in zip(segments, firsts, strict=True):
        if segment.rows:
            at = head + TERMS * np.searchsorted(cells, first)
            own = (at[:, None] + np.arange(TERMS)).ravel()
            columns = np.concatenate([np.arange(head), own])
            found.append(replace(segment, columns=columns))
    return Evidence(tuple(found), head, n_c, (cells - head) // TERMS)


@dataclass(frozen=True)
class Projected:
    """What is left of y and the head columns once every map is free to follow them.

    schur (head, head): products after the projection; coefficients (map columns, head): what the
    maps take of each; dof: rows less what the maps use up; cov
    (V, 6, 6): of the blocks' terms, effects held.
    """

    schur: FloatArray
    coefficients: FloatArray
    dof: float
    cov: FloatArray


def project(evidence: Evidence, thorough: bool = True) -> Projected:
    """Take the maps out of all head columns.

    thorough = False leaves out the covariances of the maps, and with them what the priors leave of
    their degrees of freedom.
    """
    h = evidence.n_head
    gram = evidence.gram()
    matrix = gram[h:, h:]
    matrix[np.diag_indices_from(matrix)] += PRIOR_SD**-2
    scale = 1.0 / np.sqrt(np.diag(matrix))
    matrix *= scale[:, None]
    matrix *= scale
    with one_thread():
        lower = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        coefficients = cho_solve(lower, gram[h:, :h] * scale[:, None], check_finite=False)
        coefficients *= scale[:, None]
        schur = gram[:h, :h] - gram[h:, :h].T @ coefficients
        used, cov = float(len(matrix)), np.zeros((0, TERMS, TERMS))
        if thorough:
            cov = _covariances(lower[0], scale)
            used -= float(np.einsum("bii->", cov)) * PRIOR_SD**-2
    schur = 0.5 * (schur + schur.T)
    return Projected(schur, coefficients, evidence.rows - used, cov)


def _covariances(lower: FloatArray, scale: FloatArray) -> FloatArray:
    """Covariance of each block's terms (V, 6, 6), effects held."""
    inverse = np.tril(dtrtri(lower, lower=1)[0]) * scale
    blocks = inverse.reshape(len(inverse), -1, TERMS).transpose(1, 2, 0)
    return np.asarray(blocks @ blocks.transpose(0, 2, 1))
