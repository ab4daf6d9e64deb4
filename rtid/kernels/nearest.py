"""The shortest vector that many sparse inequalities leave, by active sets (Lawson and Hanson 1974).

    minimise |z|   subject to   rows z >= least

is  minimise |E u - f|  over  u >= 0  with the columns  E = (rows'; least'),  f = (0; 1)  and
z = rows' u / (1 - least' u), ch. 23.  Each row touches four cells, so that a product of two costs
little; the normal equations of the rows in use are kept as a Cholesky factor, L L' = E' E, and a
row that comes or goes changes it.  The rows that were in use before are where to start.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtid.kernels.jit import kernel, part

DEPENDENT = 1e-14  # share of a row that the rows in use do not say: less is no row of its own
ENOUGH = 1e-12  # shortfall of an inequality that counts as none
MOST = 20  # changes per row before the search ends with what it has


@part
def _product(rows: Any, cells: Any, least: Any, i: int, j: int) -> float:
    """Of two columns of E."""
    total = least[i] * least[j]
    for a in range(cells.shape[1]):
        for b in range(cells.shape[1]):
            if cells[i, a] == cells[j, b]:
                for k in range(rows.shape[2]):
                    total += rows[i, a, k] * rows[j, b, k]
    return total


@part
def _appended(rows: Any, cells: Any, least: Any, used: Any, n: int, j: int, L: Any, c: Any) -> bool:
    """Make j the n-th row in use, L c = least; False where the others say it or it goes back."""
    rest, right = _product(rows, cells, least, j, j), least[j]
    size = rest
    for i in range(n):
        value = _product(rows, cells, least, used[i], j)
        for k in range(i):
            value -= L[i, k] * L[n, k]
        value /= L[i, i]
        L[n, i] = value
        rest -= value * value
        right -= value * c[i]
    if rest <= DEPENDENT * size or right <= 0.0:
        return False
    used[n], L[n, n] = j, np.sqrt(rest)
    c[n] = right / L[n, n]
    return True


@part
def _removed(used: Any, n: int, at: int, L: Any, c: Any) -> None:
    """Take out the row in place `at` of n, by rotations of the columns behind it."""
    for i in range(at, n - 1):
        used[i] = used[i + 1]
        for k in range(i + 2):
            L[i, k] = L[i + 1, k]
    for i in range(at, n - 1):
        size = np.hypot(L[i, i], L[i, i + 1])
        cos, sin = L[i, i] / size, L[i, i + 1] / size
        for m in range(i, n - 1):
            first, second = L[m, i], L[m, i + 1]
            L[m, i], L[m, i + 1] = cos * first + sin * second, cos * second - sin * first
        first, second = c[i], c[i + 1]
        c[i], c[i + 1] = cos * first + sin * second, cos * second - sin * first


@part
def _solved(n: int, L: Any, c: Any, s: Any) -> None:
    """Multipliers s (n,) of the rows in use: L' s = c."""
    for i in range(n):
        s[i] = c[i]
    for i in range(n - 1, -1, -1):
        s[i] /= L[i, i]
        for k in range(i):
            s[k] -= L[i, k] * s[i]


@part
def _moved(used: Any, n: int, L: Any, c: Any, s: Any, u: Any) -> int:
    """Bring u to the multipliers s; rows whose multiplier would be negative go.  How many stay."""
    _solved(n, L, c, s)
    while True:
        share, at = 1.0, -1
        for i in range(n):
            if s[i] <= 0.0 and u[used[i]] <= share * (u[used[i]] - s[i]):
                share, at = u[used[i]] / (u[used[i]] - s[i]), i
        for i in range(n):
            u[used[i]] += share * (s[i] - u[used[i]])
        if at < 0:
            return n
        u[used[at]] = 0.0
        _removed(used, n, at, L, c)
        n -= 1
        _solved(n, L, c, s)


@kernel
def shortest(rows: Any, cells: Any, least: Any, u: Any, z: Any) -> None:
    """z (cells, 6), zero before, of rows (m, 4, 6) on the cells (m, 4); m numbers least.

    u (m,): the multipliers, before where to start from: those of some of the rows, zero elsewhere.
    """
    m = len(least)
    L, c, s = np.zeros((m, m)), np.zeros(m), np.zeros(m)
    used, n, tried = np.zeros(m, np.int64), 0, np.zeros(m, np.bool_)
    for start in np.flatnonzero(u):
        if _appended(rows, cells, least, used, n, start, L, c):
            n += 1
        else:
            u[start] = 0.0
    n = _moved(used, n, L, c, s, u)
    for _ in range(MOST * m):
        z[:] = 0.0
        left = 1.0
        tried[:] = False
        for i in range(n):
            j = used[i]
            tried[j] = True
            left -= least[j] * u[j]
            for a in range(cells.shape[1]):
                for k in range(rows.shape[2]):
                    z[cells[j, a], k] += u[j] * rows[j, a, k]
        short = np.zeros(m)
        for j in range(m):
            short[j] = least[j] * left
            for a in range(cells.shape[1]):
                for k in range(rows.shape[2]):
                    short[j] -= rows[j, a, k] * z[cells[j, a], k]
        short[tried] = 0.0
        while True:
            worst = int(np.argmax(short))
            if short[worst] <= ENOUGH * left:
                z /= left
                return
            if _appended(rows, cells, least, used, n, worst, L, c):
                break
            short[worst] = 0.0
        n = _moved(used, n + 1, L, c, s, u)
    z /= left
