"""Recursive least squares of one block, 7 parameters, as other libraries do it.

Rows are those of `benchmarks.rls`: basis and filter (10) on what the sensors say of one chamber,
the whole working range being one block.  Each recursion keeps a covariance P and takes one row at a
time, with the forgetting factor lambda:

    K = P phi / (lambda + phi' P phi),   theta += K (y - phi' theta),   P = (P - K phi' P) / lambda
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from filterpy.kalman import KalmanFilter
from padasip.filters import FilterRLS

from benchmarks.rls import START, WN_RAD_S, ZETA, Front, N
from rtid.kernels.holds import second_order
from rtid.model import Machine
from rtid.plain import FloatArray


class Recursion(Protocol):
    """One library's recursion: theta (7,) and its covariance (7, 7) up to the noise."""

    def __init__(self, theta: FloatArray, P: FloatArray, forget: float = 1.0) -> None: ...

    @property
    def theta(self) -> FloatArray: ...

    @property
    def covariance(self) -> FloatArray: ...

    def take(self, phi: FloatArray, y: float) -> None: ...


class Plain:
    """The textbook's recursion in numpy."""

    def __init__(self, theta: FloatArray, P: FloatArray, forget: float = 1.0) -> None:
        self._theta, self._P, self.forget = theta.copy(), P.copy(), forget

    @property
    def theta(self) -> FloatArray:
        return self._theta

    @property
    def covariance(self) -> FloatArray:
        return self._P

    def take(self, phi: FloatArray, y: float) -> None:
        toward = self._P @ phi
        gain = toward / (self.forget + phi @ toward)
        self._theta = self._theta + gain * (y - phi @ self._theta)
        self._P = (self._P - np.outer(gain, toward)) / self.forget


class Padasip:
    """padasip's FilterRLS; its mu is the forgetting factor."""

    def __init__(self, theta: FloatArray, P: FloatArray, forget: float = 1.0) -> None:
        self.filter = FilterRLS(n=N, mu=forget, w=theta.copy())
        self.filter.R = P.copy()

    @property
    def theta(self) -> FloatArray:
        return np.asarray(self.filter.w)

    @property
    def covariance(self) -> FloatArray:
        return np.asarray(self.filter.R)

    def take(self, phi: FloatArray, y: float) -> None:
        self.filter.adapt(y, phi.copy())


class Filterpy:
    """filterpy's KalmanFilter, Joseph form, without dynamics; its alpha^2 is 1 / lambda."""

    def __init__(self, theta: FloatArray, P: FloatArray, forget: float = 1.0) -> None:
        self.filter = KalmanFilter(dim_x=N, dim_z=1)
        self.filter.x, self.filter.P = theta[:, None].copy(), P.copy()
        self.filter.alpha, self.filter.Q = forget**-0.5, np.zeros((N, N))

    @property
    def theta(self) -> FloatArray:
        return np.asarray(self.filter.x[:, 0])

    @property
    def covariance(self) -> FloatArray:
        return np.asarray(self.filter.P)

    def take(self, phi: FloatArray, y: float) -> None:
        self.filter.predict()
        self.filter.update(y, H=phi[None, :])


RIVALS: dict[str, type[Recursion]] = {"plain RLS": Plain, "padasip": Padasip, "filterpy": Filterpy}


def unknown() -> tuple[FloatArray, FloatArray]:
    """Start without knowledge: theta and P of `benchmarks.rls`."""
    return np.zeros(N), START * np.eye(N)


class OneBlock:
    """Rows of chamber a, whose supply edge is one block over u and dp; filter at any rate."""

    def __init__(
        self, model: Machine, u_v: tuple[float, float], dp_pa: tuple[float, float]
    ) -> None:
        self.model, self.u_v, self.dp_pa = model, u_v, dp_pa

    def rows(self, chunk: FloatArray) -> FloatArray:
        """Filtered columns (n - 1, 8) of a chunk at constant steps; y is the last."""
        front, dt = Front(), float(chunk[1, 0] - chunk[0, 0])
        second_order(WN_RAD_S, ZETA, dt, front.a, front.b)
        return np.array([front.step(sample).copy() for sample in self._samples(chunk, dt)])

    def _samples(self, chunk: FloatArray, dt: float) -> FloatArray:
        """[xi, eta, V dP/dt, y] (n - 1, 4) in the units of the rated flow."""
        edge, chamber = self.model.edges[0], self.model.chambers[0]
        value = {s.name: chunk[:, 2 + k] for k, s in enumerate(self.model.signals)}
        area = chamber.sign * chamber.area_m2
        x, p = value[self.model.position], value[chamber.pressure]
        rate = (chamber.v0_m3 + area * x[1:]) * np.diff(p) / dt / self.model.beta_nominal_pa
        xi = _scaled(value[edge.command][:-1], *self.u_v)
        eta = _scaled((value[edge.source] - value[edge.sink])[1:], *self.dp_pa)
        flow = area * np.diff(x) / dt
        scale = edge.rated_q_m3s
        return np.column_stack([xi, eta, -rate / scale, flow / scale])


def _scaled(values: FloatArray, low: float, high: float) -> FloatArray:
    return np.asarray((2 * values - low - high) / (high - low))
