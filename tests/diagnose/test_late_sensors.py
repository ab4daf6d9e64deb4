"""Sensors that come late are put right exactly, as delays of a command are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge.samples import GAP, ROW
from rtid.diagnose.commands import transformed
from rtid.diagnose.diagnosis import search
from rtid.diagnose.fit import Fit, one_pass, prepare
from rtid.diagnose.parts import AddedEffect, recall
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.revision import Revision
from rtid.diagnose.standing import fitted
from rtid.diagnose.summary import diagnosis
from rtid.effects.law import BOTH
from rtid.effects.laws.sensors import QUIET, ahead, quickened, sensor_timings
from rtid.study.seed import Seed
from tests.diagnose.records import noisy, record

DT_S = 1e-3
T_S = DT_S * np.arange(4000)


def test_a_late_signal_is_put_right_between_samples() -> None:
    wave = np.sin(2 * np.pi * 3 * T_S)
    late = np.sin(2 * np.pi * 3 * (T_S - 2.3e-3))
    assert np.abs(ahead(late, DT_S, (2.3e-3,)) - wave)[:-5].max() < 1e-3
    assert ahead(late, DT_S, (0.0,)) == pytest.approx(late)


@pytest.mark.parametrize("late_s", [0.0, 0.3e-3, 0.5e-3, 1.5e-3, 7.2e-3])
def test_a_part_of_a_sample_leaves_the_noise_as_it_is(late_s: float) -> None:
    """On the line between two samples it is half of it: any delay would explain the record."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, 100_000)
    moved = ahead(noise, DT_S, (late_s,))
    assert len(moved) == len(noise)
    assert moved.var() == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(moved[1:] * moved[:-1])) < 0.02, "still white"


@pytest.mark.parametrize("tau_s", [1e-3, 4e-3, 15e-3])
def test_a_slow_pressure_that_is_put_right_stays_quiet(tau_s: float) -> None:
    """P = P_meas + tau dP_meas/dt: exact but for the window, which grows with tau."""
    rate, inner = 2 * np.pi * 4.0, slice(50, -50)
    seen = np.sin(rate * T_S)
    right = seen + tau_s * rate * np.cos(rate * T_S)
    assert np.abs(quickened(seen, DT_S, (tau_s,)) - right)[inner].max() < 0.03 * tau_s * rate
    noise = noisy(np.random.default_rng(2), len(T_S))
    more = (quickened(noise, DT_S, (tau_s,)) - noise)[inner]
    assert 0.3 * QUIET < more.std() <= 1.05 * QUIET
    assert quickened(noise, DT_S, (0.0,)) == pytest.approx(noise)


def test_a_late_position_goes_on_at_its_ends_and_begins_anew_behind_a_gap() -> None:
    """Held constant there it stood still for as long as it was late, at either side of each gap."""
    model, chunk, _ = record()
    rows, late_s = chunk[:2000].copy(), 5e-3
    rows[1000:, 0] += 0.5
    rows[1000, 1] = float(int(rows[1000, 1]) | GAP)
    x = 2 + model.column(model.position)
    rows[:1000, x], rows[1000:, x] = 0.1 + 0.2 * rows[:1000, 0], 0.4 - 0.1 * rows[1000:, 0]
    (late,) = (t for t in sensor_timings(model) if t.where == model.position)
    put_right = transformed(model, rows, ((late, (late_s,)),))[:, x]
    slope = np.where(np.arange(2000) < 1000, 0.2, -0.1)
    assert put_right == pytest.approx(rows[:, x] + slope * late_s, abs=1e-9)


def test_a_late_position_that_comes_rarely_stands_where_it_was_measured() -> None:
    """On the line between two of them each row was a chord: 10 ms, each 20 ms, left 6.8 times the
    noise.
    """
    model, chunk, _ = record("position_sensor_delay", 10e-3)
    x, came = 2 + model.column(model.position), np.arange(0, len(chunk), 20)
    rows = chunk[: came[-1] + 1].copy()
    rows[:, x] = np.interp(np.arange(len(rows)), came, chunk[came, x])
    rows[:, 1] = rows[:, 1].astype(int) & ~ROW
    rows[came, 1] += ROW
    (late,) = (t for t in sensor_timings(model) if t.where == model.position)
    timings = ((late, (10e-3,)),)
    put_right = transformed(model, rows, timings)
    measured = np.flatnonzero(put_right[:, 1].astype(int) & ROW)
    assert measured.tolist() == (came[1:] - 10).tolist()
    assert put_right[measured, x] == pytest.approx(chunk[came[1:], x], abs=1e-9)
    weights = prepare(model, rows)
    assert one_pass(model, rows, weights, Revision((), timings), None, False).rho < 1.15


@pytest.mark.parametrize("off_s", [-3e-4, 3e-4])
def test_a_late_position_against_the_lag_has_the_slope_of_chi2(off_s: float) -> None:
    """Both together move the pressures alone: by the rates of 40 ms half of the slope was told."""
    late_s = 7e-3
    model, chunk, _ = record("position_sensor_delay", late_s)
    (law,) = (t for t in sensor_timings(model) if t.where == model.position)
    weights = prepare(model, chunk)

    def at(by_s: float) -> Fit:
        beside = replace(weights, lag_s=weights.lag_s + by_s)
        revision = Revision((), ((law, (late_s - by_s,)),))
        return one_pass(model, chunk, beside, revision, None, False, thorough=False)

    start, (ahead_, behind) = at(off_s), (at(off_s + way * 1e-4) for way in (1.0, -1.0))
    used, s = list(start.held.used), start.regression.s
    columns = [start.first_given, start.timing_columns(0)[0]]
    of_lag, of_position = -2.0 * (s[columns, 0] - s[np.ix_(columns, used)] @ start.held.theta)
    numeric = (ahead_.held.sse - behind.held.sse) / 2e-4
    assert of_lag - of_position == pytest.approx(numeric, rel=0.15)


def test_a_slow_signal_is_put_right_up_to_the_window() -> None:
    tau_s, wn = 4e-3, 2 * np.pi * 5
    wave, phase = np.sin(wn * T_S), np.arctan(wn * tau_s)
    slow = np.cos(phase) * np.sin(wn * T_S - phase)
    assert np.abs(quickened(slow, DT_S, (tau_s,)) - wave)[20:-20].max() < 5e-3


@pytest.mark.long
@pytest.mark.parametrize(
    ("effect", "strength"),
    [("position_sensor_delay", 1.5e-3), ("pressure_sensor_lag", 2e-3)],
)
def test_a_late_sensor_is_named_and_sized(effect: str, strength: float) -> None:
    """It was "spool lag", or nothing: its derivative alone is no measure of it."""
    said: Diagnosis = diagnosis(search(*record(effect, strength)))
    assert {own.effect for own in said.found} == {effect}
    if effect == "pressure_sensor_lag":  # one filter on both
        assert [own.where for own in said.found] == [BOTH]
    assert said.rho_before > 5.0 > 3.0 * said.rho_after
    for own in said.found:
        (value,) = own.parameters.values()
        assert value.value == pytest.approx(strength, rel=0.1)


def test_a_sensor_of_the_project_is_put_right_and_kept() -> None:
    """As `rtid add` leaves it in the project file, and as a later command takes it from `.rtid`."""
    model, chunk, _ = record()
    part = AddedEffect("position_sensor_delay", model.position, {"delay": 2e-3})
    laws = {timing.where: timing for timing in sensor_timings(model)}
    assert set(laws) == {model.position, *(chamber.name for chamber in model.chambers), BOTH}
    made = fitted(model, chunk[:15_000], (part,))
    ((timing, psi),) = made.revision.timings
    assert timing == laws[model.position] and 0.0 < psi[0] < 2e-3  # a sensor that is not late
    assert recall(model, chunk, made.weights, (part,)).timings == ((timing, (2e-3,)),)
    again = Seed.of(made).fit(made.declared, made.chunk)
    assert again.revision.timings == made.revision.timings
    assert again.rho == pytest.approx(made.rho, rel=1e-9)
