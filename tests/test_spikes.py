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
    gone = ~np.isin(measured.t_us, rest.t_us)
    assert gone[at[:, None] + np.arange(lasts)].all() and counts == {SPIKE: gone.sum()}
    assert gone.sum() <= 3 * (lasts + 2), "and a slope's next sample"
    assert np.array_equal(rest.values, measured.values[~gone])
    behind = np.append(False, gone[:-1])[~gone]
    assert np.array_equal(rest.flags, measured.flags[~gone] | np.where(behind, GAP, 0))


def test_a_sensor_that_drops_out_all_the_time_is_left_out_as_often(
    model: Machine, measured: Samples
) -> None:
    """1 % of its values: the first that go show what is usual, and the others follow."""
    rng, column = np.random.default_rng(0), measured.column("x").copy()
    out = rng.random(len(column)) < 0.01
    column[out] = -5e-3
    rest, _ = without_spikes(model, with_column(measured, "x", column))
    assert rest.column("x").min() > 0.0
    assert len(measured) - len(rest) < 2 * out.sum()


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


@pytest.mark.parametrize(("name", "gone"), [("x", [100]), ("p_a", [])])
def test_of_a_slow_logger_the_position_alone_is_judged(
    model: Machine, name: str, gone: list[int]
) -> None:
    """At 100 Hz a sample of a pressure may be a peak of the oil, two of a position are a motion."""
    t_us = 10_000 * np.arange(500)
    column = 5e6 + 1e6 * np.sin(2e-6 * t_us)
    column[100] = 0.0
    column[200:202] += 2e6
    flags = np.full(500, ROW, np.uint8)
    rest, _ = without_spikes(model, Samples((name,), t_us, column[:, None], flags))
    assert np.flatnonzero(~np.isin(t_us, rest.t_us)).tolist() == gone


def test_a_peak_on_lines_between_slow_messages_is_kept(model: Machine) -> None:
    """Instants of three messages at 100 Hz, 1 ms apart: one pressure stands in three of them."""
    t_us = (10_000 * np.arange(300)[:, None] + np.arange(0, 3000, 1000)).ravel()
    measured_us, pulse = 10_000 * np.arange(300), np.full(300, 5e6)
    pulse[50] = 8e6
    column = np.interp(t_us, measured_us, pulse)
    flags = np.full(len(t_us), ROW, np.uint8)
    assert without_spikes(model, Samples(("p_a",), t_us, column[:, None], flags))[1] == {}


@pytest.mark.parametrize("every", [1, 2])
def test_a_peak_of_the_oil_is_kept_and_a_spike_on_it_is_not(model: Machine, every: int) -> None:
    """A valve that shuts hard rings at 70 Hz in a record that is quiet else: 20 MPa for 12."""
    t_s = 1e-3 * np.arange(0, 20_000, every)
    since = t_s - 10.0
    ring = 5e6 * np.exp(-since / 0.03) * (1.0 - np.cos(440.0 * since))
    noise = 1e4 * np.random.default_rng(0).standard_normal(len(t_s))
    column = 12e6 + 1e6 * np.sin(t_s) + np.where(since > 0.0, ring, 0.0) + noise
    t_us, flags = np.round(1e6 * t_s).astype(np.int64), np.full(len(t_s), ROW, np.uint8)
    assert without_spikes(model, Samples(("p_a",), t_us, column[:, None], flags))[1] == {}
    top = int(np.argmax(column))
    column[top] = 0.0
    rest, counts = without_spikes(model, Samples(("p_a",), t_us, column[:, None], flags))
    assert t_us[top] not in rest.t_us and counts[SPIKE] < 12, "and what is left of that peak"


def test_what_has_ever_smaller_spikes_ends(model: Machine) -> None:
    """Each pass shows what is usual anew; a few of them are enough, whatever is left."""
    t_us = 1000 * np.arange(20_000)
    column = 5e6 + np.random.default_rng(0).standard_cauchy(20_000) ** 5
    flags = np.full(20_000, ROW, np.uint8)
    rest, _ = without_spikes(model, Samples(("p_a",), t_us, column[:, None], flags))
    assert len(rest) > 10_000


def test_too_few_to_know_what_is_usual(model: Machine, measured: Samples) -> None:
    few = measured.between(0.0, 0.05)
    column = few.column("p_a").copy()
    column[20] = 0.0
    assert without_spikes(model, with_column(few, "p_a", column))[1] == {}


def test_a_step_of_a_coarse_sensor_is_none(model: Machine) -> None:
    """A tank of 1 bar in steps of 0.1, which now and then is at the next one."""
    t_us = 1000 * np.arange(5000)
    column = np.full(5000, 98e3)
    column[np.arange(50, 5000, 400)] += 10e3
    coarse = replace(
        model, signals=tuple(replace(s, noise=0.0, resolution=10e3) for s in model.signals)
    )
    flags = np.full(5000, ROW, np.uint8)
    assert without_spikes(coarse, Samples(("p_a",), t_us, column[:, None], flags))[1] == {}
