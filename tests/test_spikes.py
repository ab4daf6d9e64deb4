"""Samples in which a sensor jumps away and back are left out; what oil and pistons do is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate
from rtid.trace.spikes import SPIKE, without_spikes

SEED, SECONDS = 3, 4.0


@pytest.fixture(scope="module")
def model() -> Machine:
    return declared_model(draw(SEED))


@pytest.fixture(scope="module")
def measured() -> Samples:
    return simulate(draw(SEED), "rich", SEED, SECONDS).samples


def with_column(samples: Samples, name: str, column: FloatArray) -> Samples:
    values = samples.values.copy()
    values[:, samples.names.index(name)] = column
    return replace(samples, values=values)


@pytest.mark.parametrize("name", ["p_a", "x"])
@pytest.mark.parametrize("lasts", [1, 2, 3])
@pytest.mark.parametrize("reads", [0.0, 3.0])
def test_a_sensor_that_drops_out_costs_its_own_samples_alone(
    model: Machine, measured: Samples, name: str, lasts: int, reads: float
) -> None:
    """Nothing at all, or three times what it was: a plug that shakes."""
    column, at = measured.column(name).copy(), np.array([700, 1900, 3000])
    for k in range(lasts):
        column[at + k] *= reads
    rest, counts = without_spikes(model, with_column(measured, name, column))
    assert counts == {SPIKE: 3 * lasts}
    gone = np.isin(np.arange(len(measured)), at[:, None] + np.arange(lasts))
    assert np.array_equal(rest.values, measured.values[~gone])
    behind = np.isin(rest.t_us, measured.t_us[at + lasts])
    assert np.array_equal(rest.flags, measured.flags[~gone] | np.where(behind, GAP, 0))


@pytest.mark.parametrize("motion", ["rich", "sweep"])
@pytest.mark.parametrize("seed", range(4))
def test_what_a_machine_does_is_kept(motion: str, seed: int) -> None:
    plant = draw(seed)
    samples = simulate(plant, motion, seed, SECONDS).samples
    for every in (1, 2, 5, 10):  # and a slower logger
        slower = Samples(
            samples.names,
            samples.t_us[::every],
            samples.values[::every],
            (samples.flags[::every] | ROW).astype(np.uint8),
        )
        assert without_spikes(declared_model(plant), slower)[1] == {}


@given(
    steps=st.lists(st.floats(-1e7, 1e7), min_size=1, max_size=8),
    lasts=st.integers(4, 40),
    sd=st.floats(0.0, 1e5),
)
def test_steps_and_pulses_of_more_than_three_samples_are_kept(
    steps: list[float], lasts: int, sd: float
) -> None:
    """Whatever the noise, which the model may not know."""
    model, rng = declared_model(draw(SEED)), np.random.default_rng(0)
    n = max(400, lasts * (len(steps) + 2))
    column = 5e6 + sd * rng.standard_normal(n)
    for k, height in enumerate(steps):
        column[(k + 1) * lasts : (k + 2) * lasts] += height
    t_us, flags = 1000 * np.arange(n), np.full(n, ROW, np.uint8)
    samples = Samples(("p_a",), t_us, column[:, None], flags)
    assert without_spikes(model, samples)[1] == {}


def test_a_slow_logger_may_lose_one_sample_at_a_time(model: Machine) -> None:
    """At 100 Hz a pulse of two samples is a pulse of oil."""
    t_us = 10_000 * np.arange(500)
    column = 5e6 + 1e6 * np.sin(2e-6 * t_us)
    column[100] = 0.0
    column[200:202] += 2e6
    flags = np.full(500, ROW, np.uint8)
    rest, counts = without_spikes(model, Samples(("p_a",), t_us, column[:, None], flags))
    assert counts == {SPIKE: 1} and 100 * 10_000 not in rest.t_us


def test_too_few_to_know_what_is_usual(model: Machine, measured: Samples) -> None:
    few = measured.between(0.0, 0.05)
    column = few.column("p_a").copy()
    column[20] = 0.0
    assert without_spikes(model, with_column(few, "p_a", column))[1] == {}
