"""The walk of a simplex against scipy's, point by point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from rtid.estimator.simplex import NEAR, NO_MORE, lowest

FloatArray = NDArray[np.float64]


def valley(x: FloatArray) -> float:
    """Rosenbrock's, in any number of unknowns."""
    return float((100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2).sum())


def bowl(x: FloatArray) -> float:
    return float(((x - np.arange(len(x)) - 0.3) ** 2).sum())


def ripples(x: FloatArray) -> float:
    return float(np.sin(3.0 * x).sum() + 0.1 * x @ x)


@pytest.mark.parametrize("function", [valley, bowl, ripples])
@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.parametrize("high", [0.8, 5.0])
def test_it_is_scipys_walk(function: Callable[[FloatArray], float], n: int, high: float) -> None:
    first: FloatArray = np.full(n, -1.2)
    start = np.vstack([first, first + np.diag([1.5, 2.5, 1.0, 0.2][:n])])
    bounds = [(-2.0, high)] * n
    options: Any = {"xatol": NEAR, "fatol": NO_MORE, "initial_simplex": start}
    known = minimize(function, first, method="Nelder-Mead", bounds=bounds, options=options)
    found = lowest(function, start, bounds)
    assert np.array_equal(found.x, known.x) and found.value == known.fun
