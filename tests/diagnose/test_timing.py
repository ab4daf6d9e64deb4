"""What reaches the spool: exact for a held command, in units, limits and sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rtid.effects.laws import timing
from rtid.effects.laws.timing import (
    TIMINGS,
    delayed,
    lagged,
    played,
    rate_limited,
    second_order,
    timings_of,
)
from rtid.model import Machine
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw

DT = 1e-3


def steps(seed: int, n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-5, 5, n // 20), 20)


def test_a_delay_of_whole_samples_shifts() -> None:
    u = steps(1)
    assert delayed(u, DT, (0.007,))[7:] == pytest.approx(u[:-7])


@given(st.floats(0.0, 0.02))
def test_a_delay_passes_the_mean_on(tau: float) -> None:
    """The area under a pulse stays what it was, wherever within a sample the delay ends."""
    u = np.zeros(200)
    u[50:60] = 1.0
    assert delayed(u, DT, (tau,)).sum() == pytest.approx(10.0, rel=1e-9)


def exact_mean(rate: Callable[..., list[float]], u: np.ndarray, start: list[float]) -> np.ndarray:
    """Means over each interval of the first state of a system driven by a held command."""
    y, means = np.array(start), []
    for value in u:
        done = solve_ivp(rate, (0, DT), np.append(y, 0.0), args=(value,), rtol=1e-9, atol=1e-12)
        y = done.y[:-1, -1]
        means.append(done.y[-1, -1] / DT)
    return np.array(means)


def test_a_lag_is_exact() -> None:
    u, tau = steps(2, 100), 4e-3
    expected = exact_mean(lambda t, y, v: [(v - y[0]) / tau, y[0]], u, [u[0]])
    assert lagged(u, DT, (tau,)) == pytest.approx(expected, abs=1e-6)


def test_a_second_order_spool() -> None:
    """Means by the trapezoid: its error is (wn dt)^2 / 12 of a step."""
    u, wn, zeta = steps(3, 100), 200.0, 0.7
    expected = exact_mean(
        lambda t, y, v: [y[1], wn * wn * (v - y[0]) - 2 * zeta * wn * y[1], y[0]], u, [u[0], 0.0]
    )
    error = np.abs(second_order(u, DT, (wn, zeta)) - expected)[:-1]
    assert error.max() < 1.1 * (wn * DT) ** 2 / 12 * np.ptp(u)


@pytest.mark.parametrize("tau", [1e-3, 4e-3])
@pytest.mark.parametrize("rate", [60.0, 500.0])
def test_a_limit_is_exact(rate: float, tau: float) -> None:
    """ds/dt = clip((u - s) / tau, -r, r); without a lag s stays at u once it has come there."""
    u, fine = steps(4, 100), 200
    expected, at = np.empty(len(u)), u[0]
    for k, value in enumerate(u):
        passed = 0.0
        for _ in range(fine):
            before, h = at, DT / fine
            middle = at + 0.5 * h * np.clip((value - at) / tau, -rate, rate)
            at += h * np.clip((value - middle) / tau, -rate, rate)
            passed += 0.5 * (before + at) / fine
        expected[k] = passed
    assert rate_limited(u, DT, (rate, tau)) == pytest.approx(expected, abs=1e-3 * rate * DT)
    timing._follow.py_func(u, DT, rate, tau, out := np.empty(len(u)))
    assert out == pytest.approx(rate_limited(u, DT, (rate, tau)), abs=1e-12)
    assert rate_limited(u, DT, (rate, 1e-9)) == pytest.approx(rate_limited(u, DT, (rate,)))


def test_a_limit_that_no_command_outruns_does_nothing() -> None:
    u = np.cumsum(np.full(300, 0.02))  # 20 V/s
    assert np.abs(rate_limited(u, DT, (20.1,)) - u).max() < 0.5 * 0.02 + 1e-12
    late = u[-1] - rate_limited(u, DT, (10.0,))[-1]
    assert late == pytest.approx(299 * 0.01, rel=0.01)


@given(st.integers(0, 1000), st.floats(0.0, 2.0))
def test_play_stays_within_half_its_width(seed: int, width: float) -> None:
    u = steps(seed)
    out = played(u, DT, (width,))
    assert np.abs(out - u).max() <= 0.5 * width + 1e-12
    assert np.array_equal(timing._play.py_func(u, 0.5 * width, w := np.empty(len(u))) or w, out)


@pytest.mark.parametrize("effect", TIMINGS, ids=lambda t: f"{t.effect}{t.own_spools}")
def test_nothing_is_left_of_the_command_s_steady_value(effect: timing.TimingLaw) -> None:
    """A constant command reaches the spool unchanged; valves of their own rest at zero."""
    u = np.full(300, 2.0)
    psi = effect.bank[0]
    assert effect.on(u, 1, DT, psi) == pytest.approx(u, abs=1e-9)
    assert effect.on(u, -1, DT, psi) == pytest.approx(0 * u if effect.own_spools else u, abs=1e-9)


@pytest.mark.parametrize("effect", TIMINGS, ids=lambda t: f"{t.effect}{t.own_spools}")
def test_derivatives_point_the_way(effect: timing.TimingLaw) -> None:
    """A small step of each parameter changes the command as its derivative says.

    Behind an opening curve where the valve is open: a shut one passes nothing wherever it is.
    """
    u, psi = np.cumsum(steps(5)) / 50, effect.bank[1]
    shut_v = psi[-1] if timing.DEAD_BAND in effect.parameters else -1.0
    for k, value in enumerate(psi):
        moved = list(psi)
        moved[k] = 1.01 * value
        there, here = (effect.on(u, 1, DT, tuple(at)) for at in (moved, psi))
        is_open = np.minimum(np.abs(there), np.abs(here)) > 1.02 * shut_v
        change = (there - here)[is_open]
        slope = effect.change(u, 1, DT, psi, k)[is_open] * 0.01 * value
        most = 0.5 if effect.is_limit else 0.25  # of what begins and ends with a sample
        assert np.linalg.norm(change - slope) < most * np.linalg.norm(change) + 1e-9


def commanded(largest: float) -> Machine:
    """A machine whose commands go so far, in whatever unit."""
    model = declared_model(draw(0))
    by = largest / max(edge.grid.u_v[-1] for edge in model.edges)
    grids = [replace(edge.grid, u_v=by * edge.grid.u_v) for edge in model.edges]
    edges = [replace(e, grid=g) for e, g in zip(model.edges, grids, strict=True)]
    return replace(model, edges=tuple(edges))


def at_rest(model: Machine) -> np.ndarray:
    """A record (9, 2 + signals) in which nothing is commanded."""
    chunk = np.zeros((9, 2 + len(model.signals)))
    chunk[:, 0] = DT * np.arange(9)
    return chunk


@pytest.mark.parametrize("largest", [0.02, 0.7, 1.0, 100.0, 700.0])
def test_what_is_in_the_command_s_unit_is_looked_for_in_shares_of_its_span(largest: float) -> None:
    """A play of 3 % of +-100 % is 3: the bound was there, and the bank ended at 0.6."""
    by, model = largest / 10.0, commanded(largest)
    for usual, here in zip(TIMINGS, timings_of(model, at_rest(model)), strict=True):
        for k, unit in enumerate(usual.units):
            times = by if unit in ("V", "V/s") else 1.0
            banks = [psi[k] for psi in usual.bank], [psi[k] for psi in here.bank]
            assert banks[1] == pytest.approx([times * value for value in banks[0]])
            assert here.low[k] == pytest.approx(times * usual.low[k])
            assert here.high[k] == pytest.approx(times * usual.high[k])


@pytest.mark.parametrize("largest", [6.0, 9.7, 10.0, 12.0])
def test_of_some_ten_volts_the_banks_are_those_of_the_pages(largest: float) -> None:
    model = commanded(largest)
    assert timings_of(model, at_rest(model)) == TIMINGS


def test_a_limit_is_looked_for_where_the_command_outruns_it() -> None:
    """A ramp of 30 V/s for 0.1 s: for 12 ms it goes on at 30 V/s, for 0.19 s at half of that."""
    model = commanded(10.0)
    chunk = np.zeros((500, 2 + len(model.signals)))
    chunk[:, 0] = DT * np.arange(500)
    chunk[:, 2 + model.column(model.edges[0].command)] = np.clip(30.0 * chunk[:, 0] - 6, 0.0, 3.0)
    limit = next(t for t in timings_of(model, chunk) if t.is_limit)
    rates = [psi[0] for psi in limit.bank]
    assert rates == sorted(rates) and rates[-1] == pytest.approx(30.0, rel=1e-6)
    assert any(rate == pytest.approx(3.0 / 0.19, rel=1e-6) for rate in rates)
