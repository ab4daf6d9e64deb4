"""The cases of `tests.estimator.test_hard_cases` and `test_float32` at full length."""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.report import leave
from tests.estimator.corner import FIRST_SEED, fits
from tests.estimator.rivals import RIVALS
from tests.estimator.standstill import COARSE, WAYS, stand, stand_rival
from tests.estimator.test_float32 import WRONG, added_up

TEN_HOURS_S = 36_000.0


@pytest.mark.campaign
@pytest.mark.parametrize("forget_s", [60.0, 600.0])
@pytest.mark.parametrize("way", WAYS)
def test_ten_hours_of_standstill(way: str, forget_s: float) -> None:
    found = stand(way, TEN_HOURS_S, forget_s, COARSE)
    leave(
        f"10 h standstill, {way}, forgetting in {forget_s:g} s",
        str(found),
        "definite, finite, map < 1 %",
        f"{found.samples} samples at 100 Hz, 24 blocks per edge",
    )
    assert found.finite
    assert found.lowest > 0
    assert found.drift < 0.01


@pytest.mark.campaign
@pytest.mark.parametrize("way", WAYS)
def test_ten_hours_of_standstill_on_the_default_grid(way: str) -> None:
    found = stand(way, TEN_HOURS_S, 60.0, None)
    leave(
        f"10 h standstill, {way}, default grid",
        str(found),
        "definite, finite, map < 1 %",
        f"{found.samples} samples at 100 Hz, forgetting in 60 s",
    )
    assert found.finite
    assert found.lowest > 0
    assert found.drift < 0.01


@pytest.mark.campaign
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("way", WAYS)
def test_the_same_standstill_in_other_libraries(way: str) -> None:
    """Samples of standstill after which the covariance is indefinite, and the map worth nothing."""
    lost = {name: stand_rival(rival, way, 100_000) for name, rival in RIVALS.items()}
    figure = "; ".join(f"{n} {x.indefinite} / {x.wrong}" for n, x in lost.items())
    leave(f"standstill, {way}: samples to indefinite / to no map", figure, "", "lambda 0.999")
    assert all(loss.indefinite is not None for loss in lost.values())


@pytest.mark.campaign
@pytest.mark.parametrize("motion", ["rich", "sweep"])
def test_corner_of_the_dead_band(motion: str) -> None:
    found = fits(range(FIRST_SEED, FIRST_SEED + 40), motion)
    leave(
        f"coarse block at the dead band's corner, {motion}",
        f"{found}; beta known to 5 % in {len(found.identified)} of {len(found.error)} cases",
        "within 2 sd, within 5 % where known so well",
        f"{len(found.lag_error_s)} plants, 15 s",
    )
    assert np.abs(found.identified).max() < 0.05
    assert found.covered >= 0.93


@pytest.mark.campaign
def test_a_hundred_million_rows_in_single_precision() -> None:
    single, double = (added_up(dtype, 100_000_000) for dtype in (np.float32, np.float64))
    state = "not definite" if single.error == np.inf else f"off by {single.error:.1e}"
    figure = f"float32 {state}, float64 off by {double.error:.1e}"
    leave("1e8 rows summed in single precision", figure, "float64 1e-6", "condition number 3.5e3")
    assert single.error > WRONG
    assert double.error < 1e-6
