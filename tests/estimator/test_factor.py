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


def scaled(gram: FloatArray, factor: Factor) -> FloatArray:
    """What was factorised (n, n)."""
    return (gram + np.diag(factor.prior)) * np.outer(factor.scale, factor.scale)


def exact(gram: FloatArray, factor: Factor, right: FloatArray) -> FloatArray:
    """The factor's equations solved in fractions: Gauss elimination of a definite matrix."""
    rows = [[Fraction(x) for x in (*row, b)] for row, b in zip(gram, right, strict=True)]
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
    gram *= 1e6
    factor = factorize(Normal(gram, right * 1e6, 1.0, np.zeros(1), 500.0), 1)
    assert 1e9 < np.linalg.cond(scaled(gram, factor)) < 1e10
    both = np.column_stack([right, right[::-1]])
    found = factor.theta(both)
    for k in range(2):
        np.testing.assert_allclose(found[:, k], exact(gram, factor, both[:, k]), rtol=1e-12)


def test_scaling_changes_no_digit() -> None:
    gram, right = nearly_alike(0, 8, 1e-2)
    factor = factorize(Normal(gram, right, 1.0, np.zeros(1), 500.0), 1)
    below = np.tri(8, k=-1, dtype=bool)
    back = factor.upper / np.outer(factor.scale, factor.scale)
    assert np.array_equal(back[below], gram[below])
    size = np.diag(scaled(gram, factor))
    assert 0.5 <= size.min() < size.max() < 2.0


def test_the_inverse_is_that_of_the_sums_with_their_prior() -> None:
    gram, right = nearly_alike(2, 8, 1e-1)
    factor = factorize(Normal(gram, right, 1.0, np.zeros(1), 500.0), 1)
    product = factor.cov() @ (gram + np.diag(factor.prior))
    np.testing.assert_allclose(product, np.eye(8), atol=1e-6)
    assert np.array_equal(factor.cov(), factor.cov().T)


def test_the_sums_are_written_over_where_nobody_asks_for_them() -> None:
    """The factor stands in their place, a residual is read from what is left."""
    gram, right = nearly_alike(1, 300, 1e-1)
    normal = Normal(gram.copy(), right, 1.0, np.zeros(1), 500.0)
    beside = factorize(normal, 1)
    assert np.array_equal(normal.gram, gram) and not np.shares_memory(beside.upper, normal.gram)
    tracemalloc.start()
    factor = factorize(normal, 1, is_last=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.shares_memory(factor.upper, normal.gram) and peak < 0.3 * gram.nbytes
    assert np.array_equal(factor.theta(right), beside.theta(right))


def test_the_last_inverse_is_written_over_the_factor() -> None:
    gram, right = nearly_alike(2, 8, 1e-1)
    normal = Normal(gram, right, 1.0, np.zeros(1), 500.0)
    factor, other = factorize(normal, 1), factorize(normal, 1)
    inverse = factor.cov(is_last=True)
    assert np.shares_memory(inverse, factor.upper)
    assert np.array_equal(inverse, other.cov()) and not np.shares_memory(other.cov(), other.upper)


@pytest.mark.parametrize("n", [1, 8, 9, 12, 21])
@pytest.mark.parametrize("function", [residual, residual.py_func], ids=["compiled", "python"])
def test_residual_is_rounded_once(function: object, n: int) -> None:
    """Terms of size 1e3 whose sum is 1e-6, and less; what stands left of the diagonal is noise."""
    assert callable(function)
    gram, right = nearly_alike(1, n, 1e-4)
    theta = np.linalg.solve(gram, right)
    left = np.tri(n, dtype=bool)
    found = function(np.where(left, np.nan, gram), gram.diagonal().copy(), theta, right)
    for i in range(len(right)):
        products = (Fraction(a) * Fraction(t) for a, t in zip(gram[i], theta, strict=True))
        true = float(Fraction(right[i]) - sum(products, Fraction(0)))
        size = float(np.abs(gram[i]) @ np.abs(theta))
        assert abs(found[i] - true) <= 2.0**-52 * abs(true) + 2.0**-98 * size
