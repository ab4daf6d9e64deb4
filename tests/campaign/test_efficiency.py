"""Variance of the estimator against generalised least squares: one plant; all by campaign."""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.efficiency import ratios
from tests.campaign.report import leave

NAMES = {
    "record": ("record path (refined weights)", "1.3", 1.3),
    "believed": ("record path, no block excused for missing the flow", "1.3", 1.3),
    "live": ("live path (nominal weights)", "2", 2.0),
    "windows": ("plain integral rows, windows of 1.5 s", "", np.inf),
    "carry": ("carry form, 50 rows/s", "", np.inf),
}


@pytest.fixture(scope="module")
def one_plant() -> dict[str, tuple[float, float]]:
    return ratios(0, 1500)


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(
            "record",
            marks=pytest.mark.xfail(
                strict=True,
                reason="1.44 on this plant: its coarse grid misses the flow in 6 of 64 blocks, and "
                "to excuse them costs variance that generalised least squares, which believes "
                "the model, does not pay; median over plants by campaign",
            ),
        ),
        *(form for form in NAMES if form != "record"),
    ],
)
def test_one_plant(one_plant: dict[str, tuple[float, float]], form: str) -> None:
    assert min(one_plant[form]) > 0.999, "nothing beats generalised least squares"
    assert max(one_plant[form]) <= NAMES[form][2]


@pytest.mark.campaign
def test_a_hundred_plants() -> None:
    plants = [ratios(seed) for seed in range(100)]
    for form, (name, must, limit) in NAMES.items():
        beta, values = np.array([plant[form] for plant in plants]).T
        assert min(beta.min(), values.min()) > 0.999
        medians = f"theta_beta {np.median(beta):.2f}, map {np.median(values):.2f}"
        leave(
            f"variance over that of generalised least squares, {name}",
            f"{medians} (worst theta_beta {beta.max():.2f})",
            must,
            f"{len(plants)} plants, 3 s of raw samples, medians",
        )
        assert max(np.median(beta), np.median(values)) <= limit
