"""Exact responses against independent mathematics: matrix exponential and quadrature."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.signal import lsim

from rtid.kernels.holds import lagged_moments, second_order

BOTH = pytest.mark.parametrize("compiled", [True, False])
CASES = [
    (2 * np.pi * 10, 0.8, 1e-3),
    (2 * np.pi * 10, 0.8, 0.02),
    (5.0, 0.1, 2e-4),
    (90.0, 0.97, 0.05),
]


def either(kernel: Any, compiled: bool) -> Any:
    return kernel if compiled else kernel.py_func


def system(wn: float, zeta: float) -> tuple[np.ndarray, np.ndarray]:
    """A and B of H_f for the state (output, output' / wn)."""
    return wn * np.array([[0, 1], [-1, -2 * zeta]]), wn * np.array([0.0, 1.0])


@BOTH
@pytest.mark.parametrize(("wn", "zeta", "dt"), CASES)
def test_filter_step_is_the_matrix_exponential(
    wn: float, zeta: float, dt: float, compiled: bool
) -> None:
    a, b = np.empty((2, 2)), np.empty((2, 2))
    either(second_order, compiled)(wn, zeta, dt, a, b)
    big_a, big_b = system(wn, zeta)
    augmented = np.zeros((4, 4))  # x, u, and u's slope times dt
    augmented[:2, :2], augmented[:2, 2], augmented[2, 3] = big_a * dt, big_b * dt, 1.0
    exact = expm(augmented)
    np.testing.assert_allclose(a, exact[:2, :2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(b[:, 1], exact[:2, 3], rtol=0, atol=2e-13)
    np.testing.assert_allclose(b.sum(axis=1), exact[:2, 2], rtol=0, atol=1e-13)


@pytest.mark.parametrize("is_held", [True, False])
def test_filter_follows_held_and_linear_inputs(is_held: bool) -> None:
    rng, wn, zeta, dt = np.random.default_rng(3), 2 * np.pi * 10, 0.8, 2e-3
    u = rng.standard_normal(60)
    a, b = np.empty((2, 2)), np.empty((2, 2))
    second_order(wn, zeta, dt, a, b)
    x, out = np.zeros(2), []
    for start, end in zip(u[:-1], u[:-1] if is_held else u[1:], strict=True):
        x = a @ x + b @ [start, end]
        out.append(x.copy())
    fine = 200 if is_held else 1
    t = np.arange(59 * fine + 1) * dt / fine
    given = np.repeat(u[:-1], fine) if is_held else u
    if is_held:
        given = np.append(given, given[-1])
    big_a, big_b = system(wn, zeta)
    exact = lsim(
        (big_a, big_b[:, None], np.eye(2), np.zeros((2, 1))), given, t, interp=not is_held
    )[1]
    np.testing.assert_allclose(np.array(out), exact[fine::fine], atol=1e-11)


def test_filter_keeps_a_constant_and_lags_a_ramp() -> None:
    wn, zeta, dt = 40.0, 0.7, 1e-3
    a, b = np.empty((2, 2)), np.empty((2, 2))
    second_order(wn, zeta, dt, a, b)
    x, t = np.zeros(2), 0.0
    for _ in range(3000):
        x = a @ x + b @ [t, t + dt]
        t += dt
    assert x[0] == pytest.approx(t - 2 * zeta / wn, rel=1e-10)
    assert x[1] * wn == pytest.approx(1.0, rel=1e-10)


@BOTH
@pytest.mark.parametrize(
    ("lag", "dt"), [(1.3e-3, 1e-3), (1.3e-3, 0.05), (0.02, 1e-3), (1e-4, 2e-4), (5.0, 1e-3)]
)
def test_moments_of_a_lagged_command(lag: float, dt: float, compiled: bool) -> None:
    held, start = 3.7, -1.9

    def w(t: float) -> float:
        return float(held + (start - held) * np.exp(-t / lag))

    def mean(f: Any) -> float:
        points = sorted({min(dt, k * lag) for k in (1.0, 5.0, 20.0)})
        return float(quad(f, 0, dt, epsabs=1e-13, epsrel=1e-12, points=points, limit=200)[0] / dt)

    end, m1, m2, mt = either(lagged_moments, compiled)(held, start, lag, np.exp(-dt / lag), dt)
    assert end == pytest.approx(w(dt), rel=1e-13)
    assert m1 == pytest.approx(mean(w), rel=1e-10)
    assert m2 == pytest.approx(mean(lambda t: w(t) ** 2), rel=1e-10)
    centred = mean(lambda t: (w(t) - held) * (t / dt - 0.5))
    assert mt == pytest.approx(centred, rel=1e-6, abs=1e-8)  # cancels where lag >> dt


@BOTH
def test_moments_without_lag_and_with_a_vanishing_one(compiled: bool) -> None:
    moments = either(lagged_moments, compiled)
    assert moments(2.0, 9.0, 0.0, 0.0, 1e-3) == (2.0, 2.0, 4.0, 0.0)
    lag, dt = 1e-9, 1e-3
    nearly = moments(2.0, 9.0, lag, float(np.exp(-dt / lag)), dt)
    np.testing.assert_allclose(nearly, (2.0, 2.0, 4.0, 0.0), atol=1e-4)
