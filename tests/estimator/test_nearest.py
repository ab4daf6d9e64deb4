"""The shortest vector behind sparse inequalities, beside scipy's nnls on the dense problem."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from rtid.kernels.nearest import shortest
from rtid.plain import FloatArray, IntArray

CELLS, TERMS = 12, 6
Problem = tuple[FloatArray, IntArray, FloatArray]


def problem(seed: int, m: int) -> Problem:
    """m rows of unit norm, some of them twice or almost, that some vector fulfils."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((m, 4, TERMS))
    cells = np.array([rng.choice(CELLS, 4, replace=False) for _ in range(m)])
    twice = rng.integers(0, m // 2, m // 3)
    rows[-len(twice) :] = rows[twice] * (1 + 1e-9 * rng.standard_normal((len(twice), 1, 1)))
    cells[-len(twice) :] = cells[twice]
    rows /= np.linalg.norm(rows, axis=(1, 2))[:, None, None]
    some = rng.standard_normal((CELLS, TERMS))
    least = np.einsum("kci,kci->k", rows, some[cells]) - rng.exponential(0.3, m)
    return rows, cells, least


def dense(rows: FloatArray, cells: IntArray) -> FloatArray:
    wide = np.zeros((len(rows), CELLS, TERMS))
    wide[np.arange(len(rows))[:, None], cells] = rows
    return wide.reshape(len(rows), -1)


def expected(rows: FloatArray, cells: IntArray, least: FloatArray) -> FloatArray:
    e = np.vstack([dense(rows, cells).T, least])
    u, _ = nnls(e, np.append(np.zeros(CELLS * TERMS), 1.0))
    rest = e @ u
    return np.asarray(rest[:-1] / (1.0 - rest[-1]))


@pytest.mark.parametrize("m", [6, 40, 150])
@pytest.mark.parametrize("seed", range(5))
def test_it_is_what_nonnegative_least_squares_finds(seed: int, m: int) -> None:
    """From nothing, and from the answer to a part of the inequalities."""
    rows, cells, least = problem(seed, m)
    true = expected(rows, cells, least)
    u = np.zeros(m)
    for k in (m // 3, m):
        z, part = np.zeros((CELLS, TERMS)), u[:k].copy()
        shortest(rows[:k], cells[:k], least[:k], part, z)
        u[:k] = part
        assert (part >= 0).all()
    assert z.ravel() == pytest.approx(true, abs=1e-7 * float(np.abs(true).max()))
    assert (dense(rows, cells) @ z.ravel() - least).min() > -1e-8
    again = np.zeros((CELLS, TERMS))
    shortest(rows, cells, least, np.zeros(m), again)
    assert again == pytest.approx(z, abs=1e-9)


def test_what_holds_already_moves_nothing() -> None:
    rows, cells, least = problem(9, 30)
    z = np.zeros((CELLS, TERMS))
    shortest(rows, cells, -np.abs(least), np.zeros(30), z)
    assert not z.any()
