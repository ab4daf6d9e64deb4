"""Valves are shut where the motion does not depend on the command."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.study.quick_band import BINS, creep, neutral_within, settled, shut_band


def test_the_dead_band_is_half_of_where_motion_begins() -> None:
    u = np.linspace(-10.0, 10.0, 20_001)
    speed = np.maximum(0.0, np.abs(u) - 1.5) * 0.03
    assert shut_band(u, speed) == pytest.approx(0.8, abs=0.1)
    assert shut_band(u, 0.0 * speed) == 0.0
    assert shut_band(np.abs(u), speed) == 0.0, "of one way nothing is known"


def test_a_load_that_sinks_at_rest_leaves_its_dead_band() -> None:
    """It "moved" from no command on: the band was 0, and the maps took in the leak."""
    u = np.linspace(-10.0, 10.0, 20_001)
    speed = np.copysign(np.maximum(0.0, np.abs(u) - 1.5) * 0.03, u) - 0.01
    assert creep(u, speed) == -0.01
    assert 0.4 < shut_band(u, speed) < 0.9


@pytest.mark.parametrize("seed", range(5))
def test_a_soft_opening_that_ramps_pass_quickly_is_not_taken_for_shut(seed: int) -> None:
    """Valves that open at 0.6 V, of a flow as the square: 1.1 V were shut."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 40.0, 0.02)
    u = 10.0 * np.clip(1.5 * np.sin(2.1 * t) * np.sin(0.17 * t + 0.3), -1.0, 1.0)
    u[(t % 8.0) > 5.0] = 0.0
    speed = np.copysign(np.maximum(0.0, np.abs(u) - 0.6) ** 2 * 1e-3, u)
    speed += rng.normal(0.0, 2e-3, len(t))
    assert 0.0 < shut_band(u, speed) < 0.6


def test_a_machine_that_runs_on_is_not_one_that_moves() -> None:
    """From 8 V to 0.3: it takes a while to stop, and 0.3 V is shut for all that."""
    t = np.arange(0.0, 60.0, 0.01)
    u = np.where(t % 0.6 < 0.3, 8.0, 0.3) * np.where(t % 1.2 < 0.6, 1.0, -1.0)
    speed = 0.1 * np.where(t % 0.6 < 0.3, 1.0, np.exp((0.3 - t % 0.6) / 0.02)) * np.sign(u)
    assert shut_band(u, speed, settled(u, t)) == pytest.approx(4.0, abs=0.2)
    assert not settled(u, t)[u == 0.3].all(), "unless what was just before counts"


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("zero", "volt"), [(12.0, 0.8), (5.0, 0.5), (500.0, 48.0), (-2.5, 0.2)])
def test_a_command_of_one_sign_that_drives_both_ways_is_counted_from_the_middle(
    zero: float, volt: float, way: float
) -> None:
    """4 to 20 mA, 0 to 10 V, pulses: they opened one way only, and the other valves never did."""
    v = np.linspace(-9.0, 7.0, 16_001)
    speed = 0.03 * way * np.sign(v) * np.maximum(0.0, np.abs(v) - 1.2)
    speed += np.random.default_rng(3).normal(0.0, 1e-3, len(v))
    assert neutral_within(zero + volt * v, speed) == pytest.approx(zero, abs=16.0 * volt / BINS)
    rests = np.append(v, np.zeros(4000))
    assert neutral_within(zero + volt * rests, np.append(speed, np.zeros(4000))) == zero
    overlapped = neutral_within(zero + volt * v, 0.03 * way * v)
    assert overlapped == pytest.approx(zero, abs=16.0 * volt / BINS)


@pytest.mark.parametrize("rests", [400, 400_000])
def test_a_command_that_rests_at_4_ma_before_it_is_switched_on_is_counted_from_12(
    rests: int,
) -> None:
    """Of a machine that was off for 99 % of its record no neutral was found."""
    v = np.linspace(-7.0, 7.0, 1_601)
    speed = 0.03 * np.sign(v) * np.maximum(0.0, np.abs(v) - 1.2)
    u = np.append(np.full(rests, 4.0), 12.0 + v)
    noise = np.random.default_rng(3).normal(0.0, 1e-3, rests)
    found = neutral_within(u, np.append(noise, speed))
    assert found == pytest.approx(12.0, abs=16.0 / BINS)
    one_way = np.append(np.full(rests, 4.0), 12.0 + np.abs(v))
    assert neutral_within(one_way, np.append(np.zeros(rests), np.abs(speed))) == 0.0


def test_a_command_of_both_signs_or_of_one_way_is_counted_as_it_is() -> None:
    v = np.linspace(-9.0, 7.0, 16_001)
    speed = 0.03 * np.sign(v) * np.maximum(0.0, np.abs(v) - 1.2)
    assert neutral_within(v, speed) == 0.0
    assert neutral_within(np.abs(v), np.abs(speed)) == 0.0
    assert neutral_within(np.abs(v), speed) == 0.0, "of either way at the same command"
    assert neutral_within(np.maximum(v, 0.0), np.where(v > 1.2, speed, 0.0)) == 0.0
    assert neutral_within(np.zeros(9), np.zeros(9)) == 0.0
    assert neutral_within(12.0 + v, 0.0 * speed) == 0.0, "of a machine that never moves"
    assert neutral_within(np.full(9, 12.0), np.zeros(9)) == 0.0
