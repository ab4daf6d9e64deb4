"""What a block and the law of its valve tell together, also where next to nothing is known."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.estimator.published import ROUNDED, information_of
from rtid.plain import FloatArray


def covariance(deviations: FloatArray) -> FloatArray:
    """A covariance (6, 6), m6/s2, of deviations (6,), m3/s, along directions drawn at random."""
    axes, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((6, 6)))
    return np.asarray(axes @ np.diag(deviations**2) @ axes.T)


def test_of_a_block_that_is_known_it_is_the_inverse() -> None:
    cov = covariance(np.geomspace(1e-7, 1e-5, 6))
    assert information_of(cov, ROUNDED) @ cov == pytest.approx(np.eye(6), abs=1e-6)


@pytest.mark.parametrize("rank", [1, 3, 5])
def test_of_one_that_rounding_makes_singular_it_is_finite(rank: int) -> None:
    """One motion had crossed it: some directions were known 1e16 times better than others."""
    cov = covariance(np.where(np.arange(6) < rank, 1e-5, 0.0))
    information = information_of(cov, ROUNDED)
    assert np.isfinite(information).all()
    largest = np.linalg.eigvalsh(0.5 * (information + information.T))
    assert largest[-1] < 10.0 / (ROUNDED * np.diag(cov).min())
