"""Variance of the estimator against generalised least squares: one plant; all by campaign."""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.efficiency import ratios
from tests.campaign.report import leave

NAMES = {
    "record": ("record path (refined weights)", "1.3", 1.3),
    "live": ("live path (nominal weights)", "2", 2.0),
    "windows": ("plain integral rows, windows of 1.5 s", "", np.inf),
    "carry": ("carry form, 50 rows/s", "", np.inf),
}


def test_one_plant() -> None:
    found = ratios(0, 1500)
    for form, (_, _, limit) in NAMES.items():
        assert min(found[form]) > 0.999, "nothing beats generalised least squares"
        assert max(found[form]) <= limit


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
