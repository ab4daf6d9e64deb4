"""Blocks and their terms: which block, with which hysteresis, and the six numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.kernels.basis import locate, relocate, taylor

BORDER = np.array([-1.0, -0.25, 0.0, 0.5, 2.0, 2.1])
BOTH = pytest.mark.parametrize("compiled", [True, False])
POINTS = st.floats(-3, 4, allow_nan=False)


def either(kernel: Any, compiled: bool) -> Any:
    return kernel if compiled else kernel.py_func


@settings(deadline=None)  # the first call compiles
@given(value=POINTS)
@BOTH
def test_locate_is_the_interval_that_holds_the_value(value: float, compiled: bool) -> None:
    at = either(locate, compiled)(BORDER, 5, value)
    if value < BORDER[0] or value > BORDER[-1]:
        assert at == -1
    else:
        assert BORDER[at] <= value <= BORDER[at + 1]
        assert value < BORDER[at + 1] or at == 4


@BOTH
def test_nothing_holds_what_is_no_number(compiled: bool) -> None:
    assert either(locate, compiled)(BORDER, 5, np.nan) == -1
    assert either(locate, compiled)(BORDER, 5, np.inf) == -1
    assert either(relocate, compiled)(BORDER, 5, np.nan, 2, 0.1) == -1


@settings(deadline=None)
@given(value=POINTS, current=st.integers(0, 4), share=st.sampled_from([0.0, 0.05, 0.3]))
@BOTH
def test_hysteresis_holds_the_block(
    value: float, current: int, share: float, compiled: bool
) -> None:
    at = either(relocate, compiled)(BORDER, 5, value, current, share)
    margin = share * (BORDER[current + 1] - BORDER[current])
    inside = BORDER[current] - margin <= value <= BORDER[current + 1] + margin
    assert at == (current if inside else locate(BORDER, 5, value))


@BOTH
def test_without_a_block_there_is_no_hysteresis(compiled: bool) -> None:
    for value in (-1.0, -0.25, 0.3, 2.1, 2.2):
        assert either(relocate, compiled)(BORDER, 5, value, -1, 0.5) == locate(BORDER, 5, value)


@BOTH
def test_six_terms(compiled: bool) -> None:
    out = np.empty(6)
    either(taylor, compiled)(0.3, -0.7, out)
    np.testing.assert_allclose(out, [1.0, 0.3, -0.7, 0.09, 0.49, -0.21], rtol=1e-15)
