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
from rtid.kernels.normal import mirror
from rtid.model import FloatArray

# One standard deviation of the prior on a flow term: ten times the rated flow, so that directions
# without data stay finite and are seen as unknown by their variance.
PRIOR_SD = 10.0
SHARED_PRIOR = 1e-2  # information on beta_nominal / beta: worth knowing it to a factor of ten


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of the scaled normal matrix: columns scaled to unit information."""

    matrix: FloatArray
    scale: FloatArray
    lower: FloatArray

    def theta(self, right: FloatArray) -> FloatArray:
        """Solution for right-hand sides (n,) or (n, m), with one step of refinement."""
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        right = right * scale
        theta = cho_solve((self.lower, True), right)
        theta += cho_solve((self.lower, True), right - self.matrix @ theta)
        return np.asarray(theta * scale)

    def columns(self, m: int) -> FloatArray:
        """The first m columns (n, m) of the inverse."""
        return self.theta(np.eye(len(self.scale), m))

    def cov(self) -> FloatArray:
        """Inverse of the normal matrix (n, n)."""
        inverse, _ = dpotri(self.lower, lower=1)
        mirror(inverse.T, self.scale)  # Fortran order: the transpose holds the upper triangle
        return np.asarray(inverse)


def factorize(normal: Normal, n_shared: int) -> Factor:
    """Factor of information + prior."""
    prior = np.full(len(normal.right), PRIOR_SD**-2)
    prior[:n_shared] = SHARED_PRIOR
    matrix = normal.gram + np.diag(prior)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    matrix *= scale[:, None]
    matrix *= scale
    lower = cho_factor(matrix, lower=True)[0]
    return Factor(matrix, scale, lower)


def misfit(normal: Normal, theta: FloatArray) -> float:
    """Sum of squares of the rows that theta leaves."""
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
