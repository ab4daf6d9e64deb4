"""Spools of their own come to rest shut, and a slow pressure is put right without much noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.effects.laws.sensors import QUIET, quickened
from rtid.effects.laws.timing import SHUT, TIMINGS, TimingLaw, lagged
from tests.diagnose.records import noisy

DT_S = 1e-3
OWN = [t for t in TIMINGS if t.own_spools]


def to_and_fro(most: float) -> np.ndarray:
    """A command (n,) of 0.2 s to one side, 0.2 s at rest, 0.2 s to the other side, and rest."""
    return np.repeat(most * np.array([0.0, 1.0, 0.0, -0.5, 0.0]), 200)


@pytest.mark.parametrize("most", [8.0, 1.0, 800.0])
@pytest.mark.parametrize("timing", OWN, ids=lambda t: f"{t.effect}-{len(t.parameters)}")
def test_a_spool_of_its_own_comes_to_rest_shut(timing: TimingLaw, most: float) -> None:
    """In volts, as a share or in mA; what fades for ever has a map that gives any flow of dp."""
    psi = (300.0, 0.8) if timing.is_rate else (2e-3, 0.1 * most)[: len(timing.bank[0])]
    u = to_and_fro(most)
    out, other = (timing.on(u, direction, DT_S, psi) for direction in (1, -1))
    at_rest = np.r_[0:200, 440:1000]
    assert not out[at_rest].any() and np.abs(out[200:400]).max() > 0.9 * most
    assert not other[:600].any()
    again = timing.on(u / most, 1, DT_S, (psi[0], *(x / most for x in psi[1:])))
    if not timing.is_rate:
        assert again * most == pytest.approx(out, abs=1e-9 * most), "whatever its unit is"


def test_what_is_open_is_what_it_was() -> None:
    timing = next(t for t in OWN if t.apply is lagged)
    u = to_and_fro(8.0)
    out, plain = timing.on(u, 1, DT_S, (2e-3,)), lagged(np.maximum(u, 0.0), DT_S, (2e-3,))
    is_open = plain > 2.0 * SHUT * 8.0
    assert np.array_equal(out[is_open], plain[is_open])
    assert not timing.on(0.0 * u, 1, DT_S, (2e-3,)).any(), "nothing to shut"
    assert replace(timing, own_spools=False).on(u, 1, DT_S, (2e-3,))[590] > 0.0


@pytest.mark.parametrize("tau_s", [1e-3, 4e-3, 15e-3])
def test_a_slow_pressure_is_put_right_and_stays_quiet(tau_s: float) -> None:
    """P = P_meas + tau dP_meas/dt: exact but for the window, which grows with tau."""
    t = DT_S * np.arange(4000)
    rate = 2 * np.pi * 4.0
    seen = np.sin(rate * t)
    right = seen + tau_s * rate * np.cos(rate * t)
    inner = slice(50, -50)
    assert np.abs(quickened(seen, DT_S, (tau_s,)) - right)[inner].max() < 0.03 * tau_s * rate
    noise = noisy(np.random.default_rng(2), len(t))
    more = (quickened(noise, DT_S, (tau_s,)) - noise)[inner]
    assert 0.3 * QUIET < more.std() <= 1.05 * QUIET
    assert quickened(noise, DT_S, (0.0,)) == pytest.approx(noise)
