"""The published flow map Q(w, dp): continuous, with its uncertainty, slopes and inverse.

Per edge, the Taylor polynomials of the (at most four) blocks around a point are blended by the
squares of the lapped windows of eq. (12):

    Q(w, dp) = sum over blocks of g_i(w) g_j(dp) phi_ij(w, dp)' theta_ij

w = direction * u is the opening command.  At and below the safe band the flow is zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtid.estimator.inverse import invert
from rtid.estimator.windows import blend, foot
from rtid.kernels.layout import TERMS
from rtid.model import Grid
from rtid.plain import BoolArray, FloatArray

# Status of a cell.
VALID, LEARNING, EXTRAPOLATED, PRIOR, SHUT = "valid", "learning", "extrapolated", "prior", "shut"

Cells = tuple[NDArray[np.intp], NDArray[np.intp]]
Corner = tuple[Cells, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class EdgeMap:
    """One edge's map: theta (nu, nd, 6) and cov (nu, nd, 6, 6) in m3/s, terms of `kernels.basis`.

    status (nu, nd) holds the words above; reason says per cell (i, j) why it is not valid, or that
    its data contradict a flow that rises with the command.
    """

    name: str
    grid: Grid
    safe_band_v: float
    theta: FloatArray
    cov: FloatArray
    status: NDArray[np.str_]
    reason: dict[tuple[int, int], str]

    def flow(self, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s at broadcast points (...); 0 at or below the safe band, NaN off the grid."""
        w, dp, open_, inside, shape = self._points(w_v, dp_pa)
        q = np.zeros(len(w))
        for cells, weight, *_ in self.corners(w, dp):
            q += weight * (self._phi(cells, w, dp) * self.theta[cells]).sum(axis=1)
        risen = foot(self.grid.u_v, self.safe_band_v, w)[0]
        return self._finish(risen * q, open_, inside, shape)

    def gradient(self, w_v: ArrayLike, dp_pa: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """dQ/dw in m3/s/V and dQ/ddp in m3/s/Pa of the same map, shape (...) as its points."""
        w, dp, open_, inside, shape = self._points(w_v, dp_pa)
        q, q_w, q_p = np.zeros((3, len(w)))
        for cells, g, g_w, g_p in self.corners(w, dp):
            theta = self.theta[cells]
            value, by_w, by_p = ((t * theta).sum(axis=1) for t in self.terms(cells, w, dp))
            q += g * value
            q_w += g * by_w + g_w * value
            q_p += g * by_p + g_p * value
        f, f_w = foot(self.grid.u_v, self.safe_band_v, w)  # product rule over windows and foot
        parts = f * q_w + f_w * q, f * q_p
        along_w, along_dp = (self._finish(part, open_, inside, shape) for part in parts)
        return along_w, along_dp

    def sd(self, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Standard deviation (...) of Q in m3/s; neighbours' errors count as wholly correlated."""
        w, dp, open_, inside, shape = self._points(w_v, dp_pa)
        total = np.zeros(len(w))
        for cells, weight, *_ in self.corners(w, dp):
            phi = self._phi(cells, w, dp)
            variance = np.einsum("ki,kij,kj->k", phi, self.cov[cells], phi)
            total += weight * np.sqrt(np.maximum(variance, 0.0))
        return self._finish(
            total * foot(self.grid.u_v, self.safe_band_v, w)[0], open_, inside, shape
        )

    def inverse(self, q_m3s: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """The command w with Q(w, dp) = q, to rounding; NaN where there is none or more than one.

        For q = 0 it is the safe band, the largest command that surely passes nothing.
        """
        q, dp = np.broadcast_arrays(np.asarray(q_m3s, float), np.asarray(dp_pa, float))
        commands = invert(self.grid, self.safe_band_v, self.theta, q.ravel(), dp.ravel())
        return commands.reshape(q.shape)

    def status_at(self, w_v: ArrayLike, dp_pa: ArrayLike) -> NDArray[np.str_]:
        """Status (...) of the cell that holds each point; "outside" off the grid."""
        w, dp, open_, inside, shape = self._points(w_v, dp_pa)
        i, j = (_cell(b, x) for b, x in ((self.grid.u_v, w), (self.grid.dp_pa, dp)))
        status = np.where(inside, self.status[i, j], "outside")
        return np.where(open_, status, SHUT).reshape(shape)

    @property
    def q_max_m3s(self) -> float:
        """Largest flow at a valid cell's centre."""
        valid = self.status == VALID
        return float(np.abs(self.theta[valid][:, 0]).max()) if valid.any() else np.nan

    def _points(
        self, w_v: ArrayLike, dp_pa: ArrayLike
    ) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, tuple[int, ...]]:
        """Flat points moved into the grid; which are open, which lay inside; the shape."""
        w, dp = np.broadcast_arrays(np.asarray(w_v, float), np.asarray(dp_pa, float))
        shape, w, dp = w.shape, w.ravel(), dp.ravel()
        u, p = self.grid.u_v, self.grid.dp_pa
        inside = (w >= u[0]) & (w <= u[-1]) & (dp >= p[0]) & (dp <= p[-1])
        open_ = ~(w <= self.safe_band_v)
        w, dp = np.nan_to_num(w, nan=u[0]), np.nan_to_num(dp, nan=p[0])
        return np.clip(w, u[0], u[-1]), np.clip(dp, p[0], p[-1]), open_, inside, shape

    def corners(self, w: FloatArray, dp: FloatArray) -> Iterator[Corner]:
        """Per blended block: its cells (i, j), the weight, and the weight's slopes in w and dp.

        All (k,); w in V, dp in Pa, weights dimensionless.
        """
        i, b, b_w = blend(self.grid.u_v, w)
        j, c, c_p = blend(self.grid.dp_pa, dp)
        for di, wi, si in ((0, 1 - b, -b_w), (1, b, b_w)):
            for dj, wj, sj in ((0, 1 - c, -c_p), (1, c, c_p)):
                nu, nd = self.grid.shape
                cells = np.minimum(i + di, nu - 1), np.minimum(j + dj, nd - 1)
                yield cells, wi * wj, si * wj, wi * sj

    def terms(
        self, cells: Cells, w: FloatArray, dp: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """phi (k, 6) at points w in V, dp in Pa (k,) in their cells, and its derivatives."""
        xi, eta, hu, hp = self._local(cells, w, dp)
        ones, zero = np.ones_like(xi), np.zeros_like(xi)
        by_w = np.stack([zero, ones, zero, 2 * xi, zero, eta], axis=1) * hu[:, None]
        by_dp = np.stack([zero, zero, ones, zero, 2 * eta, xi], axis=1) * hp[:, None]
        return self._phi(cells, w, dp), by_w, by_dp

    def _phi(self, cells: Cells, w: FloatArray, dp: FloatArray) -> FloatArray:
        xi, eta, _, _ = self._local(cells, w, dp)
        return np.stack([np.ones_like(xi), xi, eta, xi * xi, eta * eta, xi * eta], axis=1)

    def _local(
        self, cells: Cells, w: FloatArray, dp: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Points (k,) from -1 to 1 across their cells, and how fast they move in w and dp."""
        (i, j), u, p = cells, self.grid.u_v, self.grid.dp_pa
        hu, hp = 2.0 / (u[i + 1] - u[i]), 2.0 / (p[j + 1] - p[j])
        return (w - u[i]) * hu - 1.0, (dp - p[j]) * hp - 1.0, hu, hp

    @staticmethod
    def _finish(
        value: FloatArray,
        open_: BoolArray,
        inside: BoolArray,
        shape: tuple[int, ...],
    ) -> FloatArray:
        return np.where(open_, np.where(inside, value, np.nan), 0.0).reshape(shape)


def _cell(border: FloatArray, at: FloatArray) -> NDArray[np.intp]:
    return np.clip(np.searchsorted(border, at, side="right") - 1, 0, len(border) - 2)


@dataclass(frozen=True)
class FlowMap:
    """The maps of all edges, in the order of the model."""

    edges: tuple[EdgeMap, ...]

    def __getitem__(self, edge: int | str) -> EdgeMap:
        """One edge by number or name; KeyError names the edges that exist."""
        if isinstance(edge, int):
            return self.edges[edge]
        for edge_map in self.edges:
            if edge_map.name == edge:
                return edge_map
        raise KeyError(f"the map has no edge {edge!r}, only {[e.name for e in self.edges]}")

    def flow(self, edge: int | str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q (...) of one edge in m3/s, see `EdgeMap.flow`."""
        return self[edge].flow(w_v, dp_pa)

    def sd(self, edge: int | str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Its standard deviation (...) in m3/s."""
        return self[edge].sd(w_v, dp_pa)

    def gradient(
        self, edge: int | str, w_v: ArrayLike, dp_pa: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """dQ/dw in m3/s/V and dQ/ddp in m3/s/Pa (...), see `EdgeMap.gradient`."""
        return self[edge].gradient(w_v, dp_pa)

    def inverse(self, edge: int | str, q_m3s: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """The command w (...) in V for a wanted flow in m3/s, see `EdgeMap.inverse`."""
        return self[edge].inverse(q_m3s, dp_pa)

    def theta_cells(self) -> FloatArray:
        """Terms of all cells (cells, 6), m3/s, in the order of `kernels.explain`."""
        return np.concatenate([e.theta.reshape(-1, TERMS) for e in self.edges])
