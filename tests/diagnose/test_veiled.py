"""What a logger's filter may have left is no alarm."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from firmware_bridge.samples import ROW
from rtid.diagnose import verdict as verdicts
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT, MATCHES, UNKNOWN, filtered_hz, verdict
from rtid.sim.declare import declared_model
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.tell.diagnosed import said as said_of

N, RATE_HZ = 20_000, 1000.0


def fit(cut_hz: float, rho: float = 3.9, doubled: int = 1) -> Any:
    """What a verdict asks of a fit, on pressures of noise behind a filter; 0 Hz: behind none."""
    model, rng = declared_model(SimulatedPlant()), np.random.default_rng(0)
    values = rng.normal(0.0, 5e3, (N, len(model.signals)))
    if cut_hz:
        values = lfilter(*butter(2, cut_hz / (0.5 * RATE_HZ)), values, axis=0)
    if doubled > 1:  # on lines between messages
        at = np.arange(N)
        values = np.stack([np.interp(at, at[::doubled], v[::doubled]) for v in values.T], axis=1)
    chunk = np.column_stack([np.arange(N) / RATE_HZ, np.full(N, ROW), 5e6 + values])
    return SimpleNamespace(
        chunk=chunk, declared=model, rho=rho, most_rho=1.1, map=SimpleNamespace(cells=[1]),
        regression=SimpleNamespace(rows=10_000),
    )  # fmt: skip


def residual(share: float, map_sd_m3s: float = 0.0) -> Any:
    """Of a part that moves, with so much of its flow left beyond the noise."""
    return SimpleNamespace(
        t_s=np.zeros(1000), flow_m3s=1.0, floor_m3s=1e-4, rms_m3s=float(np.hypot(share, 1e-4)),
        map_sd_m3s=map_sd_m3s,
    )  # fmt: skip


def test_a_filter_of_the_logger_is_seen_and_lines_between_messages_are_none() -> None:
    assert filtered_hz(fit(60.0)) == pytest.approx(60.0, rel=0.1)
    assert filtered_hz(fit(0.0)) == 0.0
    assert filtered_hz(fit(0.0, doubled=2)) == 0.0


@pytest.mark.parametrize(
    "cut_hz,rho,share,said",
    [
        (60.0, 3.9, 1e-3, INSUFFICIENT),
        (60.0, 3.9, 1e-2, UNKNOWN),
        (60.0, 1.0, 1e-3, MATCHES),
        (0.0, 3.9, 1e-3, UNKNOWN),
    ],
)
def test_the_little_that_is_left_behind_a_filter_is_no_alarm(
    monkeypatch: pytest.MonkeyPatch, cut_hz: float, rho: float, share: float, said: str
) -> None:
    """A healthy machine behind 60 Hz was `unknown`, with 0.16 % of its flow left."""
    monkeypatch.setattr(verdicts, "saturated", lambda model, chunk: np.zeros(1, bool))
    state: Any = SimpleNamespace(found=[], judges_itself=False, negligible={})
    last = fit(cut_hz, rho)
    assert verdict(state, last, last, residual(share), ()) == said


@pytest.mark.parametrize(
    ("share", "is_unseen", "said"),
    [
        (1e-4, True, MATCHES),
        (2e-3, True, MATCHES),
        (9e-3, True, INSUFFICIENT),
        (9e-3, False, MATCHES),
    ],
)
def test_what_matches_alone_what_taught_it_is_no_match(
    share: float, is_unseen: bool, said: str
) -> None:
    """Six times the floor was left of unseen motion, "and no model could be much better"."""
    state: Any = SimpleNamespace(found=[], negligible={}, judges_itself=False)
    first = fit(0.0, 0.55)
    assert verdict(state, first, first, residual(share), (), is_unseen) == said


def test_what_maps_say_that_they_may_be_off_is_foretold() -> None:
    """A healthy machine of noisy pressures left 2.9 times the floor, and 1.05 times both."""
    state: Any = SimpleNamespace(found=[], negligible={}, judges_itself=False)
    first = fit(0.0, 0.55)
    assert verdict(state, first, first, residual(9e-3, 4.6e-3), ()) == MATCHES
    assert verdict(state, first, first, residual(9e-3, 4.4e-3), ()) == INSUFFICIENT


def test_advice_and_headline_ask_for_pressures_without_the_filter() -> None:
    """And not for more motion, which the record has."""
    shown = Diagnosis(
        INSUFFICIENT, (), (), 3.9, 3.9, 1e-7, 1e-7, 1e-7, 1e-4, (1e9, 1e9), 3e-3, 1e-4, True,
        True, (), (), (), filtered_hz=56.0,
    )  # fmt: skip
    assert "Next: log the pressures unfiltered" in said_of(shown) and "about 56 Hz" in said_of(
        shown
    )
    assert "record a minute" in said_of(replace(shown, filtered_hz=0.0))
