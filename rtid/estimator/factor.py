"""Cholesky factor of the joint normal equations, on the calling thread alone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import numpy as np
from scipy.linalg import cho_solve
from threadpoolctl import ThreadpoolController

from rtid.estimator import lapack
from rtid.estimator.sums import Normal, Sums
from rtid.kernels.normal import mirror, residual
from rtid.plain import FloatArray

P = ParamSpec("P")
R = TypeVar("R")

# One standard deviation of the prior on a flow term: ten times the rated flow, so that directions
# without data stay finite and are seen as unknown by their variance.
PRIOR_SD = 10.0
SHARED_PRIOR = 1e-2  # information on beta_nominal / beta: worth knowing it to a factor of ten


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of gram + prior, scaled to about unit information.

    prior (n,), on the diagonal; scale (n,): powers of two, so that scaling changes no digit;
    upper (n, n), Fortran order: the factor in its upper triangle, below it what was factorised;
    diagonal (n,): its own, without the prior.  A matrix of a rich map has 50 MB: there is this one.
    """

    prior: FloatArray
    scale: FloatArray
    upper: FloatArray
    diagonal: FloatArray

    def theta(self, right: FloatArray) -> FloatArray:
        """Solutions for right-hand sides, (n,) or (n, k), in the units of the sums, refined once.

        The residual is in twice the precision: the solution is that of the sums as they are, to
        about the square of condition number x rounding.
        """
        columns = np.atleast_2d(right.T).T * self.scale[:, None]
        found = self._halves(columns)
        rest = np.stack([self._rest(x, y) for x, y in zip(found.T, columns.T, strict=True)], 1)
        theta = (found + self._halves(rest)) * self.scale[:, None]
        return np.asarray(theta.reshape(right.shape))

    def _rest(self, theta: FloatArray, right: FloatArray) -> FloatArray:
        """What a solution (n,) leaves of a right-hand side (n,), both scaled."""
        left = residual(self.upper.T, self.diagonal, theta, right)
        return np.asarray(left - self.prior * self.scale**2 * theta)

    def _halves(self, columns: FloatArray) -> FloatArray:
        """Solutions (n, k) for right-hand sides (n, k), both scaled."""
        return np.asarray(cho_solve((self.upper, False), columns, check_finite=False))

    def solved(self, columns: FloatArray) -> FloatArray:
        """Solutions (n, k) for right-hand sides (n, k), in the units of the sums, not refined."""
        scale = self.scale[:, None]
        return self._halves(columns * scale) * scale

    def cov(self, is_last: bool = False) -> FloatArray:
        """Inverse of gram + prior (n, n): covariance in the units of the sums.

        is_last: nobody asks the factor any more, and it is written over.
        """
        upper = self.upper if is_last else self.upper.copy(order="F")
        inverse = lapack.inverted(upper).T  # in C order, below the diagonal
        mirror(inverse, self.scale)
        return np.asarray(inverse)


def factorize(normal: Normal, n_shared: int, is_last: bool = False) -> Factor:
    """Factor of information + prior.  Raises LinAlgError where the sum is not definite.

    is_last: nobody asks for the matrix of `normal` any more, and it is written over.
    """
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram if is_last else normal.gram.copy()
    own = matrix.diagonal().copy()
    matrix[np.diag_indices(len(prior))] += prior
    scale = np.ldexp(1.0, -(np.frexp(np.maximum(np.diag(matrix), np.finfo(float).tiny))[1] // 2))
    matrix *= scale[:, None]
    matrix *= scale
    upper = lapack.factorized(matrix.T)  # in place: it is symmetric
    return Factor(prior, scale, upper, own * scale**2)


def factor_of(sums: Sums) -> Factor:
    """Factor of the information of sums, and their prior: one matrix."""
    return factorize(sums.normal(), sums.n_shared, is_last=True)


def misfit(sums: Sums, theta: FloatArray) -> float:
    """Sum of squares of the rows, of unit variance, that theta (n,) leaves."""
    drawn = sums.times(theta[:, None])[:, 0] - 2 * sums.right
    return float(sums.shared[0, 0] + drawn @ theta)


@cache
def _linear_algebra() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Keep linear algebra on the calling thread.

    Its worker threads spin while they wait: measured 40 times slower when another process computes,
    and on the device they would take the controller's core.
    """
    return _linear_algebra().limit(limits=1, user_api="blas")


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function with all its linear algebra on the calling thread (`one_thread`).

    Commands have it so by the environment; a program that imports the package has not.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_thread():
            return function(*args, **kwargs)

    return alone
