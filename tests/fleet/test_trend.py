"""Trends: a drift with an honest interval, a change told from a drift, the time to a limit."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.fleet.trend import FEWEST, change_point, series, trend

DAYS = np.arange(40.0)


def noise(seed: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def test_a_drift_is_told_with_an_interval_that_holds_the_truth() -> None:
    """95 % of the intervals cover the slope, give or take the chance of 200 trials."""
    hits = 0
    for seed in range(200):
        found = trend("beta", DAYS, 700.0 - 0.3 * DAYS + 2.0 * noise(seed))
        hits += found.slope_low <= -0.3 <= found.slope_high
    assert 0.90 <= hits / 200 <= 0.99


def test_a_steady_quantity_neither_drifts_nor_changes() -> None:
    found = [trend("beta", DAYS, 700.0 + 2.0 * noise(seed)) for seed in range(100)]
    assert sum(t.is_drifting for t in found) <= 12
    assert sum(np.isfinite(t.change_d) for t in found) <= 4


def test_a_service_is_a_change_and_no_drift() -> None:
    y = 5e-12 + 2e-13 * noise(1)
    y[25:] -= 3e-12
    found = trend("leak", DAYS, y)
    assert found.change_d == pytest.approx(25.0, abs=1.0)
    assert found.change_by == pytest.approx(-3e-12, rel=0.1)
    assert found.level == pytest.approx(2e-12, rel=0.2)
    assert not found.is_drifting


def test_a_drift_is_no_change() -> None:
    assert change_point(0.1 * DAYS + 0.2 * noise(2)) == 0


def test_the_time_to_a_limit_has_an_interval() -> None:
    """A leak that grows by 1e-13 a day from 1e-12 reaches 1e-11 on day 90."""
    found = trend("leak", DAYS, 1e-12 + 1e-13 * DAYS + 1e-13 * noise(3), limit=1e-11)
    soon, late = found.limit_d
    assert soon < 90.0 < late
    assert late - soon < 15.0
    never = trend("leak", DAYS, 1e-12 + 1e-13 * DAYS + 1e-13 * noise(3), limit=0.0)
    assert never.limit_d == (np.inf, np.inf)


def test_few_values_say_nothing() -> None:
    found = trend("beta", DAYS[: FEWEST - 1], noise(4)[: FEWEST - 1])
    assert not found.is_drifting and not np.isfinite(found.slope_high)
    assert np.isnan(trend("beta", np.zeros(0), np.zeros(0)).level)


def test_sizes_are_followed_where_they_were_looked_for() -> None:
    row = {"machine": "m", "error": "", "beta_pa": [7e8], "start_us": 0}
    rows = [
        row | {"verdict": "missing", "effects": ["leak"], "places": ["a"], "sizes": [2e-12]},
        row | {"verdict": "matches", "effects": [], "places": [], "sizes": []}
        | {"start_us": int(86_400e6)},
        row | {"verdict": "", "effects": [], "places": [], "sizes": []},
    ]  # fmt: skip
    found = {name: (t, y) for _, name, t, y in series(rows)}
    t, y = found["leak:a"]
    assert t[1] == pytest.approx(1.0)
    np.testing.assert_array_equal(y, [2e-12, 0.0, np.nan])
    assert list(found["beta_0"][1]) == [7e8] * 3
