"""Sensors that are repeated in each row until they are sent anew are learned by what was sent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.repeated import REPEATED, rows_per_value, where_sent
from tests.checked import checked

SECONDS = 20.0
PRESSURES = ("p_a", "p_b", "p_supply")


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(SimulatedPlant(), "sweep", 0, SECONDS)


@pytest.fixture(scope="module")
def model(run: Run) -> Machine:
    return declared_model(run.plant)


def repeated(samples: Samples, rows: dict[str, int]) -> Samples:
    """The samples with some signals sent only every so many rows."""
    values = samples.values.copy()
    for name, every in rows.items():
        k = samples.names.index(name)
        values[:, k] = values[np.arange(len(values)) // every * every, k]
    return replace(samples, values=values)


def test_rows_are_where_a_repeated_position_is_sent(run: Run, model: Machine) -> None:
    written = repeated(run.samples, {"x": 4})
    flags = written.flags.copy()
    flags[8000] |= GAP
    by, lost = where_sent(model, replace(written, flags=flags))
    rows = np.flatnonzero(by.flags & ROW)
    assert np.all(rows % 4 == 0) and len(rows) > 0.99 * len(written) / 4
    assert lost == len(written) - len(rows) and 8000 not in rows and by.flags[8000] & GAP
    assert np.array_equal(by.column("x")[rows], run.samples.column("x")[rows])
    noise = model.signals[model.column("x")].noise
    assert np.std(by.column("x") - run.samples.column("x")) < 2.0 * noise
    assert np.array_equal(by.column("p_a"), run.samples.column("p_a"))


def test_of_several_the_one_that_comes_least_has_the_rows(run: Run, model: Machine) -> None:
    by, _ = where_sent(model, repeated(run.samples, {"x": 2, "p_a": 5, "p_b": 5, "p_supply": 50}))
    rows = np.flatnonzero(by.flags & ROW)
    assert np.all(rows % 5 == 0) and len(rows) > 0.99 * len(by) / 5
    assert np.array_equal(by.column("p_a")[rows], run.samples.column("p_a")[rows])


def at_rest(x: FloatArray) -> FloatArray:
    """A position that rests for half of each two seconds, without a noise."""
    rests = (np.arange(len(x)) // 1000) % 2 == 1
    return np.where(rests, x[np.arange(len(x)) // 1000 * 1000], x)


@pytest.mark.parametrize("step_m", [0.0, 1e-6, 1e-4, 5e-4, 2e-3])
def test_what_rests_or_is_coarse_is_not_repeated(run: Run, step_m: float) -> None:
    ramp = 0.2 + 0.15 * np.abs((np.arange(20_000) / 5000.0) % 2.0 - 1.0)  # one length of all runs
    for x in (run.samples.column("x"), at_rest(run.samples.column("x")), ramp):
        coarse = step_m * np.round(x / step_m) if step_m else x
        assert rows_per_value(coarse) == 1.0
        assert rows_per_value(np.full(len(x), 0.2)) == 1.0


def test_one_that_rests_is_seen_to_be_repeated_and_sent_meanwhile(run: Run, model: Machine) -> None:
    values = run.samples.values.copy()
    k = run.samples.names.index("x")
    values[:, k] = 1e-5 * np.round(at_rest(values[:, k]) / 1e-5)
    by, _ = where_sent(model, repeated(replace(run.samples, values=values), {"x": 4}))
    assert np.diff(np.flatnonzero(by.flags & ROW)).max() <= 8


@pytest.mark.parametrize(
    ("names", "rows", "most"),  # what a line over 5 ms of oil misses is left
    [(("x",), 4, 1.1), (PRESSURES, 5, 1.2), (("x", *PRESSURES), 4, 1.1)],
)
def test_a_healthy_machine_leaves_its_noise(
    run: Run, tmp_path: Path, names: tuple[str, ...], rows: int, most: float
) -> None:
    """Repeats left 2.8 to 4.0 times the noise, and such machines were unknown."""
    written = repeated(run.samples, dict.fromkeys(names, rows))
    study, report = checked(run, written, tmp_path)
    said = {f.subject: f.text for f in report.findings if "repeated" in f.text}
    assert said == dict.fromkeys(
        names, f"is sent every {rows} ms and repeated: rows where it changes"
    )
    assert report.refused[REPEATED] > 0.7 * len(written)
    assert 0.9 < study.fitted.rho < most
    assert 1.0 / study.fitted.compliance == pytest.approx(run.plant.beta_pa, rel=0.02)


def test_a_lost_message_is_no_value_that_came_again(run: Run, model: Machine) -> None:
    """Its repeats as rows left 15 times the noise."""
    every = np.arange(len(run.samples)) // 4 * 4
    is_lost = np.random.default_rng(0).random(len(every)) < 0.03
    every = np.where(is_lost[every] & (every >= 4), every - 4, every)
    values, k = run.samples.values.copy(), run.samples.names.index("x")
    values[:, k] = values[every, k]
    by, _ = where_sent(model, replace(run.samples, values=values))
    rows = np.flatnonzero(by.flags & ROW)
    error = by.column("x")[rows] - run.samples.column("x")[rows]
    sd = model.signals[model.column("x")].noise
    assert len(rows) > 0.95 * len(every) / 4 and np.mean(np.abs(error) > 5.0 * sd) < 2e-3
