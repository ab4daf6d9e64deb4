"""Parts of kernels: without code of their own, without counted references, and without numba's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numpy.typing import NDArray

from firmware_bridge import kernel_parts
from firmware_bridge.kernel_parts import part

FloatArray = NDArray[np.float64]


def first(values: FloatArray, k: int) -> float:
    return float(values[k:][0])


def kernel_of(inner: Any) -> Any:
    """A kernel that calls a part for each of its values."""

    @njit(**kernel_parts.UNCOUNTED)
    def kernel(values: FloatArray) -> float:
        total = 0.0
        for k in range(len(values)):
            total += inner(values, k)
        return total

    return kernel


@pytest.mark.parametrize("inserted", [True, False])
def test_a_part_has_no_code_and_its_kernel_counts_nothing(inserted: bool) -> None:
    inner = part(first, forceinline=inserted)
    kernel = kernel_of(inner)
    assert kernel(np.arange(4.0)) == 6.0
    (library,) = (made.library for made in inner.overloads.values())
    assert library.get_pointer_to_function("anything") == 0
    (code,) = kernel.inspect_asm().values()
    assert "NRT_incref" not in code and "NRT_decref" not in code and "lock" not in code.split()


def test_without_what_numba_does_not_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_parts, "LINKED", None)
    monkeypatch.setattr(kernel_parts, "UNCOUNTED", {})
    assert kernel_of(part(first))(np.arange(4.0)) == 6.0


def test_this_numba_has_it() -> None:
    """Else all is well but slow: see what has become of numba's libraries."""
    assert kernel_parts.LINKED is not None and kernel_parts.UNCOUNTED


@pytest.mark.skipif(not kernel_parts.UNCOUNTED, reason="this numba counts references everywhere")
def test_a_part_that_allocates_is_refused() -> None:
    def copied(values: FloatArray, k: int) -> float:
        return float(np.empty(len(values) + k)[0])

    with pytest.raises(TypingError, match="empty"):
        kernel_of(part(copied))(np.ones(2))


def test_python_gets_a_function_of_its_own() -> None:
    inner = part(first)
    assert inner(np.arange(4.0), 2) == 2.0  # a segmentation fault, where only linked code exists
    assert kernel_of(inner)(np.arange(4.0)) == 6.0
    assert inner(np.arange(4.0), 3) == 3.0 and inner.py_func(np.arange(4.0), 1) == 1.0
