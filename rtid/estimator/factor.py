"""Cholesky factor of the joint normal equations, on the calling thread alone."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from threadpoolctl import ThreadpoolController

from rtid.estimator.sums import Normal
from rtid.kernels.normal import mirror, residual
from rtid.plain import FloatArray

# One standard deviation of the prior on a flow term: ten times the rated flow, so that directions
# without data stay finite and are seen as unknown by their variance.
PRIOR_SD = 10.0
SHARED_PRIOR = 1e-2  # information on beta_nominal / beta: worth knowing it to a factor of ten


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of the scaled normal matrix: columns scaled to about unit information.

    The scales are powers of two, so that the scaled matrix is the sums to the last bit.
    """

    matrix: FloatArray
    scale: FloatArray
    lower: FloatArray

    def theta(self, right: FloatArray) -> FloatArray:
        """Solution (n,) for a right-hand side (n,), in units of the scales, refined by one step.

        The residual is in twice the precision: the solution is that of the sums as they are, to
        about the square of condition number x rounding.
        """
        right = right * self.scale
        theta = cho_solve((self.lower, True), right, check_finite=False)
        rest = residual(self.matrix, theta, right)
        theta += cho_solve((self.lower, True), rest, check_finite=False)
        return np.asarray(theta * self.scale)

    def columns(self, m: int) -> FloatArray:
        """The first m columns (n, m) of the inverse."""
        return np.stack([self.theta(unit) for unit in np.eye(m, len(self.scale))], axis=1)

    def cov(self) -> FloatArray:
        """Inverse of the normal matrix (n, n): covariance in units of the scales."""
        inverse, _ = dpotri(self.lower, lower=1)
        mirror(inverse.T, self.scale)  # Fortran order: the transpose holds the upper triangle
        return np.asarray(inverse)


def factorize(normal: Normal, n_shared: int) -> Factor:
    """Factor of information + prior."""
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram.copy()
    matrix[np.diag_indices(len(prior))] += prior
    scale = np.ldexp(1.0, -(np.frexp(np.maximum(np.diag(matrix), np.finfo(float).tiny))[1] // 2))
    matrix *= scale[:, None]
    matrix *= scale
    lower = cho_factor(matrix, lower=True)[0]
    return Factor(matrix, scale, lower)


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
