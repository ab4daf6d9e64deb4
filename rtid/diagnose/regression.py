"""The small regression that is left once the maps are taken out: [y | theta_beta | effects].

With S the products after the projection and N what sensor noise adds to them on average, the
corrected normal equations (S - N) theta = s have the variance (S - N)^-1 S (S - N)^-1 in units of
the rows' noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from rtid.diagnose.weighed_rows import WeighedRows
from rtid.plain import FloatArray, IntArray

CLEARLY = 3.0  # standard deviations of the noise's own products by which a column must exceed it
FAINTEST = 1e-200  # square of a column: what is fainter never acts
VANISHED = 1e-10  # share of a column's square that rounding leaves
LIMIT_SD = 4.0  # an effect of so many standard deviations would have been seen


@dataclass(frozen=True)
class Estimate:
    """theta, cov of the columns `used`; sse: cost, comparable between sets of columns."""

    used: tuple[int, ...]
    theta: FloatArray
    cov: FloatArray
    sse: float

    def value(self, column: int) -> float:
        """Coefficient of a column."""
        return float(self.theta[self.used.index(column)])

    def sd(self, column: int) -> float:
        """Its standard deviation, rows having unit variance."""
        k = self.used.index(column)
        return float(np.sqrt(max(0.0, self.cov[k, k])))


@dataclass(frozen=True)
class Score:
    """One candidate beside the columns in use: coefficient, sd, what chi2 falls by, visibility.

    visible: share of the column that the maps and the columns in use do not follow.
    """

    column: int
    value: float
    sd: float
    gain: float
    visible: float


@dataclass(frozen=True)
class Regression:
    """The products, N the noise in them; column 0 is y.

    s, noise (columns, columns); prior, mean (columns,): information and value of the priors;
    own (columns,): squares of the columns before the maps were taken out; rows: of all segments;
    dof: what the maps leave of them, see `Rows.due`; log_noise: logarithm of the determinant of
    their noise; weighed: what each of them is weighed for.
    """

    s: FloatArray
    noise: FloatArray
    prior: FloatArray
    mean: FloatArray
    own: FloatArray
    dof: float
    rows: int
    log_noise: float = 0.0
    weighed: WeighedRows | None = None

    def fit(self, used: tuple[int, ...]) -> Estimate:
        """Least squares on some columns, errors in variables taken out."""
        at = np.array(used, int)
        plain, scale = self._plain(at)
        outer = np.outer(scale, scale)
        noise = self._bounded(at, plain, outer) * outer
        inverse = np.linalg.inv(plain * outer - noise)
        right = (self.s[at, 0] + self.prior[at] * self.mean[at]) * scale
        theta = inverse @ right
        cov = inverse @ (plain * outer) @ inverse
        theta, cov = theta * scale, cov * outer
        sse = self.chi2(at, theta) + float(self.prior[at] @ (theta - self.mean[at]) ** 2)
        return Estimate(used, theta, cov, sse)

    def noise_of(self, at: list[int]) -> FloatArray:
        """What sensor noise adds to the products (k, k) of the columns `at`, as far as it is known.

        In the units of the columns' products; see `_bounded`.
        """
        columns = np.array(at, int)
        plain, scale = self._plain(columns)
        return self._bounded(columns, plain, np.outer(scale, scale))

    def _plain(self, at: IntArray) -> tuple[FloatArray, FloatArray]:
        """Products with priors (k, k), and what makes their diagonal 1 (k,)."""
        plain = self.s[at[:, None], at] + np.diag(self.prior[at])
        np.fill_diagonal(plain, np.where(plain.diagonal() > FAINTEST, plain.diagonal(), 1.0))
        return plain, 1.0 / np.sqrt(plain.diagonal())

    def chi2(self, at: IntArray, theta: FloatArray) -> float:
        """What theta, SI, of the columns `at` (columns,) leaves of the rows, maps being free."""
        s = self.s
        return float(s[0, 0] - 2.0 * s[0, at] @ theta + theta @ s[at[:, None], at] @ theta)

    def _bounded(self, at: IntArray, plain: FloatArray, outer: FloatArray) -> FloatArray:
        """The noise's products, less where they leave too little: then nothing can be told.

        outer (columns, columns): what makes the products of the columns 1, finite for any column.
        """
        noise = self.noise[at[:, None], at]
        if not noise.any():
            return noise
        most = 1.0 - CLEARLY * np.sqrt(2.0 / max(1, self.rows))
        if _is_positive((most * plain - noise) * outer):  # quicker than to know the share
            return noise
        # the largest share that noise has of any combination of the columns
        share = _largest_share(noise * outer, plain * outer)
        return noise * min(1.0, most / share) if share > 0.0 else noise

    def rho(self, estimate: Estimate) -> float:
        """Residual variance in units of the sensors' noise."""
        return estimate.sse / max(1.0, self.dof - len(estimate.used))

    def score(self, used: tuple[int, ...], column: int) -> Score:
        """A candidate beside the columns in use; what these follow entirely is not visible."""
        rest = self._left(used, column)
        if rest <= VANISHED * max(self.own[column], 1e-300):
            return Score(column, 0.0, np.inf, 0.0, 0.0)
        with_it = self.fit((*used, column))
        value, sd = with_it.value(column), with_it.sd(column)
        gain = (value / sd) ** 2 if sd > 0 else 0.0
        visible = float(np.sqrt(max(0.0, rest / max(self.own[column], 1e-300))))
        return Score(column, value, sd, gain, visible)

    def _left(self, used: tuple[int, ...], column: int) -> float:
        at = np.array(used, int)
        square = self.s[column, column]
        if not used:
            return float(square)
        cross = self.s[at, column]
        gram = self.s[at[:, None], at] + np.diag(self.prior[at] + 1e-300)
        return float(square - cross @ np.linalg.solve(gram, cross))


def _largest_share(part: FloatArray, whole: FloatArray) -> float:
    """The largest ratio of two quadratic forms (n, n), the second of diagonal 1.

    Where that is none but for rounding, as of columns that nearly follow one another, it has a
    floor.
    """
    squares, ways = eigh(whole)
    ways /= np.sqrt(np.maximum(squares, VANISHED * max(1.0, float(squares[-1]))))
    return float(eigh(ways.T @ part @ ways, eigvals_only=True)[-1])


def _is_positive(matrix: FloatArray) -> bool:
    """True for a symmetric matrix (n, n) whose eigenvalues are all positive."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
