"""Least squares for maps that are linear in their terms, with 1 / beta beside them.

Per chamber, over all rows,  s A v = sum of sigma_e B_e(w, dp)' theta_e - V dP/dt / beta;  columns
are scaled to unit length, and a small ridge keeps what the motion does not excite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from benchmarks.missing.front import Front, Working
from benchmarks.missing.record import Learned, Record
from rtid.plain import FloatArray

RIDGE = 1e-4  # of a column of unit length: rows are thousands, and terms are alike
Z95 = 1.96
Basis = Callable[[FloatArray, FloatArray], FloatArray]  # w (n,), root (n,) -> (n, k)


@dataclass(frozen=True)
class Solved:
    """theta (k,) and its covariance; left (rows,): what remains."""

    theta: FloatArray
    cov: FloatArray
    left: FloatArray


def solved(columns: FloatArray, y: FloatArray, ridge: float = RIDGE) -> Solved:
    """Ridge least squares of y (n,) on columns (n, k); rows next to each other count as one third.

    (The filter makes neighbouring rows alike: their noise is worth fewer rows than there are.)
    """
    length = np.sqrt((columns**2).sum(axis=0))
    length = np.where(length > 1e-12 * length.max(), length, length.max())
    scaled = columns / length
    gram = scaled.T @ scaled + ridge**2 * np.eye(len(length))
    factor = linalg.cho_factor(gram)
    theta = linalg.cho_solve(factor, scaled.T @ y)
    left = y - scaled @ theta
    rho = np.corrcoef(left[1:], left[:-1])[0, 1] if len(left) > 2 else 0.0
    alike = (1.0 + max(rho, 0.0)) / max(1.0 - rho, 0.05)
    variance = alike * left @ left / max(1, len(y) - len(length))
    cov = variance * linalg.cho_solve(factor, np.eye(len(length)))
    return Solved(theta / length, cov / np.outer(length, length), left)


@dataclass(frozen=True)
class LinearMap:
    """Maps of all edges as linear bases, with their moduli.

    basis: per edge; theta, cov: per edge, of its terms; beta_pa, beta_sd_pa (chambers,).
    """

    machine_edges: tuple[str, ...]
    basis: tuple[Basis, ...]
    theta: tuple[FloatArray, ...]
    cov: tuple[FloatArray, ...]
    beta_pa: FloatArray
    beta_sd_pa: FloatArray

    def flow(self, edge: str, w_v: object, dp_pa: object) -> FloatArray:
        """Q in m3/s."""
        k = self.machine_edges.index(edge)
        return np.asarray(self._columns(k, w_v, dp_pa) @ self.theta[k])

    def sd(self, edge: str, w_v: object, dp_pa: object) -> FloatArray:
        """Standard deviation of Q in m3/s, of the noise alone."""
        k = self.machine_edges.index(edge)
        columns = self._columns(k, w_v, dp_pa)
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", columns, self.cov[k], columns), 0.0))

    def _columns(self, k: int, w_v: object, dp_pa: object) -> FloatArray:
        w, dp = np.asarray(w_v, float), np.asarray(dp_pa, float)
        return self.basis[k](w, np.sign(dp) * np.sqrt(np.abs(dp)))

    def flows(self, at: Working) -> FloatArray:
        """Flows through the edges (n, e) at working points."""
        q = np.zeros(at.w_v.shape)
        for k in range(len(self.basis)):
            i = at.open(k)
            q[i, k] = self.basis[k](at.w_v[i, k], at.root[i, k]) @ self.theta[k]
        return q

    def predict(self, record: Record) -> FloatArray:
        """dP/dt (n, c), Pa/s."""
        at = Front(record).samples
        return at.rates(at.into(self.flows(at)), self.beta_pa)

    @property
    def learned(self) -> Learned:
        """All of it as an answer."""
        return Learned(self.predict, self.flow, self.sd, self.beta_pa, self.beta_sd_pa)


def map_columns(front: Front, chamber: int, basis: tuple[Basis, ...]) -> list[FloatArray]:
    """Filtered columns of a chamber's edges, (rows, k) each."""
    s, columns = front.samples, []
    for e in s.edges_of(chamber):
        at = s.open(e)
        terms = basis[e](s.w_v[at, e], s.root[at, e])
        whole = np.zeros((len(at), terms.shape[1]))
        whole[at] = s.sign[chamber, e] * terms
        columns.append(front.filtered(whole))
    return columns


def fitted(front: Front, basis: tuple[Basis, ...], ridge: float = RIDGE) -> LinearMap:
    """Maps and moduli of a record."""
    s = front.samples
    moved, stored = front.balance()
    n_e, n_c = s.w_v.shape[1], moved.shape[1]
    theta, cov = [np.zeros(0)] * n_e, [np.zeros((0, 0))] * n_e
    beta, beta_sd = np.zeros(n_c), np.zeros(n_c)
    low, high = s.machine.beta_bounds_pa
    for c in range(n_c):
        columns = map_columns(front, c, basis)
        answer = solved(np.hstack([-stored[:, c : c + 1], *columns]), moved[:, c], ridge)
        beta[c] = 1.0 / np.clip(answer.theta[0], 1.0 / high, 1.0 / low)
        beta_sd[c] = beta[c] ** 2 * np.sqrt(answer.cov[0, 0])
        first = 1
        for e, block in zip(s.edges_of(c), columns, strict=True):
            k = slice(first, first + block.shape[1])
            theta[e], cov[e], first = answer.theta[k], answer.cov[k, k], k.stop
    names = tuple(edge.name for edge in s.machine.edges)
    return LinearMap(names, basis, tuple(theta), tuple(cov), beta, beta_sd)
