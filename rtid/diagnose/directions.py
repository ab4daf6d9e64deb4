"""The directions of the blocks' terms that the rows of a record tell anything of.

A block that fewer rows have met than it has terms, or at one opening alone, has directions q with

    sum over its entries of (t_n' q)^2 = 0,

which no product holds: their coefficients are what the prior says, 0 +- PRIOR_SD, and nothing else
is known or moved by them.  Without them a factor is as exact and much smaller: on the grid of
`rtid init` 773 blocks have 3,748 told directions of 4,638.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.factor import PRIOR_SD
from rtid.kernels.layout import TERMS
from rtid.plain import BoolArray, FloatArray, IntArray

TOLD = 1e-8  # of the prior's information; with what rings on 2.4e-7, at most, of eight machines


@dataclass(frozen=True)
class Directions:
    """basis (V, 6, 6): of each block, told directions first; first (V + 1,): where they begin."""

    basis: FloatArray
    first: IntArray

    @classmethod
    def of(
        cls, block: IntArray, terms: FloatArray, n_v: int, weight: float
    ) -> tuple[Directions, FloatArray]:
        """Those of entries block (n,) of n_v blocks with terms (n, 6), m3, and them along it.

        weight: the largest information of a row, 1/m6.  Blocks of which all is told stay as they
        are.
        """
        basis = _principal(block, terms, n_v)
        along = np.einsum("np,npq->nq", terms, basis[block])
        count = (weight * _squares(block, along, n_v) > TOLD * PRIOR_SD**-2).sum(axis=1)
        along *= np.arange(TERMS) < count[block, None]
        whole = count == TERMS
        basis[whole] = np.eye(TERMS)
        along[whole[block]] = terms[whole[block]]
        return cls(basis, np.append(0, np.cumsum(count))), along

    @property
    def n(self) -> int:
        """Number of told directions, of all blocks."""
        return int(self.first[-1])

    def terms(self, theta: FloatArray) -> FloatArray:
        """Terms (..., V, 6) for coefficients (..., n) of the told directions, the rest being 0."""
        whole = np.zeros((*theta.shape[:-1], len(self.basis), TERMS))
        whole[..., self._is_told] = theta
        return np.einsum("vpq,...vq->...vp", self.basis, whole)

    def covariances(self, cov: FloatArray) -> FloatArray:
        """Covariances (V, 6, 6) of the terms for those of the told directions, zeros elsewhere."""
        whole = cov + PRIOR_SD**2 * np.eye(TERMS) * ~self._is_told[:, None]
        return np.asarray(self.basis @ whole @ self.basis.transpose(0, 2, 1))

    @property
    def _is_told(self) -> BoolArray:
        return np.asarray(np.arange(TERMS) < np.diff(self.first)[:, None])


def _principal(block: IntArray, terms: FloatArray, n_v: int) -> FloatArray:
    """Orthonormal directions (V, 6, 6) of the entries of each block, those with most first."""
    products = np.zeros((n_v, TERMS, TERMS))
    for p in range(TERMS):
        for q in range(p + 1):
            products[:, p, q] = np.bincount(block, terms[:, p] * terms[:, q], n_v)
    return np.ascontiguousarray(np.linalg.eigh(products)[1][:, :, ::-1])


def _squares(block: IntArray, along: FloatArray, n_v: int) -> FloatArray:
    """Sums of the squares of entries (n, 6) along each direction (V, 6)."""
    return np.column_stack([np.bincount(block, along[:, q] ** 2, n_v) for q in range(TERMS)])
