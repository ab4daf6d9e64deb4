"""The solution of ill-conditioned sums is that of the sums, to the last digits."""

from __future__ import annotations

import tracemalloc
from fractions import Fraction

import numpy as np
import pytest

from rtid.estimator.factor import Factor, factorize
from rtid.estimator.sums import Normal
from rtid.kernels.normal import residual
from rtid.plain import FloatArray


def nearly_alike(seed: int, n: int, spread: float) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (n, n) and right-hand side (n,) of columns that differ by `spread`."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((500, 1)) + spread * rng.standard_normal((500, n))
    columns *= 10.0 ** rng.uniform(-3, 3, n)
    return columns.T @ columns, columns.T @ rng.standard_normal(500)


def scaled(factor: Factor) -> FloatArray:
    """What was factorised (n, n)."""
    return (factor.gram + np.diag(factor.prior)) * np.outer(factor.scale, factor.scale)


def exact(factor: Factor, right: FloatArray) -> FloatArray:
    """The factor's equations solved in fractions: Gauss elimination of a definite matrix."""
    rows = [[Fraction(x) for x in (*row, b)] for row, b in zip(factor.gram, right, strict=True)]
    for i, prior in enumerate(factor.prior):
        rows[i][i] += Fraction(prior)
    n = len(rows)
    for k in range(n):
        for i in range(n):
            if i != k:
                share = rows[i][k] / rows[k][k]
                rows[i] = [x - share * y for x, y in zip(rows[i], rows[k], strict=True)]
    return np.array([float(rows[k][n] / rows[k][k]) for k in range(n)])


@pytest.mark.parametrize("seed", range(3))
def test_one_step_of_refinement_is_enough(seed: int) -> None:
    """Condition 1e9: a step with its residual in double precision leaves 1e-7."""
    gram, right = nearly_alike(seed, 8, 1e-4)
    factor = factorize(Normal(gram * 1e6, right * 1e6, 1.0, np.zeros(1), 500.0), 1)
    assert 1e9 < np.linalg.cond(scaled(factor)) < 1e10
    np.testing.assert_allclose(factor.theta(right), exact(factor, right), rtol=1e-12)


def test_scaling_changes_no_digit() -> None:
    gram, right = nearly_alike(0, 8, 1e-2)
    factor = factorize(Normal(gram, right, 1.0, np.zeros(1), 500.0), 1)
    below = np.tri(8, k=-1, dtype=bool)
    back = factor.upper / np.outer(factor.scale, factor.scale)
    assert np.array_equal(back[below], gram[below])
    assert 0.5 <= np.diag(scaled(factor)).min() < np.diag(scaled(factor)).max() < 2.0


def test_the_inverse_is_that_of_the_sums_with_their_prior() -> None:
    gram, right = nearly_alike(2, 8, 1e-1)
    factor = factorize(Normal(gram, right, 1.0, np.zeros(1), 500.0), 1)
    product = factor.cov() @ (gram + np.diag(factor.prior))
    np.testing.assert_allclose(product, np.eye(8), atol=1e-6)
    assert np.array_equal(factor.cov(), factor.cov().T)


def test_one_matrix_stands_beside_the_sums() -> None:
    """The factor is written over the copy, and the sums are not copied again."""
    gram = np.eye(300) * 1e6
    normal = Normal(gram, np.ones(300), 1.0, np.zeros(1), 500.0)
    factorize(normal, 1)
    tracemalloc.start()
    factor = factorize(normal, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert factor.gram is gram and peak < 1.3 * gram.nbytes


def test_the_last_inverse_is_written_over_the_factor() -> None:
    gram, right = nearly_alike(2, 8, 1e-1)
    normal = Normal(gram, right, 1.0, np.zeros(1), 500.0)
    factor, other = factorize(normal, 1), factorize(normal, 1)
    inverse = factor.cov(is_last=True)
    assert np.shares_memory(inverse, factor.upper)
    assert np.array_equal(inverse, other.cov()) and not np.shares_memory(other.cov(), other.upper)


@pytest.mark.parametrize("function", [residual, residual.py_func], ids=["compiled", "python"])
def test_residual_is_rounded_once(function: object) -> None:
    """Terms of size 1e3 whose sum is 1e-6, and less."""
    assert callable(function)
    gram, right = nearly_alike(1, 12, 1e-4)
    theta = np.linalg.solve(gram, right)
    found = function(gram, theta, right)
    for i in range(len(right)):
        products = (Fraction(a) * Fraction(t) for a, t in zip(gram[i], theta, strict=True))
        true = float(Fraction(right[i]) - sum(products, Fraction(0)))
        size = float(np.abs(gram[i]) @ np.abs(theta))
        assert abs(found[i] - true) <= 2.0**-52 * abs(true) + 2.0**-98 * size
