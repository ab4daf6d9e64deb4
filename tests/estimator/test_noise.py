"""Noise from the trace: simulated motion, the rig, held and merely quantised signals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.estimator.noise import estimate_noise, measurements, pooled, resolution_of
from rtid.plain import FloatArray
from rtid.sim.random_plants import draw
from rtid.sim.run import NAMES, Run, Sensors, simulate

T_S = np.linspace(0.0, 19.999, 20_000)


def motion(t: FloatArray) -> FloatArray:
    """Between -1 and 1, up to 2 Hz."""
    return np.asarray(0.6 * np.sin(2 * np.pi * 0.3 * t) + 0.4 * np.sin(2 * np.pi * 2.0 * t + 1))


def quantised(values: FloatArray, step: float) -> FloatArray:
    return np.asarray(np.floor(values / step + 0.5) * step)


def white(sd: float, seed: int = 0, n: int = len(T_S)) -> FloatArray:
    return sd * np.random.default_rng(seed).standard_normal(n)


def driven(kind: str, sensors: Sensors) -> Run:
    return simulate(draw(100), kind, 100, 20.0, sensors)


@pytest.mark.parametrize("kind", ["sweep", "rich"])
@pytest.mark.parametrize("p_noise_pa", [1e3, 5e3, 20e3, 50e3])
def test_simulated_motion(kind: str, p_noise_pa: float) -> None:
    """Within 5 % for every sensor; pressures from 1 to 50 kPa while the command steps."""
    sensors = replace(Sensors(), p_noise_pa=p_noise_pa)
    run = driven(kind, sensors)
    for j, name in enumerate(NAMES):
        found = estimate_noise(
            np.asarray(run.samples.t_us, float) / 1e6, run.samples.values[:, j], name == "u"
        )
        assert found.resolution == pytest.approx(sensors.resolution()[j], rel=1e-6)
        if name != "u":
            assert found.analogue_sd == pytest.approx(sensors.noise()[j], rel=0.05), name
            assert found.relative_sd < 0.05
            assert found.samples > 0.9 * len(run.samples)


def test_the_stated_uncertainty_holds() -> None:
    """Over many traces the error is as large as it says."""
    t = T_S[:3000]
    z = []
    for seed in range(60):
        found = estimate_noise(t, 100 * motion(t) + white(1.0, seed, len(t)))
        z.append((found.sd - 1) / found.relative_sd)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert abs(np.mean(z)) < 0.5


@pytest.mark.parametrize("run", ["rig_01", "rig_09", "rig_16"])
def test_rig(shared: Path, run: str) -> None:
    """Declared there: pressures 5 kPa (tank 1 kPa), x 10 um, v 1 mm/s, all of 16 bit."""
    table = pq.read_table(shared / "data" / "rig" / "measured" / f"{run}.parquet")
    t = table["t"].to_numpy()
    declared = {"p_A": (5e3, 1e7), "p_tank": (1e3, 1e7), "x": (1e-5, 0.5), "v": (1e-3, 1.0)}
    for name, (sd, full_range) in declared.items():
        step = full_range / 65535
        found = estimate_noise(t, table[name].to_numpy())
        assert found.resolution == pytest.approx(1.0)
        assert found.analogue_sd * step == pytest.approx(sd, rel=0.05), name


@pytest.mark.parametrize("hold", [2, 5, 20])
@pytest.mark.parametrize("jitter", [0, 1])
def test_repeats_of_a_slower_message_are_no_silence(hold: int, jitter: int) -> None:
    """Within 5 %, or within three of its own standard deviations where few samples are left.

    Jitter that the time stamps do not show makes noise of motion: here that is kept small.
    """
    starts = np.arange(0, len(T_S), hold)
    if hold > 2:
        starts = starts + np.random.default_rng(1).integers(-jitter, jitter + 1, len(starts))
    source = np.clip(np.searchsorted(starts, np.arange(len(T_S)), "right") - 1, 0, None)
    sampled = (2 * motion(T_S) + white(0.1))[np.clip(starts, 0, None)]
    found = estimate_noise(T_S, sampled[source])
    assert found.sd == pytest.approx(0.1, rel=max(0.05, 3 * found.relative_sd))
    assert found.samples <= len(T_S) // hold


def test_measurements_of_a_held_signal() -> None:
    values = np.repeat(np.random.default_rng(0).standard_normal(500), 4)
    t, y = measurements(T_S[:2000], values)
    np.testing.assert_array_equal(y, values[4::4][: len(y)])
    np.testing.assert_allclose(np.diff(t), 4e-3)


@pytest.mark.parametrize("step", [0.01, 0.1])
@pytest.mark.parametrize("rate_hz", [0.05, 0.3, 1.0])
def test_pure_quantisation(step: float, rate_hz: float) -> None:
    """The noise of a signal without noise is that of its steps."""
    found = estimate_noise(T_S, quantised(np.sin(2 * np.pi * rate_hz * T_S), step))
    assert found.resolution == pytest.approx(step)
    assert found.sd == pytest.approx(step / np.sqrt(12), rel=0.05)


@given(st.floats(0.35, 20), st.integers(0, 100))
@settings(max_examples=25, deadline=None)
def test_noise_above_a_third_of_a_step_is_seen_through_it(ratio: float, seed: int) -> None:
    """From there on quantisation adds step^2 / 12, below it hides the noise."""
    step = 0.01
    found = estimate_noise(T_S, quantised(motion(T_S) + white(ratio * step, seed), step))
    assert found.sd == pytest.approx(step * np.hypot(ratio, 12**-0.5), rel=0.05)


def test_noise_far_below_a_step_is_that_of_the_step() -> None:
    found = estimate_noise(T_S, quantised(motion(T_S) + white(1e-4), 0.01))
    assert found.sd == pytest.approx(0.01 / np.sqrt(12), rel=0.05)


@given(st.floats(1e-6, 1e3), st.floats(-1e3, 1e3), st.integers(0, 100))
@settings(max_examples=50, deadline=None)
def test_resolution_is_found_with_any_offset(step: float, offset: float, seed: int) -> None:
    counts = np.random.default_rng(seed).integers(-2000, 2000, 300)
    offset *= step  # a scale and an offset as a bus has them
    assert resolution_of(np.asarray(offset + step * counts, float)) == pytest.approx(step, rel=1e-6)


def test_a_continuous_signal_has_no_resolution() -> None:
    assert resolution_of(white(1.0)) == 0.0
    assert resolution_of(np.full(5, 3.0)) == 0.0


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("step", [5e-4, 1e-4, 1e-5])
def test_single_precision_keeps_the_resolution(step: float, noise: float) -> None:
    """Its values are off by up to 6e-8 of themselves, and Euclid ran down to nothing: x in steps
    of 0.5 mm had 22 um of noise for 144."""
    x = quantised(0.25 + 0.2 * motion(T_S) + white(noise * step), step)
    single = x.astype(np.float32)
    assert resolution_of(single.astype(np.float64)) == pytest.approx(step, rel=1e-6)
    assert estimate_noise(T_S, single).sd == pytest.approx(estimate_noise(T_S, x).sd, rel=1e-4)
    in_mm = 1e3 * single.astype(np.float64)  # what is read in another unit is no longer single
    assert resolution_of(in_mm) == pytest.approx(1e3 * step, rel=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_steps_that_are_written_with_few_decimals_are_seen_through_them(noise: float) -> None:
    """A pressure in steps of 6.1 kPa had a resolution of 100 Pa where it is written in 0.1 kPa."""
    step, times = 25e6 / 4096, np.linspace(0.0, 59.999, 60_000)
    pressure = quantised(8e6 + 3e6 * motion(times) + white(noise * step, n=60_000), step)
    assert resolution_of(quantised(pressure, 100.0)) == pytest.approx(step, rel=1e-4)


@pytest.mark.parametrize("n", [30, 300, 20_000])
@pytest.mark.parametrize("seed", range(5))
def test_rounding_makes_no_resolution_of_a_continuous_signal(n: int, seed: int) -> None:
    noise = 0.3 + 0.1 * white(1.0, seed, n)
    tiny = 1e-6 * float(np.abs(noise).max())
    assert resolution_of(noise) == 0.0
    assert resolution_of(noise.astype(np.float32).astype(np.float64)) < tiny
    assert resolution_of(quantised(noise, 1e-4)) == pytest.approx(1e-4)
    ramp = quantised(0.01234 * np.arange(n, dtype=np.float64), 1e-4)  # a speed is no resolution
    assert resolution_of(np.concatenate([ramp, ramp[::-1]])) == pytest.approx(1e-4)


def test_a_command_has_its_resolution_only() -> None:
    held = np.repeat(quantised(white(2.0, n=2000), 0.005), 10)
    found = estimate_noise(T_S, held, held_command=True)
    assert found.sd == pytest.approx(0.005 / np.sqrt(12))
    switched = np.where(motion(T_S) > 0, 5.0, -5.0)
    assert estimate_noise(T_S, switched, held_command=True).sd == 0.0


def test_steps_and_gaps_do_not_count() -> None:
    """A step of a hundred sigma every 0.1 s, gaps in time, and samples that are missing."""
    y = 10 * np.round(np.cumsum(np.arange(len(T_S)) % 100 == 0) % 7) + white(0.1)
    gaps = T_S + 0.5 * (np.arange(len(T_S)) // 777)
    y[5000:5040] = np.nan
    assert estimate_noise(gaps, y).sd == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("quiet", [0.0, 1e-6])
def test_a_standstill_without_noise_says_nothing_of_the_motion_s(quiet: float) -> None:
    values = np.sin(T_S) + white(1e-3, n=len(T_S))
    half = len(T_S) // 2
    values[half:] = values[half] + quiet * 1e-3 * white(1.0, n=len(T_S) - half)
    assert estimate_noise(T_S, values).sd == pytest.approx(1e-3, rel=0.05)


def test_where_nothing_is_known_it_says_so() -> None:
    assert estimate_noise(T_S[:20], white(1.0, n=20)).relative_sd == np.inf
    assert estimate_noise(T_S, np.zeros(len(T_S))).relative_sd == np.inf
    assert estimate_noise(T_S[:0], T_S[:0]).samples == 0


def test_records_of_one_sensor_are_pooled_by_what_they_measured() -> None:
    """Three records as one: the noise of all of it; one that tells nothing does not count."""
    t, y = T_S[:6000], 100 * motion(T_S[:6000]) + white(2.0, 4, 6000)
    parts = [
        estimate_noise(t[k], y[k]) for k in (slice(0, 1000), slice(1000, 3000), slice(3000, None))
    ]
    silent = estimate_noise(t[:3], y[:3])
    assert not np.isfinite(silent.relative_sd)
    found = pooled([*parts, silent])
    assert found.sd == pytest.approx(2.0, rel=3 * found.relative_sd)
    assert found.relative_sd < min(part.relative_sd for part in parts)
    assert found.samples == sum(part.samples for part in parts)
    assert pooled([parts[0]]) == parts[0]
