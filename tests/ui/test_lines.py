"""Lines at any zoom: nothing that stands out is lost, gaps stay gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.ui.lines import POINTS, Line


def record(n: int = 110_000) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n) * 1e-3
    return t, np.sin(2 * np.pi * 0.3 * t)


@settings(deadline=None)
@given(st.integers(0, 109_999), st.booleans())
def test_a_spike_of_one_sample_is_drawn_at_the_whole_record(at: int, up: bool) -> None:
    t, y = record()
    y[at] = 5.0 if up else -5.0
    seen_t, seen_y = Line(t, y).between(0.0, 110.0)
    assert t[at] in seen_t
    assert y[at] in seen_y
    assert len(seen_y) <= POINTS + 2


@pytest.mark.parametrize(("low", "high"), [(10.0, 11.0), (55.0, 80.0), (0.0, 110.0)])
def test_what_is_seen_spans_the_window_and_keeps_its_extremes(low: float, high: float) -> None:
    t, y = record()
    y += 0.3 * np.random.default_rng(0).standard_normal(len(y))
    seen_t, seen_y = Line(t, y).between(low, high)
    inside = (t >= low) & (t <= high)
    assert seen_t[0] <= t[inside][0]
    assert seen_t[-1] >= t[inside][-1]
    assert seen_y.min() <= y[inside].min()
    assert seen_y.max() >= y[inside].max()
    assert np.all(np.diff(seen_t) >= 0)


def test_a_short_window_shows_every_sample() -> None:
    t, y = record()
    seen_t, _ = Line(t, y).between(20.0, 20.5)
    assert len(seen_t) == pytest.approx(501, abs=3)


def test_parts_are_not_joined_by_a_line() -> None:
    t, y = record(20_000)
    line = Line.joined([(t[:8000], y[:8000]), (t[12_000:], y[12_000:])])
    seen_t, seen_y = line.between(0.0, 20.0)
    between = (seen_t > t[7999] - 1e-9) & (seen_t < t[12_000] + 1e-9)
    assert np.isnan(seen_y[between]).any()


def test_missing_values_break_the_line_and_do_not_hide_their_neighbours() -> None:
    t, y = record()
    y[40_000:41_000] = np.nan
    y[39_999], y[41_000] = 7.0, -7.0
    seen_t, seen_y = Line(t, y).between(0.0, 110.0)
    assert 7.0 in seen_y
    assert -7.0 in seen_y
    assert np.isnan(seen_y[(seen_t > 40.0) & (seen_t < 41.0)]).any()


def test_a_record_of_nothing_has_no_line() -> None:
    line = Line.joined([(np.empty(0), np.empty(0))])
    assert all(len(part) == 0 for part in line.between(0.0, 1.0))
