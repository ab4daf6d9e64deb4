"""The noise of filtered signals is what it is, and that of others stays what it was."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from rtid.estimator.coloured import noise_in
from rtid.estimator.noise import estimate_noise
from rtid.plain import FloatArray

RATE_HZ, N = 1000.0, 30_000
SD = 5e3


def moving(kind: str, rate_hz: float = RATE_HZ) -> tuple[FloatArray, FloatArray]:
    """Times, s, and a pressure, Pa: at rest, slow, quick, or one that rings and rests by turns."""
    t = np.arange(N) / rate_hz
    slow = 1e7 + 3e6 * np.sin(2.0 * np.pi * 0.3 * t) + 1e6 * np.sin(2.0 * np.pi * 1.7 * t)
    if kind == "rests":
        return t, np.full(N, 1e7)
    if kind == "quick":
        return t, np.asarray(slow + 2e5 * np.sin(2.0 * np.pi * 12.0 * t) * np.sin(t))
    if kind == "rings":
        since = t % 2.0
        return t, np.asarray(slow + 1e6 * np.exp(-since / 0.1) * np.sin(2.0 * np.pi * 25.0 * since))
    return t, slow


def noise(order: int = 0, cut_hz: float = 80.0) -> FloatArray:
    """Noise of deviation SD behind a filter of some order, white without one."""
    white = np.random.default_rng(order).standard_normal(N)
    if order:
        white = lfilter(*butter(order, cut_hz / (0.5 * RATE_HZ)), white)
    return np.asarray(SD * white / white[1000:].std())


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0, 500.0, 1000.0])
@pytest.mark.parametrize("kind", ["rests", "slow", "quick", "rings"])
def test_white_noise_keeps_its_estimate(kind: str, rate_hz: float) -> None:
    t, p = moving(kind, rate_hz)
    for step in (0.0, 1e2, 1e4):
        y = p + noise()
        y = step * np.round(y / step) if step else y
        told = noise_in(t, y)
        assert told.noise == estimate_noise(t, y) and not told.is_filtered


@pytest.mark.parametrize("ripple_hz", [30.0, 60.0, 100.0, 150.0, 232.0, 300.0])
def test_a_pumps_ripple_is_no_filtered_noise(ripple_hz: float) -> None:
    t, p = moving("slow")
    ripple = 1e5 * np.sin(2.0 * np.pi * ripple_hz * t)
    assert not noise_in(t, p + ripple + noise()).is_filtered


@pytest.mark.parametrize("kind", ["rests", "slow", "quick", "rings"])
@pytest.mark.parametrize("cut_hz", [60.0, 80.0, 150.0])
def test_filtered_noise_is_told_with_its_filter(kind: str, cut_hz: float) -> None:
    """Differences of neighbours told a fiftieth to a sixteenth of it."""
    t, p = moving(kind)
    y = 10.0 * np.round((p + noise(2, cut_hz)) / 10.0)
    assert estimate_noise(t, y).sd < 0.1 * SD
    told = noise_in(t, y)
    assert told.is_filtered and told.noise.sd == pytest.approx(SD, rel=0.25)
    assert told.filtered_hz == pytest.approx(cut_hz, rel=0.25)


@pytest.mark.parametrize("order", [1, 3, 4])
def test_other_filters_are_told_about(order: int) -> None:
    t, p = moving("slow")
    told = noise_in(t, p + noise(order))
    assert told.noise.sd == pytest.approx(SD, rel=0.25)
    assert told.filtered_hz == 0.0 or 40.0 < told.filtered_hz < 170.0
