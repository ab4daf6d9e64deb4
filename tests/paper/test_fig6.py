"""Fig. 6 of the paper: one controller, three maps."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.paper.boom import boom
from rtid.paper.fig6 import compare, machines, manufacturer, point_to_point
from rtid.paper.fig6_picture import CALIBRATED, ESTIMATED, MANUFACTURER, Compared
from rtid.sim.plant import FloatArray
from rtid.sim.robust import W_V, knowledge, opening, run

NUMBER = 1002


@pytest.fixture(scope="module")
def found() -> Compared:
    return compare(NUMBER)


def test_the_reference_is_smooth_and_starts_and_ends_at_rest() -> None:
    plant = boom(NUMBER)
    reference = point_to_point(plant)
    assert 0 < reference[:, 0].min() < reference[:, 0].max() < plant.constants.stroke_m
    for k in range(2):
        slope = np.gradient(reference[:, k], 1e-3)
        scale = np.abs(reference[:, k + 1]).max()
        np.testing.assert_allclose(slope[2:-2], reference[2:-2, k + 1], atol=0.02 * scale)
    assert (reference[[0, -1], 1:] == 0).all()


def test_opening_inverts_a_map() -> None:
    plant = boom()
    known = knowledge(plant, plant.flow)
    for w, dp in ((2.3, 3e6), (5.0, 1e6), (8.0, 6.2e6)):
        q = float(plant.flow("pa", w, dp))
        assert opening(known.maps[0], known.w_v, known.dp_pa, q, dp) == pytest.approx(w, abs=0.01)
    assert opening(known.maps[0], known.w_v, known.dp_pa, 1.0, 1e6) == W_V[-1]


def test_the_controller_follows_with_the_true_map() -> None:
    plant = boom()
    reference = point_to_point(plant)
    tracked = run(plant, plant.flow, reference, 1)
    assert tracked.rms_m < 1e-3 * np.ptp(reference[:, 0]) * 3
    assert tracked.energy_j > 0
    assert tracked.pressures_pa.min() > 0
    again = run(plant, plant.flow, reference, 1)
    np.testing.assert_array_equal(again.error_m, tracked.error_m)


def test_the_data_sheet_is_wrong_within_its_bounds() -> None:
    plant = boom(NUMBER)
    sheet = manufacturer(plant, NUMBER)
    w, dp = np.linspace(0, 9, 901), np.full(901, 1e6)
    for edge, valve in zip(plant.edges, plant.valves, strict=False):
        opens_v = w[np.argmax(sheet(edge, w, dp) > 0)]
        assert abs(opens_v - valve.deadband_v) < 0.3 + valve.corner_v


def test_estimated_is_near_calibrated_and_far_from_the_data_sheet(found: Compared) -> None:
    rms = {kind: tracked.rms_m for kind, tracked in found.runs.items()}
    assert found.ratio < 1.3
    assert rms[CALIBRATED] < 1e-3
    assert rms[MANUFACTURER] > 5 * rms[ESTIMATED]


@pytest.fixture(scope="module")
def thirty() -> FloatArray:
    """Tracking errors (30, 3): calibrated, estimated, manufacturer's."""
    return np.array([[r.rms_m for r in c.runs.values()] for c in machines(30)])


@pytest.mark.campaign
def test_estimated_beats_the_data_sheet_on_thirty_booms(thirty: FloatArray) -> None:
    assert np.mean(thirty[:, 1] < thirty[:, 2]) >= 0.9


@pytest.mark.campaign
@pytest.mark.xfail(strict=True, reason="measured 1.11: the moves go where the sweep has not been")
def test_median_ratio_to_calibrated(thirty: FloatArray) -> None:
    assert np.median(thirty[:, 1] / thirty[:, 0]) <= 1.05


@pytest.mark.campaign
@pytest.mark.xfail(strict=True, reason="measured 73 %: on the others noise puts estimated first")
def test_calibrated_is_first(thirty: FloatArray) -> None:
    in_order = (thirty[:, 0] <= thirty[:, 1]) & (thirty[:, 1] < thirty[:, 2])
    assert np.mean(in_order) >= 0.9
