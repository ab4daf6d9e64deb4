"""Records as loggers write them that nobody planned: no two steps alike, decimal commas, few words.

A row comes after the command that it tells.  A lag is told from the row, and from the command too.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.sources.table import longest_step
from rtid.estimator.noise import estimate_noise
from rtid.plain import FloatArray
from tests.test_rate import said

MS, LAG_S, N = 1e-3, 0.060, 90_000


def late(values: FloatArray) -> FloatArray:
    """Values (n,) that are held for a ms each, behind the lag."""
    keep, last, out = float(np.exp(-MS / LAG_S)), float(values[0]), np.empty(len(values))
    for k, value in enumerate(values):
        out[k], last = last, keep * last + (1.0 - keep) * float(value)
    return out


def steps_of(rng: np.random.Generator, low: float, high: float) -> FloatArray:
    """A command (n,) that changes each 0.3 to 1.5 s, rest among it."""
    u = np.empty(N)
    k = 0
    while k < N:
        m = int(rng.uniform(300, 1500))
        u[k : k + m] = 0.0 if rng.random() < 0.3 else rng.uniform(low, high)
        k += m
    return u


def rows(rng: np.random.Generator, least: int, most: int) -> np.ndarray:
    """The ms at which a logger wrote a row: no two steps alike."""
    at = np.cumsum(rng.integers(least, most, 2 * N // (least + most)))
    return at[at < N]


def test_steps_that_are_never_alike_are_no_gaps() -> None:
    rng = np.random.default_rng(1)
    uneven = rng.integers(5_000, 25_000, 2000)
    assert np.mean(uneven > longest_step(uneven)) == 0.0
    even = np.full(2000, 10_000)
    even[::9] *= 2  # each ninth row is lost: a multiple of the step
    assert longest_step(even) == pytest.approx(15_000.0)


def test_messages_of_5_10_and_20_ms_are_no_gaps() -> None:
    """Twice the usual step is a lost row only where the usual step is the shortest."""
    rng = np.random.default_rng(3)
    mixed = rng.choice([5_000, 10_000, 20_000], 2000)
    assert np.mean(mixed > longest_step(mixed)) == 0.0
    kept = np.flatnonzero(rng.random(2000) < 0.7)
    assert longest_step(10_000 * np.diff(kept)) == pytest.approx(15_000.0)


def test_the_noise_of_a_sensor_that_is_read_at_any_time() -> None:
    rng = np.random.default_rng(2)
    t_s = MS * np.cumsum(rng.integers(5, 26, 4000))
    found = estimate_noise(t_s, np.sin(t_s) + 0.01 * rng.standard_normal(len(t_s)))
    assert found.sd == pytest.approx(0.01, rel=0.1)


def boom(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Command (n,), % about its neutral, and position (n,), mm."""
    u = steps_of(rng, -30.0, 30.0)
    u *= np.where(np.abs(np.cumsum(u)) > 6e5, 0.2, 1.0)
    spool = late(u)
    rate = np.where(spool > 6, 9.0 * (spool - 6), np.where(spool < -4, 6.5 * (spool + 4), 0.0))
    return u, 300.0 + MS * np.cumsum(rate) + 0.02 * rng.standard_normal(N)


def in_one_row(file: Path, rng: np.random.Generator) -> None:
    """Decimal commas, rows 5 to 25 ms apart: the lag is 9 ms too short from row to row."""
    u, x = boom(rng)
    lines = [f"{k};{50 + u[k]:.1f};{x[k]:.2f}" for k in rows(rng, 5, 26)]
    head = "Zeit [ms];Joystick (%);Weg Ausleger [mm]\n"
    file.write_text(head + "\n".join(lines).replace(".", ",") + "\n")


def in_turn(file: Path, rng: np.random.Generator) -> None:
    """Each signal when it comes, the other one blank: no row was whole, and there was no plant."""
    u, x = boom(rng)
    lines = {k: f"{MS * k:.3f},{50 + u[k]:.1f}," for k in range(3, N, 20)}
    lines |= {k: f"{MS * k:.3f},,{x[k]:.2f}" for k in rows(rng, 14, 19).tolist() if k not in lines}
    words = "\n".join(lines[k] for k in sorted(lines))
    file.write_text(f"t_s,lever_pct,boom_mm\n{words}\n")


@pytest.mark.parametrize("written", [in_one_row, in_turn])
def test_a_lag_is_told_from_the_command_itself(
    tmp_path: Path, written: Callable[[Path, np.random.Generator], None]
) -> None:
    table = tmp_path / "bagger.csv"
    written(table, np.random.default_rng(3))
    words = said("quick", table)
    print(words)
    found = re.search(r"the lag is (\d+) to (\d+) ms, (\d+) ms on average", " ".join(words.split()))
    assert found is not None
    low, high, usual = (int(n) for n in found.groups())
    assert low < 1e3 * LAG_S < high
    assert usual == pytest.approx(1e3 * LAG_S, abs=6)


def test_a_speed_that_follows_its_command_is_what_the_map_gives(tmp_path: Path) -> None:
    """A motor on its stand: its rate tells nothing, and it was no plant."""
    rng = np.random.default_rng(4)
    u = np.abs(steps_of(rng, 0.0, 100.0))
    speed = late(np.where(u > 8, 22.0 * np.maximum(u - 8, 0.0) ** 0.8, 0.0))
    at = rows(rng, 4, 16)
    table = tmp_path / "stand.csv"
    lines = [f"{1000 * k},{u[k]:.1f},{speed[k] + 2 * rng.standard_normal():.1f}" for k in at]
    table.write_text("time_us,duty_pct,drehzahl_rpm\n" + "\n".join(lines) + "\n")
    words = said("quick", table)
    print(words)
    assert "x = f(u)" in words and "Lag behind the map" in words
