"""Whether quick says what it found with a command held, or with one on the line between samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_bridge.samples import ROW, Samples
from rtid.diagnose.fit import fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import TIE
from rtid.effects import effect
from rtid.effects.column import of_page
from rtid.plain import FloatArray
from rtid.study.quick_command import (
    between_rows,
    hidden_s,
    is_taken,
    not_told,
    rows_apart_s,
    wins,
)
from rtid.study.quick_machine import LAG_SHARE, Assumption, lag_of
from tests.diagnose.records import record


@dataclass(frozen=True)
class Said:
    """What is told of a lag, s."""

    lag_s: float
    lag_sd_s: float


def said(verdict: str, n: int = 0, rho: float = 1.0) -> Any:
    return SimpleNamespace(verdict=verdict, found=[None] * n, rho_after=rho)


@pytest.mark.parametrize(
    ("line", "first", "is_so"),
    [
        (said("matches"), said("unknown"), True),
        (said("insufficient_data"), said("unknown"), True),
        (said("matches"), said("missing", 1), True),
        (said("unknown"), said("missing", 1), False),  # it says less
        (said("missing", 2, 0.9), said("missing", 1), False),  # it names more
        (said("ambiguous", 1, 0.86), said("missing", 1, 0.84), True),  # neither leaves but noise
        (said("ambiguous", 1, 1.3), said("missing", 1, 1.2), False),
        (said("unknown", rho=49.0), said("unknown", rho=8.0), False),
        (said("unknown", rho=3.0), said("unknown", rho=8.0), True),
    ],
)
def test_what_is_said_in_place_of_the_first(line: Any, first: Any, is_so: bool) -> None:
    assert is_taken(line, first) is is_so


@pytest.mark.parametrize("lag_s", [1.3e-3, 0.0])
def test_a_line_is_late_by_anything_from_nothing_to_half_a_step(lag_s: float) -> None:
    """Its mean and standard deviation are those of what is drawn."""
    step_s, rng = 20e-3, np.random.default_rng(1)
    machine: Any = SimpleNamespace(lag_s=lag_s, command_step_s=step_s)
    own = lag_s * (1.0 + LAG_SHARE * rng.standard_normal(100_000))
    drawn = 1e3 * (own + rng.uniform(0.0, 0.5 * step_s, len(own)))
    lag_ms, tolerance_ms = lag_of(machine)
    assert lag_ms == pytest.approx(drawn.mean(), rel=0.01)
    assert tolerance_ms == pytest.approx(drawn.std(), rel=0.01)
    machine.command_step_s = 0.0
    assert lag_of(machine) == pytest.approx((1e3 * lag_s, 1e3 * LAG_SHARE * lag_s))


def rows(step_s: float, u: FloatArray) -> Samples:
    """Of a table with such a command (n,)."""
    t_us = np.round(1e6 * step_s * np.arange(len(u))).astype(np.int64)
    return Samples(("u",), t_us, u[:, None], np.full(len(u), ROW, np.uint8))


def swing(step_s: float) -> FloatArray:
    """500 rows of a sine of 1 Hz."""
    return np.asarray(np.sin(2.0 * np.pi * step_s * np.arange(500)))


def test_the_lag_beside_a_held_command_may_be_half_a_row_longer() -> None:
    """0.136 +- 0.032 ms were told of 1.610, of a controller of 1 kHz in a log of 250 Hz."""
    first: Any = Said(0.136e-3, 0.032e-3)
    slow = rows(4e-3, swing(4e-3))
    told = between_rows(first, hidden_s(slow, False, 5e-3))
    assert abs(1.610e-3 - told.lag_s) < 1.96 * told.lag_sd_s
    ahead_s = np.random.default_rng(1).uniform(0.0, 2e-3, 100_000)
    expected = np.hypot(0.032e-3, np.sqrt(np.mean(ahead_s**2)))
    assert told.lag_sd_s == pytest.approx(expected, rel=0.01)
    assert hidden_s(slow, False, 0.3e-3) == 0.3e-3, "of a lag that was declared no more is open"
    assert np.isnan(between_rows(replace(first, lag_sd_s=np.nan), 1e-3).lag_sd_s)


@pytest.mark.parametrize(("step_s", "hidden"), [(1e-3, 0.0), (4e-3, 4e-3)])
def test_a_log_as_fast_as_controllers_hides_nothing(step_s: float, hidden: float) -> None:
    samples = rows(step_s, swing(step_s))
    assert rows_apart_s(samples) == pytest.approx(hidden)
    assert hidden_s(samples, False, 1.0) == pytest.approx(hidden / np.sqrt(12.0))


@pytest.mark.parametrize("jumps", [12, 48])
def test_of_jumps_on_a_line_each_is_anywhere_in_its_step(jumps: int) -> None:
    """3.412 +- 0.005 ms were told of 3.112, of a joystick's steps in a log of 200 Hz."""
    step_s, rng = 5e-3, np.random.default_rng(jumps)
    u = np.repeat(np.resize([1.0, -1.0], jumps + 1), 20)
    late_s = rng.uniform(-0.5 * step_s, 0.5 * step_s, (10_000, jumps)).mean(axis=1)
    assert hidden_s(rows(step_s, u), True, 1e-6) == pytest.approx(late_s.std(), rel=0.03)
    assert hidden_s(rows(step_s, swing(step_s)), True, 1e-6) < 0.08e-3


VOLUME = replace(of_page(effect("extra_dead_volume"), "a", shape=("port_lag",)), shape=(0.0,))


def half_a_sample_late(seed: int, found: Revision) -> tuple[Any, Any]:
    """The same command on a line and held, beside a dead volume that is found or not.

    The means of two samples in turn, half a step later, are what was held but for its corners.
    """
    model, held, _ = record("extra_dead_volume", 1e-4, seed, "sweep", "a")
    u, half_s = 2 + model.column("u"), 0.5e-3
    line = held.copy()
    line[:-1, u] = 0.5 * (held[1:, u] + held[:-1, u])
    lag = replace(model.lag, nominal_s=model.lag.nominal_s + half_s)
    late = replace(model, lag=lag)
    last = fit(model, held, prepare(model, held), found, bank=False)
    on_a_line = fit(late, line, prepare(late, line), Revision(), bank=False)
    result = SimpleNamespace(last=last)
    first = SimpleNamespace(taught=held, diagnosed=SimpleNamespace(result=result))
    return SimpleNamespace(fitted=on_a_line, machine=late), first


@pytest.mark.first_of(1)
@pytest.mark.parametrize(
    ("seed", "found"), [(5, Revision()), (6, Revision()), (6, Revision((VOLUME,)))]
)
def test_what_wins_by_chance_tells_nothing_of_the_command(seed: int, found: Revision) -> None:
    """By 1.15 of 7230 a line won beside a dead volume: 2.818 +- 0.006 ms were told of 1.845."""
    won, least = wins(*half_a_sample_late(seed, found))
    assert least >= TIE and abs(won) < least


@dataclass(frozen=True)
class Sizes:
    """Those of a machine of which nothing is assumed."""

    assumptions: tuple[Assumption, ...] = ()


def test_that_neither_is_likelier_is_told() -> None:
    machine: Any = Sizes()
    (told,) = set(not_told(machine, 2e-3).assumptions) - set(machine.assumptions)
    assert "held over its 2 ms" in told.what and "1 ms more" in told.if_wrong
