"""The evidence for a named effect: its points rise by the coefficient, and lie level after it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.diagnose.diagnosis import Result
from rtid.diagnose.partial import Exhibit, Rise, exhibits
from rtid.project import load
from rtid.sim.hidden import hide_wish
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from rtid.tell.charts.evidence import caption, charts_of
from rtid.tell.terminal import table_of
from rtid.units import Z95

TRUE = 2e-12  # m3/s/Pa
NEAR = 4.0  # standard deviations


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The diagnosis of a record of a machine that leaks past its piston."""
    trace = tmp_path_factory.mktemp("leaking") / "leak.parquet"
    plant = hide_wish(SimulatedPlant(), "internal_leakage_laminar=middle")
    write_run(trace, simulate(plant, "rich", 0, 30.0), 0, "rich")
    return Study(load(trace.with_suffix(".toml")), trace).diagnosed.result


@pytest.fixture(scope="module")
def exhibit(result: Result) -> Exhibit:
    (found,) = exhibits(result)
    return found


def slope_of(trend: Rise) -> tuple[float, float]:
    """Slope through zero of the points as they are drawn, and its standard deviation."""
    x, y, sd = trend.bins.centre, trend.bins.mean_m3s[:, 0], trend.bins.error_m3s[:, 0]
    weight = x / sd**2
    return float(weight @ y / (weight @ x)), float(1.0 / np.sqrt(weight @ x))


@pytest.mark.long
def test_the_points_rise_by_the_coefficient_before_and_by_nothing_after(exhibit: Exhibit) -> None:
    named = exhibit.named
    assert named.key == ("internal_leakage_laminar", "a-b")
    assert exhibit.coefficient == pytest.approx(TRUE, rel=0.05)
    for trend, expected in ((named.before, exhibit.coefficient), (named.after, 0.0)):
        slope, sd = slope_of(trend)
        assert abs(slope - expected) < NEAR * sd
        assert sd < 0.05 * TRUE  # and that is sharp
        assert abs(trend.slope - expected) < NEAR * trend.sd
    assert named.before.slope > 20 * named.before.sd


@pytest.mark.long
def test_the_best_rival_is_shown_and_leaves_the_named_one_standing(exhibit: Exhibit) -> None:
    rival = exhibit.rival
    assert rival is not None
    assert rival.key != exhibit.named.key
    assert rival.before.slope > NEAR * rival.before.sd  # it imitates the leak
    assert abs(rival.after.slope) < 0.3 * rival.before.slope
    assert exhibit.instead > NEAR * exhibit.instead_sd


def test_the_picture_its_numbers_and_its_sentence_are_the_same(exhibit: Exhibit) -> None:
    (chart,) = charts_of([exhibit])
    named, rival = chart.panels[0]
    before, after = named.points
    np.testing.assert_allclose(before.y, exhibit.named.before.bins.mean_m3s[:, 0] * 6e4)
    np.testing.assert_allclose(before.x, exhibit.named.before.bins.centre * 1e-6)
    assert before.error is not None
    np.testing.assert_allclose(before.error, Z95 * exhibit.named.before.bins.error_m3s[:, 0] * 6e4)
    words = [points.note for points in (before, after, *rival.points)]
    assert all(word in chart.caption for word in words)
    assert chart.caption == caption(exhibit)
    assert "p_a - p_b in MPa" in named.x_label
    assert [row[-1] for row in table_of(chart).rows] == words


def test_nothing_named_nothing_shown(result: Result) -> None:
    assert exhibits(replace(result, found=())) == ()


@pytest.mark.slow
@pytest.mark.long
def test_a_supply_that_sags_has_its_evidence(tmp_path: Path) -> None:
    """What is found is at the supply's signal: a KeyError for whoever was told of it."""
    trace = tmp_path / "sag.parquet"
    plant = hide_wish(SimulatedPlant(), "supply_sag=middle")
    write_run(trace, simulate(plant, "rich_record", 0, 40.0), 0, "rich_record")
    result = Study(load(trace.with_suffix(".toml")), trace).diagnosed.result
    assert ("supply_sag", "p_supply") in [f.key for f in result.found]
    assert [e.named.key[0] for e in exhibits(result)] == [f.key[0] for f in result.found]
