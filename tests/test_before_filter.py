"""The noise of a filtered sensor is told as it was before the filter, whatever its order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from rtid.estimator.coloured import Coloured
from rtid.sim.declare import declared_model
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.before_filter import _levels2, filter_of, noises_before
from rtid.trace.series import Series

RATE_HZ, SD, STEP = 1000.0, 5e3, 100.0
T_S = np.arange(60_000) / RATE_HZ


def behind(poles: int, cut_hz: float, hz: float) -> np.ndarray:
    """A pressure that swings at hz, noisy, filtered and rounded, Pa."""
    noise = np.random.default_rng(poles).normal(0.0, SD, len(T_S))
    values = 5e6 + 2e6 * np.sin(2 * np.pi * hz * T_S) + noise
    b, a = butter(poles, cut_hz / (0.5 * RATE_HZ))
    return np.asarray(STEP * np.round((5e6 + lfilter(b, a, values - 5e6)) / STEP))


def noises(**values: np.ndarray) -> dict[str, Coloured]:
    t_us = np.round(1e6 * T_S).astype(np.int64)
    series = [Series(name, t_us, value) for name, value in values.items()]
    return noises_before(declared_model(SimulatedPlant()), series)


@pytest.mark.parametrize("hz", [0.0, 0.5])
@pytest.mark.parametrize("poles,cut_hz", [(1, 60.0), (1, 100.0), (2, 60.0), (2, 100.0), (3, 100.0)])
def test_noise_poles_and_cut_off_are_told(poles: int, cut_hz: float, hz: float) -> None:
    """By what the filter has left healthy machines had 2.6 and 14 times their noise."""
    values = behind(poles, cut_hz, hz)
    told = noises(p_a=values)["p_a"]
    assert told.is_filtered
    assert told.noise.sd == pytest.approx(SD, rel=0.15)
    assert told.filtered_hz == pytest.approx(cut_hz, rel=0.1)
    low_pass = filter_of(_levels2(T_S, values, STEP**2 / 12.0))
    assert low_pass and low_pass.poles == poles


def test_white_noise_and_what_no_filter_has_made_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(0.0, SD, len(T_S))
    assert noises(p_a=white)["p_a"].noise.sd == pytest.approx(SD, rel=0.02)
    lines = np.interp(T_S, T_S[::5], white[::5])
    assert filter_of(_levels2(T_S, lines, 0.0)) is None


def test_where_motion_hides_it_the_filter_is_that_of_the_other_sensors() -> None:
    """One logger, one filter: a third of the variance was told, and 1.5 times the noise left."""
    hidden = behind(2, 60.0, 20.0)
    alone = noises(p_a=hidden)["p_a"]
    assert alone.is_filtered and not alone.filtered_hz and alone.noise.sd < 0.7 * SD
    told = noises(p_a=hidden, p_supply=behind(2, 60.0, 0.0))
    assert told["p_a"].noise.sd == pytest.approx(SD, rel=0.15)
    assert told["p_a"].filtered_hz == told["p_supply"].filtered_hz == pytest.approx(60.0, rel=0.1)
    white = np.random.default_rng(0).normal(0.0, SD, len(T_S))
    assert not noises(p_a=white, p_supply=behind(2, 60.0, 0.0))["p_a"].is_filtered
