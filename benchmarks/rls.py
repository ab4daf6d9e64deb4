"""The classical method of one block, 7 parameters, in the hands of other libraries.

Filter (10), basis and one recursive least squares step per sample, lambda = 1, all from the same
samples (n, 4) = [xi, eta, V dP/dt, y].  Each function returns theta (7,).
"""

from __future__ import annotations

import ctypes

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from padasip.filters import FilterRLS

from benchmarks.compiler import pointer
from rtid.kernels.holds import second_order

FloatArray = NDArray[np.float64]

N = 7
START = 1e6  # initial covariance
DT_S, WN_RAD_S, ZETA = 1e-3, 2 * np.pi * 10, 0.8
TRUTH = np.array([0.5, 0.8, 0.3, -0.2, 0.1, 0.4, 0.7])


def samples(n: int, seed: int = 1) -> FloatArray:
    """Smooth motion inside one block, with noise on y."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * DT_S
    xi, eta = 0.9 * np.sin(7 * t), 0.9 * np.sin(3.1 * t + 1)
    rate = np.cos(5.3 * t) * np.sin(0.7 * t)
    phi = np.column_stack([np.ones(n), xi, eta, xi**2, eta**2, xi * eta, rate])
    y = phi @ TRUTH + 0.01 * rng.standard_normal(n)
    return np.column_stack([xi, eta, rate, y])


def coefficients() -> tuple[FloatArray, FloatArray]:
    """Return the factors a, b of x+ = a x + b [start, end]."""
    a, b = np.empty((2, 2)), np.empty((2, 2))
    second_order(WN_RAD_S, ZETA, DT_S, a, b)
    return a, b


class Front:
    """Basis and filter, one sample at a time, in numpy: what the other libraries lack."""

    def __init__(self) -> None:
        self.a, self.b = coefficients()
        self.x = np.zeros((2, N + 1))
        self.ends = np.zeros((2, N + 1))  # unfiltered columns at the sample before and now

    def step(self, sample: FloatArray) -> FloatArray:
        """Return the filtered columns (8,) after one sample; y is the last."""
        xi, eta, rate, y = sample
        self.ends[0] = self.ends[1]
        self.ends[1] = 1.0, xi, eta, xi * xi, eta * eta, xi * eta, rate, y
        self.x[:] = self.a @ self.x + self.b @ self.ends
        return np.asarray(self.x[0])


def by_numpy(data: FloatArray) -> FloatArray:
    """Covariance recursion in plain numpy."""
    front, theta, P = Front(), np.zeros(N), START * np.eye(N)
    for sample in data:
        row = front.step(sample)
        phi, y = row[:N], row[N]
        gain = P @ phi
        gain_scaled = gain / (1.0 + phi @ gain)
        theta = theta + gain_scaled * (y - phi @ theta)
        P = P - np.outer(gain_scaled, gain)
    return theta


def by_filterpy(data: FloatArray) -> FloatArray:
    """Kalman filter without dynamics: F = I, Q = 0, H = phi', R = 1."""
    front, kalman = Front(), KalmanFilter(dim_x=N, dim_z=1)
    kalman.P *= START
    for sample in data:
        row = front.step(sample)
        kalman.update(row[N], H=row[None, :N])
    return np.asarray(kalman.x[:, 0])


def by_padasip(data: FloatArray) -> FloatArray:
    """Adaptive RLS filter with mu = 1; eps is the inverse of the initial covariance."""
    front, adaptive = Front(), FilterRLS(n=N, mu=1.0, eps=1.0 / START, w="zeros")
    for sample in data:
        row = front.step(sample)
        adaptive.adapt(row[N], row[:N].copy())
    return np.asarray(adaptive.w)


class CState(ctypes.Structure):
    """As struct Rls in c/rls.c."""

    _fields_ = (
        ("a", ctypes.c_double * 4),
        ("b", ctypes.c_double * 4),
        ("x", ctypes.c_double * 16),
        ("before", ctypes.c_double * 8),
        ("theta", ctypes.c_double * N),
        ("p", ctypes.c_double * (N * N)),
    )


def by_c(library: ctypes.CDLL, data: FloatArray) -> FloatArray:
    """Run the hand-written C."""
    state, (a, b) = CState(), coefficients()
    state.a[:], state.b[:] = a.ravel().tolist(), b.ravel().tolist()
    state.p[:] = (START * np.eye(N)).ravel().tolist()
    library.rls_run(ctypes.byref(state), pointer(data), ctypes.c_long(len(data)))
    return np.array(state.theta)
