"""What a record says about every column at once: the products of its whitened rows.

    G = sum over the rows of [y | theta_beta | given | map]' [y | theta_beta | given | map],

and what is left of the first three once the maps are free to follow them: their Schur complement.
Rows are taken in segments of time, in which only some blocks move or still ring.
"""

from __future__ import annotations

from dataclasses import dataclass

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
FIRST_BLOCKS = 64  # for which there is room at first
PLACES = 256  # blocks that can ring within one segment
QUIET = 1e-3  # a column whose state is a smaller part of a row's noise adds nothing to rows


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
class Evidence:
    """Products of all whitened columns: the lower triangle of gram (size, size).

    n_head = 1 + chambers + given columns; cells (V,): blocks in their order; rows: scalar ones.
    """

    gram: FloatArray
    n_head: int
    cells: IntArray
    rows: int

    def squares(self) -> FloatArray:
        """Squares of all columns (size,)."""
        return np.asarray(self.gram.diagonal().copy())


def collect(
    model: Model,
    chunk: FloatArray,
    weights: Weights,
    given: Given,
    row_s: float = ROW_S,
    soft: FloatArray | None = None,
) -> Evidence:
    """One pass over a record, chunk (n, 2 + signals), with all given columns.

    soft (n, chambers): white variance of each measured position's equation, m6, beyond that of the
    model without effects.
    """
    group = rows_per_group(chunk, row_s)
    e = build(model, weights)
    e.engine[0]["x_var_m2"] /= group
    e.engine[0]["p_var_pa2"] /= group
    n_c = len(model.chambers)
    head, step_s = 1 + n_c + given.n, float(np.median(np.diff(chunk[:, 0])))
    taken = _Pass(head, n_c, model.n_cells, max(1, round(SEGMENT_S / (group * step_s))))
    soft = np.zeros((len(chunk), n_c)) if soft is None else soft / group
    at = 0
    for end in [*range(0, len(chunk), max(1, round(SEGMENT_S / step_s)))[1:], len(chunk)]:
        while at < end:
            at = kernel.collect(
                e.engine, e.cells, chunk, at, end, group,
                given.series, given.source, given.sign, soft, *taken.arrays,
            )  # fmt: skip
            taken.add()
    return taken.evidence()


def rows_per_group(chunk: FloatArray, row_s: float) -> int:
    """Measured positions per row: as many as come within row_s."""
    measured = chunk[(chunk[:, 1].astype(int) & ROW_FLAG) != 0, 0]
    return max(1, round(row_s / float(np.median(np.diff(measured)))) if len(measured) > 1 else 1)


class _Pass:
    """The arrays that `kernel.collect` changes, and the products so far."""

    def __init__(self, head: int, n_c: int, n_cells: int, most_rows: int) -> None:
        width = head + TERMS * PLACES
        self.head, self.n_rows = head, 0
        self.d, self.later = np.zeros((n_c, width)), np.zeros((n_c, width))
        self.place = np.full(n_cells, -1)
        self.cell_of = np.full(PLACES, -1)
        self.counts = np.array([0, 0, 0, head])
        self.noise = np.zeros((5, 2, 2))
        self.rows = np.zeros((most_rows + 2, n_c, width))
        self.cells: list[int] = []
        self.number = np.full(n_cells, -1)  # of a cell's block among those visited
        self.total = np.zeros((head + TERMS * FIRST_BLOCKS,) * 2)

    @property
    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        return self.d, self.later, self.place, self.cell_of, self.counts, self.noise, self.rows

    def evidence(self) -> Evidence:
        """The products of everything that was added."""
        size = self.head + TERMS * len(self.cells)
        return Evidence(self.total[:size, :size], self.head, np.array(self.cells, int), self.n_rows)

    def add(self) -> None:
        """Add the products of the rows so far; blocks that fell silent give their places back."""
        n, local = int(self.counts[kernel.N_ROWS]), int(self.counts[kernel.N_LOCAL])
        used = self.head + TERMS * local
        rows = self.rows[:n, :, :used].reshape(n * len(self.d), used)
        with one_thread():
            gram = rows.T @ rows
        columns = self._columns(local)  # may enlarge the total
        kernel.add_products(self.total, columns, gram)
        self.n_rows += len(rows)
        self._forget_silent(local)
        self.rows[:n, :, :used] = 0.0  # blocks to come take up columns in the middle of a segment
        self.counts[kernel.N_ROWS] = 0

    def _columns(self, local: int) -> IntArray:
        """Columns of the head and of the local blocks among all; new blocks get a number."""
        for cell in self.cell_of[:local][self.number[self.cell_of[:local]] < 0]:
            self.number[cell] = len(self.cells)
            self.cells.append(int(cell))
        size = self.head + TERMS * len(self.cells)
        if size > len(self.total):
            larger = np.zeros((2 * size,) * 2)
            larger[: len(self.total), : len(self.total)] = self.total
            self.total = larger
        first = self.head + TERMS * self.number[self.cell_of[:local]]
        own = (first[:, None] + np.arange(TERMS)).ravel()
        return np.concatenate([np.arange(self.head), own])

    def _forget_silent(self, local: int) -> None:
        """Keep the blocks that would still move a row, and those with something due."""
        head, n_c = self.head, len(self.d)
        sd = np.sqrt(self.noise[kernel.LAST].diagonal()[:n_c])[:, None, None]
        size = np.abs(self.d[:, head : head + TERMS * local]).reshape(n_c, local, TERMS)
        loud = (size / np.maximum(sd, 1e-300)).max(axis=(0, 2), initial=0.0) > QUIET
        due = self.later[:, head : head + TERMS * local].reshape(n_c, local, TERMS)
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
    gram = evidence.gram
    matrix = gram[h:, h:].copy()
    matrix[np.diag_indices_from(matrix)] += PRIOR_SD**-2
    scale = 1.0 / np.sqrt(np.diag(matrix))
    matrix *= scale[:, None]
    matrix *= scale
    own = np.tril(gram[:h, :h]) + np.tril(gram[:h, :h], -1).T
    with one_thread():
        lower = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        coefficients = cho_solve(lower, gram[h:, :h] * scale[:, None], check_finite=False)
        coefficients *= scale[:, None]
        schur = own - gram[h:, :h].T @ coefficients
        used, cov = float(len(matrix)), np.zeros((0, TERMS, TERMS))
        if thorough:
            cov = _covariances(lower[0], scale)
            used -= float(np.einsum("bii->", cov)) * PRIOR_SD**-2
    schur = 0.5 * (schur + schur.T)
    return Projected(schur, coefficients, evidence.rows - used, cov)


def _covariances(lower: FloatArray, scale: FloatArray) -> FloatArray:
    """Covariance of each block's terms (V, 6, 6), effects held."""
    inverse = np.tril(dtrtri(lower, lower=1)[0]) * scale
    n = len(inverse)
    blocks = inverse.reshape(n, n // TERMS, TERMS).transpose(1, 2, 0)
    return np.asarray(blocks @ blocks.transpose(0, 2, 1))
