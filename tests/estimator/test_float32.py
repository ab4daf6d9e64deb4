"""How far sums in single precision would carry: the limits for which the kernels take float64.

Adding r r' to a float32 sum S rounds to 2^-24 S: what is smaller than that is lost for good, and
the information's condition number amplifies the loss.  Measured on whitened rows of a simulated
record, two compliances and one block, condition number 3.5e3:

    parameters are off by more than 1e-3 after 1e4 rows (2.5 s of both chambers at 1 kHz), the
    information is no longer definite after 2e6; products of one size stop counting at 2^24 of
    them; with forgetting the same holds for its memory in rows, however long it runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numba import njit
from numpy.typing import DTypeLike, NDArray

from rtid.estimator.batch import fit_batch
from rtid.model import Grid
from rtid.plain import FloatArray
from tests.estimator.cases import plant_case

WRONG_AFTER, INDEFINITE_AFTER = 10_000, 2_000_000  # rows
STALL = 2**24
WRONG = 1e-3  # of the largest parameter
KEPT_S = 2.0  # of the record
WHOLE = Grid(np.array([1.0, 10.0]), np.array([-1.0, 10.0]) * 1e6)


@njit(cache=True)
def accumulate(rows: NDArray[np.floating], gram: NDArray[np.floating]) -> None:
    """Add the products of rows (m, n) to gram (n, n), one row after another."""
    for k in range(len(rows)):
        for i in range(rows.shape[1]):
            for j in range(rows.shape[1]):
                gram[i, j] += rows[k, i] * rows[k, j]


@cache
def period() -> FloatArray:
    """Whitened rows (m, 9) = [y | two compliances | the block of one edge], to be repeated."""
    case = plant_case(4, "integral", duration_s=5.0)
    model = replace(case.model, edges=tuple(replace(e, grid=WHOLE) for e in case.model.edges))
    last = slice(-round(1000 * KEPT_S), None)
    fit = fit_batch(model, case.t_s[last], case.values[last], case.flags[last])
    return np.column_stack([fit.y, fit.rows[:, :8]])


@dataclass(frozen=True)
class Result:
    """rows taken; error of the parameters in units of the largest one, inf: not definite."""

    rows: int
    error: float


def added_up(dtype: DTypeLike, rows: int, memory_rows: float = np.inf) -> Result:
    """Sums of so many rows in this precision, beside least squares on one period.

    Each period is scaled at random, so that products do not round the same way for ever.
    memory_rows: after each period the past fades by exp(-period / memory_rows).
    """
    one, rng = period(), np.random.default_rng(0)
    gram, passes = np.zeros((one.shape[1],) * 2, dtype), -(-rows // len(one))
    scaled = [(one * s).astype(dtype) for s in rng.uniform(0.8, 1.2, 64)]
    keep = np.asarray(np.exp(-len(one) / memory_rows), dtype)
    for k in range(passes):
        gram *= keep
        accumulate(scaled[k % len(scaled)], gram)
    return Result(passes * len(one), _error(gram.astype(np.float64), one))


def _error(gram: FloatArray, rows: FloatArray) -> float:
    true = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
    size = np.sqrt(np.diag(gram)[1:])
    scaled = gram[1:, 1:] / np.outer(size, size)
    if np.linalg.eigvalsh(scaled)[0] <= 0:
        return np.inf
    theta = np.linalg.solve(scaled, gram[1:, 0] / size) / size
    return float(np.abs(theta - true).max() / np.abs(true).max())


def test_equal_products_stall() -> None:
    ones, single = np.ones((STALL // 64, 1), np.float32), np.zeros((1, 1), np.float32)
    for _ in range(70):
        accumulate(ones, single)
    assert single[0, 0] == STALL


def test_single_precision_is_wrong_after_ten_thousand_rows() -> None:
    single, double = (added_up(dtype, WRONG_AFTER) for dtype in (np.float32, np.float64))
    print(f"{single.rows} rows: float32 off by {single.error:.1e}, float64 by {double.error:.1e}")
    assert single.error > WRONG
    assert double.error < 1e-10


def test_single_precision_is_indefinite_after_two_million_rows() -> None:
    assert added_up(np.float32, INDEFINITE_AFTER).error == np.inf
    assert added_up(np.float64, INDEFINITE_AFTER).error < 1e-9


@pytest.mark.parametrize(("memory_rows", "least"), [(6e4, WRONG), (6e5, np.inf)])
def test_forgetting_does_not_help(memory_rows: float, least: float) -> None:
    """A memory of half a minute and of five minutes, 6 time constants long."""
    single = added_up(np.float32, int(6 * memory_rows), memory_rows)
    double = added_up(np.float64, int(6 * memory_rows), memory_rows)
    print(f"memory of {memory_rows:.0e} rows: float32 {single.error:.1e}, {double.error:.1e}")
    assert single.error >= least
    assert double.error < 1e-9
