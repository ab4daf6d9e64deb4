"""The small regression: errors in variables, intervals, detection limits, likeness."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose.regression import LIMIT_SD, Regression


def regression(y: np.ndarray, columns: np.ndarray, noise_var: np.ndarray) -> Regression:
    """Unit noise in y; noise_var (columns,): variance of the noise in each column."""
    rows = np.column_stack([y, columns])
    size = rows.shape[1]
    noise = np.zeros((size, size))
    noise[1:, 1:] = np.diag(noise_var * len(y))
    s = rows.T @ rows
    zero = np.zeros(size)
    return Regression(s, noise, zero, zero, s.diagonal().copy(), len(y), len(y))


def trial(seed: int, noise: float, n: int = 4000) -> Regression:
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, n))
    b += 0.5 * a
    seen = a + noise * rng.standard_normal(n)
    y = 2.0 * a + 0.3 * b + rng.standard_normal(n)
    return regression(y, np.column_stack([seen, b]), np.array([noise**2, 0.0]))


def test_noise_in_a_column_does_not_draw_its_coefficient_to_zero() -> None:
    """With a third of noise in the column plain least squares gives 1.75 for a true 2."""
    values = [trial(seed, 0.5).fit((1, 2)).theta for seed in range(60)]
    assert np.mean(values, axis=0) == pytest.approx([2.0, 0.3], abs=0.02)
    plain = [np.linalg.solve((r := trial(s, 0.5)).s[1:, 1:], r.s[1:, 0])[0] for s in range(20)]
    assert np.mean(plain) < 1.75


def test_intervals_without_noise_in_columns_are_those_of_least_squares() -> None:
    """Stated and actual scatter agree within 15 % over 200 draws."""
    found = [trial(seed, 0.0).fit((1, 2)) for seed in range(200)]
    scatter = np.std([f.theta for f in found], axis=0)
    stated = np.sqrt(np.mean([np.diag(f.cov) for f in found], axis=0))
    assert scatter == pytest.approx(stated, rel=0.15)


def test_rho_is_one_for_a_true_model_and_more_for_a_missing_column() -> None:
    r = trial(1, 0.0)
    assert r.rho(r.fit((1, 2))) == pytest.approx(1.0, abs=0.08)
    assert r.rho(r.fit((2,))) > 2.0


def test_a_score_is_the_fall_of_the_misfit() -> None:
    r = trial(2, 0.0)
    score = r.score((1,), 2)
    assert score.gain == pytest.approx(r.fit((1,)).sse - r.fit((1, 2)).sse, rel=1e-6)
    assert score.sd * LIMIT_SD < 0.1


def test_a_column_that_never_moved_is_not_visible() -> None:
    rng = np.random.default_rng(3)
    y, a = rng.standard_normal((2, 500))
    r = regression(y, np.column_stack([a, np.zeros(500)]), np.zeros(2))
    score = r.score((1,), 2)
    assert score.gain == 0.0
    assert score.visible == 0.0
    assert np.isinf(score.sd)


def test_noise_alone_is_not_taken_for_information() -> None:
    """A column of nothing but its own noise: the estimate stays finite, its interval is wide."""
    rng = np.random.default_rng(4)
    n = 4000
    y, b, e = rng.standard_normal((3, n))
    r = regression(y, np.column_stack([e, b]), np.array([1.0, 0.0]))
    estimate = r.fit((1, 2))
    assert np.isfinite(estimate.theta).all()
    assert abs(estimate.value(1)) < 3 * estimate.sd(1)


@pytest.mark.parametrize("scale", [1e-157, 1e140])
def test_columns_of_any_size_are_fitted(scale: float) -> None:
    """What a law makes of a start far off: its products ended in "infs or NaNs"."""
    rng = np.random.default_rng(5)
    y, a, b = rng.standard_normal((3, 500))
    r = regression(y + a, np.column_stack([a, scale * b]), np.array([0.01, 0.0]))
    estimate = r.fit((1, 2))
    assert estimate.value(1) == pytest.approx(1.0, abs=0.2)
    assert np.isfinite(estimate.sse)


def test_noise_beside_columns_that_follow_one_another_is_bounded() -> None:
    """Rows that were whitened by far too little noise ended in "B is not positive definite"."""
    rng = np.random.default_rng(5)
    a, y = rng.standard_normal((2, 1000))
    r = regression(y, np.column_stack([a, a, a]), np.array([0.5, 0.5, 0.0]))
    r.s[1, 2] = r.s[2, 1] = r.s[1, 1] * (1.0 + 1e-9)  # as rounding leaves them
    estimate = r.fit((1, 2))
    assert np.isfinite(estimate.theta).all() and np.isfinite(estimate.cov).all()
    assert np.isfinite(r.noise_of([1, 2, 3])).all()
