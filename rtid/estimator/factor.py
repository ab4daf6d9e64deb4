"""Cholesky factor of the joint normal equations, on the calling thread alone."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import cho_solve
from threadpoolctl import ThreadpoolController

from rtid.estimator import lapack
from rtid.estimator.sums import Normal
from rtid.kernels.normal import mirror, residual
from rtid.plain import FloatArray

# One standard deviation of the prior on a flow term: ten times the rated flow, so that directions
# without data stay finite and are seen as unknown by their variance.
PRIOR_SD = 10.0
SHARED_PRIOR = 1e-2  # information on beta_nominal / beta: worth knowing it to a factor of ten


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of gram + prior, scaled to about unit information.

    gram (n, n): the sums themselves, not a copy; prior (n,), on the diagonal; scale (n,): powers of
    two, so that scaling changes no digit; upper (n, n), Fortran order: the factor in its upper
    triangle, what was factorised in the other one.  A matrix of a rich map has 50 MB: there is one
    beside the sums.
    """

    gram: FloatArray
    prior: FloatArray
    scale: FloatArray
    upper: FloatArray

    def theta(self, right: FloatArray) -> FloatArray:
        """Solution (n,) for a right-hand side (n,), in the units of the sums, refined by one step.

        The residual is in twice the precision: the solution is that of the sums as they are, to
        about the square of condition number x rounding.
        """
        theta = self._solved(right)
        rest = residual(self.gram, theta, right) - self.prior * theta
        return np.asarray(theta + self._solved(rest))

    def _solved(self, right: FloatArray) -> FloatArray:
        scaled = cho_solve((self.upper, False), right * self.scale, check_finite=False)
        return np.asarray(scaled * self.scale)

    def solved(self, columns: FloatArray) -> FloatArray:
        """Solutions (n, k) for right-hand sides (n, k), in the units of the sums, not refined."""
        scale = self.scale[:, None]
        return np.asarray(cho_solve((self.upper, False), columns * scale) * scale)

    def columns(self, m: int) -> FloatArray:
        """The first m columns (n, m) of the inverse."""
        return np.stack([self.theta(unit) for unit in np.eye(m, len(self.scale))], axis=1)

    def cov(self, is_last: bool = False) -> FloatArray:
        """Inverse of gram + prior (n, n): covariance in the units of the sums.

        is_last: nobody asks the factor any more, and it is written over.
        """
        upper = self.upper if is_last else self.upper.copy(order="F")
        inverse = lapack.inverted(upper).T  # in C order, below the diagonal
        mirror(inverse, self.scale)
        return np.asarray(inverse)


def factorize(normal: Normal, n_shared: int) -> Factor:
    """Factor of information + prior.  Raises LinAlgError where the sum is not definite."""
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram.copy()
    matrix[np.diag_indices(len(prior))] += prior
    scale = np.ldexp(1.0, -(np.frexp(np.maximum(np.diag(matrix), np.finfo(float).tiny))[1] // 2))
    matrix *= scale[:, None]
    matrix *= scale
    upper = lapack.factorized(matrix.T)  # in place: it is symmetric
    return Factor(normal.gram, prior, scale, upper)


def misfit(normal: Normal, theta: FloatArray) -> float:
    """Sum of squares of the rows, of unit variance, that theta (n,) leaves."""
    return float(normal.square - 2 * normal.right @ theta + theta @ normal.gram @ theta)


@cache
def _linear_algebra() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Keep linear algebra on the calling thread.

    Its worker threads spin while they wait: measured 40 times slower when another process computes,
    and on the device they would take the controller's core.
    """
    return _linear_algebra().limit(limits=1, user_api="blas")
