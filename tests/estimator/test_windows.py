"""The squared lapped windows of (12): partition of unity, smoothness, exactness near zero."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rtid.estimator.windows import OVERLAP, blend, overlaps, profile, rising, rising_slope

widths = st.lists(st.floats(1e-2, 1e2), min_size=1, max_size=12)


def test_squares_of_the_window_and_its_mirror_sum_to_one() -> None:
    t = np.linspace(-1.5, 1.5, 3001)
    np.testing.assert_allclose(rising(t) + rising(-t), 1.0, atol=5e-16)
    np.testing.assert_allclose(profile(t) ** 2, rising(t), atol=5e-16)
    assert rising(np.array([-1.0]))[0] == 0.0
    assert rising(np.array([1.0]))[0] == 1.0


def test_slope_is_the_derivative_and_vanishes_at_both_ends() -> None:
    t, h = np.linspace(-1.2, 1.2, 2401), 1e-6
    difference = (rising(t + h) - rising(t - h)) / (2 * h)
    np.testing.assert_allclose(rising_slope(t), difference, atol=1e-9)
    assert np.abs(rising_slope(np.array([-2.0, -1.0, 1.0, 2.0]))).max() < 1e-30


def test_relative_error_stays_small_where_the_window_begins() -> None:
    """rising(t) = pi^2/4 (pi/4 (1 + t))^4 (1 + O((1 + t)^2)); the inverse of a map needs it."""
    distance = 2.0 ** -np.arange(6.0, 30.0)
    series = (0.5 * np.pi) ** 2 * (0.25 * np.pi * distance) ** 4
    np.testing.assert_allclose(rising(distance - 1.0), series, rtol=1e-3)


@given(widths, st.floats(0.01, 0.5))
def test_overlaps_of_one_block_never_meet(width: list[float], share: float) -> None:
    border = np.append(0.0, np.cumsum(width))
    eta = overlaps(border, share)
    assert (eta > 0).all()
    assert (eta[:-1] + eta[1:] <= np.diff(border) * (1 + 1e-12)).all()


@given(widths, st.integers(0, 1000))
def test_each_point_belongs_to_the_block_that_holds_it(width: list[float], seed: int) -> None:
    border = np.append(0.0, np.cumsum(width))
    at = np.random.default_rng(seed).uniform(0, border[-1], 200)
    lower, weight, slope = blend(border, at)
    assert ((weight >= 0) & (weight <= 1) & (slope >= 0)).all()
    held = np.searchsorted(border, at, side="right") - 1
    off_border = np.abs(at[:, None] - border).min(axis=1) > 1e-9 * border[-1]
    np.testing.assert_array_equal(
        np.where(weight > 0.5, lower + 1, lower)[off_border], held[off_border]
    )


def test_blocks_mix_only_within_the_overlap() -> None:
    border = np.array([0.0, 1.0, 1.1, 3.0, 9.0])
    at = np.linspace(0, 9, 4001)
    weight, eta = blend(border, at)[1], overlaps(border, OVERLAP)
    mixed = (weight > 0) & (weight < 1)
    near = (np.abs(at[:, None] - border[1:-1]) < eta[1:-1]).any(axis=1)
    assert mixed.any()
    assert not (mixed & ~near).any()
