"""The lean compiler says what numba says, of all that it writes by itself, and is there at all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numba.core.runtime import _nrt_python, rtsys

from firmware_bridge import lean_compiler
from firmware_bridge.kernel_parts import UNCOUNTED
from firmware_bridge.lean_compiler import OPTIONS

FIELDS = [
    ("n", np.int64),
    ("small", np.int8),
    ("x", np.float32),
    ("row", np.float64, (4,)),
    ("matrix", np.float64, (3, 4)),
    ("cube", np.int32, (2, 3, 4)),
]
NUMBERS = np.arange(12.0).reshape(3, 4) - 5.0


def records(align: bool) -> Any:
    made = np.zeros(3, np.dtype(FIELDS, align=align))
    made["matrix"], made["cube"] = NUMBERS, np.arange(24).reshape(2, 3, 4)
    made["n"], made["small"], made["x"] = [1, 2, -1], [-7, 7, 3], [0.5, 0.25, 1e-3]
    return made


def fields(table: Any, values: Any) -> float:
    """Fields, elements and rows, at constant, running and negative places."""
    e = table[1]
    for i in range(3):
        row = e.matrix[i]
        for j in range(4):
            e.cube[1, i, j] += i * j - e.small
            e.row[j] += row[j] * values[i, j] + e.matrix[-1, -j - 1] + e.cube[0, i, 0]
    e.row[0], e.matrix[2, 1] = e.x, e.n
    plane = e.cube[1]
    table[-1].n = plane[2, 3] + e.cube[0][1, 2]
    return float(e.row[2] + table[2].row[e.n] + len(row) + plane.size)


def elements(table: Any, values: Any) -> float:
    """Elements by tuples, of unsigned index, of a transposed array and of one of booleans."""
    at, flat, known = (2, -1), values.ravel(), values > 0.0
    values[at] = values[0, 1] + values.T[3, 1]
    for k in range(np.uint64(4)):
        flat[k] -= values[np.uint8(1), k]
    known[1, 2] = not known[0, 0]
    return float(values[at] + flat.sum() + known.sum() + table[0].n)


def loops(table: Any, values: Any) -> float:
    """Ranges up, down, empty and left early; a variable that lives on."""
    total, last = 0.0, -1
    for i in range(2, -1, -1):
        for j in range(i, 4):
            if j == 3 and i == 1:
                break
            total, last = 2.0 * total + values[i, j], j
    for last in range(5, 2):
        total += last
    for k in range(-3, 3, 2):
        total -= k // 2 + k % 2 + (k << 1) + table[0].small // 2
    return total + last


def arithmetic(table: Any, values: Any) -> float:
    """Numbers of all kinds, mixed."""
    e, x = table[0], values[0, 0]
    y = e.small * e.x - e.n / e.small + (e.n < x) + (e.x >= e.small)
    y += e.small % 3 + x % 3.0 + x // 2.0 + x**2 + 2**e.n + abs(e.small) - (not e.n)
    e.small += 3
    e.x *= 1.5
    return float(y + (-e.x) + max(e.small, e.n) + (e.n & 3) + (e.small ^ 5))


def allocating(table: Any, values: Any) -> float:
    """Arrays that are made and dropped, parts of arrays, an expression of arrays, a closure."""

    def twice(x: float) -> float:
        return 2.0 * x

    total = 0.0
    for k in range(3):
        made = np.zeros(4) + values[k] * table[k].row
        part = made[1:]
        part[0] = twice(k)
        total += part.sum() + np.array([twice(x) for x in made]).max()
    return total


CASES = fields, elements, loops, arithmetic, allocating


@pytest.mark.first_of(4)
@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize("function", CASES, ids=lambda case: case.__name__)
def test_as_numba_has_it(function: Callable[..., float], align: bool) -> None:
    changed = []
    for options in ({}, OPTIONS):
        table, values = records(align), NUMBERS.copy()
        result = njit(**options)(function)(table, values)
        changed.append((result, table.tobytes(), values.tobytes()))
    assert changed[0] == changed[1]


@pytest.mark.parametrize("function", [fields, loops, arithmetic], ids=lambda case: case.__name__)
def test_the_same_where_nothing_is_counted(function: Callable[..., float]) -> None:
    table, values = records(True), NUMBERS.copy()
    expected = njit(function)(records(True), NUMBERS.copy())
    assert njit(**OPTIONS, **UNCOUNTED)(function)(table, values) == expected


def test_each_compilation_keeps_its_own_model_of_errors() -> None:
    def divided(x: float, y: float) -> float:
        return x / y

    assert njit(error_model="numpy", **OPTIONS)(divided)(1.0, 0.0) == np.inf
    with pytest.raises(ZeroDivisionError):
        njit(**OPTIONS)(divided)(1.0, 0.0)


def test_arrays_that_are_made_are_freed() -> None:
    kernel = njit(**OPTIONS)(allocating)
    kernel(records(True), NUMBERS.copy())
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    kernel(records(True), NUMBERS.copy())
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0


def test_what_cannot_be_typed_is_refused_as_ever() -> None:
    def nonsense(x: float) -> float:
        return float(x + "a")  # type: ignore[operator]

    with pytest.raises(TypingError):
        njit(**OPTIONS)(nonsense)(1.0)


def test_this_numba_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else all is well but slow: see what has become of numba's compiler."""
    assert OPTIONS
    monkeypatch.setattr(lean_compiler, "_NEEDED", ("a name that numba never had",))
    assert not lean_compiler._is_known()


def test_a_numba_that_was_not_tried_compiles_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """What its parts are called may stay, and what they do change."""
    monkeypatch.setattr(lean_compiler, "TRIED", {(0, 1)})
    assert not lean_compiler._is_known()
