"""What a record says about every column at once: the products of its whitened rows.

    G = sum over the rows of [y | theta_beta | given | map]' [y | theta_beta | given | map],

and what is left of the first three once the maps are free to follow them: their Schur complement.
What the rows hold of the maps depends on the commands and the weights alone: it is collected once,
and serves any given columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dtrtri, dtrtrs, strtri

from rtid.diagnose.directions import Directions
from rtid.diagnose.weighed_rows import WeighedRows
from rtid.effects.law import Volumes
from rtid.estimator.factor import PRIOR_SD, one_thread
from rtid.estimator.state import Weights, build
from rtid.kernels import products, ringing
from rtid.kernels import record_rows as kernel
from rtid.kernels.engine import ROW_FLAG
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, IntArray, half_used

ROW_S = 10e-3  # positions measured within so long make one row
SPAN = 10  # rows in which only few blocks move
QUIET = 1e-9  # a block whose whitened state is smaller adds nothing to an innovation
COLUMNS_AT_ONCE = 256  # of a triangle that is copied
AT_ONCE = 16  # given columns that are put beside one another
ENTRIES = 4  # per row, for which there is room at first
LITTLE = 1e-6  # of a row
MANY = 2_000  # unknowns of a factor of 32 MB


@dataclass(frozen=True)
class Rows:
    """A record as rows, as from `kernel.integrate`: what they hold, and how they are whitened.

    cells (V,): blocks in the order of their first visit; sign (V, 2): of their edges; start, block,
    terms: what the blocks add to each row; row_of, share (n - 1,): rows of the intervals; own
    (rows, chambers, 1 + chambers): y and theta_beta; fresh, whiten, keep: the whitener; soft: as
    given to `rows_of`.
    """

    cells: IntArray
    sign: FloatArray
    start: IntArray
    block: IntArray
    terms: FloatArray
    row_of: IntArray
    share: FloatArray
    own: FloatArray
    fresh: BoolArray
    whiten: FloatArray
    keep: FloatArray
    soft: FloatArray

    @property
    def n(self) -> int:
        """Number of scalar rows."""
        return self.own.shape[0] * self.own.shape[1]

    @property
    def log_noise(self) -> float:
        """Logarithm of the determinant of the noise that the rows are weighed for, 2 ln m3 each."""
        factors = self.whiten[:, : 2 * self.own.shape[1] : 2]  # 1 / L00, and 1 / L11 of two
        return -2.0 * float(np.log(factors).sum())

    @cached_property
    def weighed(self) -> WeighedRows:
        """When each of them is, and for which noise it is weighed."""
        at = np.flatnonzero((self.row_of != kernel.NO_ROW) & (self.row_of < len(self.own)))
        row = self.row_of[at]
        first = at[np.diff(row, prepend=kernel.NO_ROW) != 0].astype(np.int32)
        last = at[np.diff(row, append=len(self.own)) != 0].astype(np.int32)
        factors = self.whiten[:, : 2 * self.own.shape[1] : 2]
        return WeighedRows(first, last, self.fresh, -2.0 * np.log(factors).sum(axis=1))

    def condensed(self, series: FloatArray) -> FloatArray:
        """What a series (n - 1,) of volumes per interval, m3, adds to each row (rows,), m3."""
        out = np.empty(len(self.own))
        kernel.condense(np.ascontiguousarray(series), self.row_of, self.share, self.fresh, out)
        return out

    @cached_property
    def told(self) -> tuple[Directions, FloatArray]:
        """Directions of the blocks' terms that the rows tell of; entries (n, 6) along them, m3."""
        weight = float(np.max(self.whiten[:, ::2], initial=0.0)) ** 2
        return Directions.of(self.block, self.terms, len(self.cells), weight)

    def maps(self) -> FloatArray:
        """Products of the told directions, whitened: the lower triangle of an array (n, n)."""
        (directions, along), n_v = self.told, len(self.cells)
        pairs, gram = np.zeros((n_v * (n_v + 1) // 2, TERMS**2)), half_used(directions.n)
        ringing.map_products(
            self.sign, self.start, self.block, along, self.fresh, self.whiten, self.keep,
            SPAN, QUIET, pairs,
        )  # fmt: skip
        ringing.laid_out(pairs, directions.first, gram)
        return gram

    def on_rows(self, volumes: Volumes) -> Volumes:
        """A column, condensed: chamber -> (rows,), m3."""
        return {c: self.condensed(series) for c, series in volumes.items()}

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Whitened rows (rows, chambers, m) of what columns add, m3, in their place."""
        products.whitened(columns, self.fresh, self.whiten, self.keep)
        return columns

    def cross(self, columns: FloatArray) -> FloatArray:
        """Products of the told directions with whitened (rows, chambers, m), used up: (n, m)."""
        products.adjoint(columns, self.fresh, self.whiten, self.keep)
        directions, along = self.told
        cross = np.zeros((directions.n, columns.shape[2]))
        products.cross(columns, self.sign, self.start, self.block, along, directions.first, cross)
        return cross

    def columns(self, given: list[Volumes]) -> FloatArray:
        """What y, theta_beta and condensed columns add to the rows (rows, chambers, h), m3."""
        return np.concatenate([self.own, self.stacked(given)], axis=2)

    def stacked(self, given: list[Volumes]) -> FloatArray:
        """Condensed columns beside one another (rows, chambers, m), m3."""
        columns = np.zeros((*self.own.shape[:2], len(given)))
        for k, volumes in enumerate(given):
            for c, series in volumes.items():
                columns[:, c, k] = series
        return columns

    @cached_property
    def factor(self) -> EvidenceFactor:
        """Cholesky factor of the maps' products and their prior."""
        return EvidenceFactor.of(self.maps(), self.told[0])

    @cached_property
    def covariances(self) -> FloatArray:
        """Covariance of each block's terms (V, 6, 6): small, and kept where the factor is not."""
        return self.factor.covariances()

    @cached_property
    def due(self) -> float:
        """What noise alone leaves of the rows, on average: their number less tr H.

        H y: what the maps take of y.  A direction that few rows tell of takes as little of it:
        along a joystick's steps 1,102 were touched, and 757 taken.
        """
        return self.n - self.factor.taken

    def forget(self, always: bool = False) -> None:
        """Let the factor go where it is large, or always: who asks for it again makes it anew."""
        if always or self.told[0].n > MANY:
            vars(self).pop("factor", None)


@dataclass(frozen=True)
class EvidenceFactor:
    """U' U = products and prior, scaled: upper (n, n) in Fortran order, scale (n,).

    directions: of the blocks' terms, which has n told directions.
    """

    upper: FloatArray
    scale: FloatArray
    directions: Directions

    @classmethod
    def of(cls, gram: FloatArray, directions: Directions) -> EvidenceFactor:
        """Factor of the lower triangle of gram (n, n), scaled here; gram is used up."""
        scale = np.empty(len(gram))
        products.scaled(gram, PRIOR_SD**-2, scale)
        with one_thread():
            upper = dpotrf(gram.T, lower=0, clean=0, overwrite_a=1)[0] if len(gram) else gram
        return cls(upper, scale, directions)

    @cached_property
    def taken(self) -> float:
        """Degrees of freedom that the maps take, tr H = n - PRIOR_SD^-2 tr (G + prior)^-1.

        Of the inverse the weak directions count, by a few digits: in single precision, half the
        time, 0.01 of a degree.
        """
        if not len(self.scale):
            return 0.0
        with one_thread():
            inverse = strtri(_triangle(self.upper, np.float32), lower=0, overwrite_c=1)[0]
        variance = products.variances(inverse.T) * self.scale**2
        return len(self.scale) - PRIOR_SD**-2 * float(variance.sum())

    def half(self, right: FloatArray) -> FloatArray:
        """L^-1 scale right' for right (n, m), which is used up: (m, n)."""
        right *= self.scale[:, None]
        if not len(right):
            return right.T
        with one_thread():
            return np.asarray(dtrsm(1.0, self.upper, right.T, side=1, overwrite_b=1))

    def whole(self, half: FloatArray) -> FloatArray:
        """Terms (..., V, 6) for what `half` gave of one right-hand side, or of several."""
        if not half.size:
            return self.directions.terms(half)
        with one_thread():
            return self.directions.terms(dtrtrs(self.upper, half.T)[0].T * self.scale)

    def covariances(self) -> FloatArray:
        """Diagonal blocks (V, 6, 6) of the inverse: covariance of each block's terms."""
        cov = np.zeros_like(self.directions.basis)
        if len(self.scale):
            with one_thread():
                inverse = dtrtri(_triangle(self.upper), lower=0, overwrite_c=1)[0]
            products.covariances(inverse.T, self.directions.first, self.scale, cov)
        return self.directions.covariances(cov)


def _triangle(upper: FloatArray, kind: type = float) -> FloatArray:
    """A copy of an upper triangle (n, n) in Fortran order; the rest of it takes no memory."""
    copy = half_used(len(upper), kind).T
    for k in range(0, len(upper), COLUMNS_AT_ONCE):
        end = k + COLUMNS_AT_ONCE
        copy[:end, k:end] = upper[:end, k:end]
    return copy


def rows_of(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    row_s: float = ROW_S,
    soft: FloatArray | None = None,
    means: int = 1,
) -> Rows:
    """One pass over a record, chunk (n, 2 + signals).

    soft (n, chambers): white variance of each measured position's equation, m6, beyond that of the
    model without effects; means: measurements that each sample is a mean of.
    """
    group = rows_per_group(chunk, row_s)
    e = build(model, weights)
    e.engine[0]["x_var_m2"] /= group * means
    e.engine[0]["p_var_pa2"] /= group * means
    e.engine[0]["settle_s"] = _whole_rows(chunk, group, float(e.engine[0]["settle_s"]))
    n, most = len(chunk), has_position(chunk).sum() // group + 1
    counts, noise = np.zeros(4, np.int64), np.zeros((4, 2, 2))
    row_of, share = np.full(max(0, n - 1), kernel.NO_ROW), np.zeros(max(0, n - 1))
    sums, fresh = np.zeros((most + 2, 2, 3)), np.zeros(most, np.bool_)
    whiten, keep = np.zeros((most, 3)), np.zeros((most, 2, 2))
    start = np.zeros(most + 2, np.int64)
    cell, terms, later = _entries(ENTRIES * most + ENTRIES)
    soft = np.zeros((n, len(model.chambers))) if soft is None else soft
    at = 0
    while True:
        at = kernel.integrate(
            e.engine, e.cells, chunk, soft / group, at, group, counts, noise, row_of, share, sums,
            fresh, whiten, keep, start, cell, terms, later,
        )  # fmt: skip
        if at == n:
            break
        more = _entries(len(cell))
        cell, terms = np.append(cell, more[0]), np.append(terms, more[1], axis=0)
        later = np.append(later, more[2], axis=0)
    rows, n_c = int(counts[kernel.N_ROWS]), len(model.chambers)
    entries = int(start[rows])
    cells, block = _numbered(cell[:entries])
    return Rows(
        cells, _signs(model)[cells], start[: rows + 1], block, terms[:entries].copy(), row_of,
        share, sums[:rows, :n_c, : 1 + n_c].copy(), fresh[:rows], whiten[:rows], keep[:rows], soft,
    )  # fmt: skip


def _entries(count: int) -> tuple[IntArray, FloatArray, FloatArray]:
    return np.empty(count, np.int64), np.empty((count, TERMS)), np.empty((count, TERMS))


def _numbered(cell: IntArray) -> tuple[IntArray, IntArray]:
    """Cells in the order of their first visit, and the number of each entry's."""
    cells, first, number = np.unique(cell, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return cells[order], place[number]


def _signs(model: Machine) -> FloatArray:
    """Sign with which the edge of each cell feeds each chamber (cells, 2)."""
    sign = np.zeros((model.n_cells, 2))
    at = 0
    for edge in model.maps:
        n = edge.grid.shape[0] * edge.grid.shape[1]
        for c, chamber in enumerate(model.chambers):
            sign[at : at + n, c] = edge.sign(chamber)
        at += n
    return sign


def rows_per_group(chunk: FloatArray, row_s: float) -> int:
    """Measured positions per row: as many as come within row_s; chunk (n, 2 + signals), SI."""
    period_s = _period_s(chunk)
    return max(1, round(row_s / period_s)) if period_s else 1


def _whole_rows(chunk: FloatArray, group: int, time_s: float) -> float:
    """A time, s, made whole rows: those behind it are what they would have been without it."""
    row_s = group * _period_s(chunk)
    return float(np.ceil(time_s / row_s - LITTLE)) * row_s if row_s else time_s


def _period_s(chunk: FloatArray) -> float:
    """Median time between measured positions, s; 0 where there is at most one."""
    measured = chunk[has_position(chunk), 0]
    return float(np.median(np.diff(measured))) if len(measured) > 1 else 0.0


def has_position(chunk: FloatArray) -> BoolArray:
    """True (n,) where a sample of a chunk (n, 2 + signals), SI, has measured the position."""
    return (chunk[:, 1].astype(int) & ROW_FLAG) != 0


@dataclass(frozen=True)
class Projected:
    """What is left of y and the head columns once every map is free to follow them.

    schur (h, h): products after the projection; own (h,): squares before it; half (h, n): what
    the maps take of each, see `EvidenceFactor.half`.
    """

    schur: FloatArray
    own: FloatArray
    half: FloatArray
    factor: EvidenceFactor

    def terms(self, used: list[int], theta: FloatArray, column: int | slice = 0) -> FloatArray:
        """Terms (..., V, 6) of the maps with these coefficients (..., used) of the columns used.

        column: the one that all of them follow, y unless named; or several, each with its own.
        """
        rest = self.half[column] - theta @ self.half[used]
        return self.factor.whole(rest)


class Heading:
    """Products of [y | theta_beta | given], h columns in all: those given are let go as they come.

    Those that stand aside are met by those that do not, and by the maps; two of them have no
    product, NaN.  All of a bank beside one another took 100 MB of ten minutes.
    """

    def __init__(self, rows: Rows) -> None:
        self._rows, self._h = rows, 0
        self._waiting: list[tuple[Volumes, bool]] = []
        self._beside: list[tuple[IntArray, FloatArray]] = []  # columns, and their whitened rows
        self._met: list[tuple[IntArray, IntArray, FloatArray]] = []
        self._squares: list[FloatArray] = []
        self._cross: list[FloatArray] = []
        self._take(rows.own.copy(), np.zeros(rows.own.shape[2], bool))

    def add(self, volumes: Volumes, is_aside: bool = False) -> None:
        """Another column, chamber -> (n - 1,), m3."""
        self.put(self._rows.on_rows(volumes), is_aside)

    def put(self, column: Volumes, is_aside: bool = False) -> None:
        """Another column, condensed: chamber -> (rows,), m3."""
        self._waiting.append((column, is_aside))
        if len(self._waiting) == AT_ONCE:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        given, aside = zip(*self._waiting, strict=True)
        self._waiting = []
        self._take(self._rows.stacked(list(given)), np.array(aside))

    def _take(self, columns: FloatArray, aside: BoolArray) -> None:
        """Meet what columns (rows, chambers, m) add to the rows, m3: used up."""
        flat = self._rows.whitened(columns).reshape(self._rows.n, len(aside))
        at = self._h + np.arange(len(aside))
        self._h += len(aside)
        if not aside.all():
            self._beside.append((at[~aside], np.ascontiguousarray(flat[:, ~aside].T)))
        with one_thread():
            self._met += [(known, at, rows @ flat) for known, rows in self._beside]
        self._squares.append(np.einsum("ij,ij->j", flat, flat))
        self._cross.append(self._rows.cross(columns))

    def products(self) -> tuple[FloatArray, FloatArray]:
        """Among the columns (h, h), and of the told directions with them (n, h): whitened."""
        self._flush()
        gram = np.full((self._h, self._h), np.nan)
        for a, b, met in self._met:
            gram[np.ix_(a, b)], gram[np.ix_(b, a)] = met, met.T
        np.fill_diagonal(gram, np.concatenate(self._squares))
        return gram, np.hstack(self._cross)

    def projected(self) -> Projected:
        """The maps taken out of y, theta_beta and all given columns."""
        gram, cross = self.products()
        half = self._rows.factor.half(cross)
        with one_thread():
            schur = gram - half @ half.T
        return Projected(0.5 * (schur + schur.T), gram.diagonal().copy(), half, self._rows.factor)


def project(rows: Rows, given: list[Volumes]) -> Projected:
    """Take the maps out of y, theta_beta and all given columns, condensed to the rows."""
    heading = Heading(rows)
    for column in given:
        heading.put(column)
    return heading.projected()
