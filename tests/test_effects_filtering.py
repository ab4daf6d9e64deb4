"""Filters and parabolas of a record are those of `scipy.signal`, which is not imported for them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter, savgol_filter

from rtid.effects.filtering import filtered, fitted, held_second_order

VALUES = np.random.default_rng(4).standard_normal(300).cumsum()


@pytest.mark.parametrize(
    ("b", "a"), [((0.0, 0.3, 0.0), (1.0, -0.7, 0.0)), ((0.1, 0.2, 0.05), (1.0, -1.2, 0.5))]
)
def test_a_filter_is_the_difference_equation_to_the_bit(
    b: tuple[float, float, float], a: tuple[float, float, float]
) -> None:
    np.testing.assert_array_equal(filtered(b, a, VALUES), lfilter(b, a, VALUES))
    np.testing.assert_array_equal(filtered(b, a, VALUES[::2]), lfilter(b, a, VALUES[::2]))


@pytest.mark.parametrize("zeta", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("wn", [20.0, 900.0])
def test_a_spool_whose_command_is_held(wn: float, zeta: float) -> None:
    b, a = held_second_order(wn, zeta, 1e-3)
    system = (np.array([wn * wn]), np.array([1.0, 2.0 * zeta * wn, wn * wn]))
    expected_b, expected_a, _ = cont2discrete(system, 1e-3, method="zoh")
    np.testing.assert_allclose(b, np.ravel(expected_b), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(a, expected_a, rtol=1e-12)


@pytest.mark.parametrize("half", [2, 7, 20])
@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_parabolas_up_to_both_ends(half: int, derivative: int) -> None:
    expected = savgol_filter(VALUES, 2 * half + 1, 2, deriv=derivative, delta=1e-3)
    got = fitted(VALUES, half, derivative, 1e-3)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
