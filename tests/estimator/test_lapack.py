"""The factor and the inverse are scipy's to the bit, and other threads go on meanwhile."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from scipy.linalg import LinAlgError, cho_factor
from scipy.linalg.lapack import dpotri

from rtid.estimator import lapack
from rtid.plain import FloatArray


def definite(n: int) -> FloatArray:
    root = np.random.default_rng(1).normal(size=(n, n))
    return np.asfortranarray(root @ root.T + n * np.eye(n))


def test_factor_and_inverse_are_those_of_scipy() -> None:
    upper = lapack.factorized(definite(100))
    expected = cho_factor(definite(100), lower=False)[0]
    assert np.array_equal(np.triu(upper), np.triu(expected))
    inverse = np.triu(lapack.inverted(upper))
    assert np.array_equal(inverse, np.triu(dpotri(expected, lower=0)[0]))


def test_what_is_not_definite_or_not_finite_is_refused() -> None:
    with pytest.raises(LinAlgError, match="2-th leading minor"):
        lapack.factorized(np.asfortranarray(np.diag([1.0, -1.0])))
    with pytest.raises(ValueError, match="infs or NaNs"):
        lapack.factorized(np.asfortranarray(np.diag([1.0, np.nan])))


def test_other_threads_go_on_meanwhile() -> None:
    """A thread that holds the interpreter would let the other one look at its end alone."""
    matrix, looks, is_over = definite(1500), list[float](), threading.Event()

    def look() -> None:
        while not is_over.wait(1e-3):
            looks.append(time.thread_time())

    looking = threading.Thread(target=look)
    looking.start()
    before = len(looks)
    lapack.inverted(lapack.factorized(matrix))
    during = len(looks) - before
    is_over.set()
    looking.join()
    assert during >= 10
