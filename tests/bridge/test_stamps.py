from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import Frames
from firmware_bridge.samples import GAP
from firmware_bridge.stamps import StampModel
from firmware_bridge.steps import Continuous
from tests.bridge.machine import CATALOG, START_US, assembly, cycles, equal

HOUR_US = 3_600_000_000
Ints = NDArray[np.int64]


@dataclass
class Stream:
    """Frames as one adapter stamps them, when they arrived, and when they truly were."""

    frames: Frames
    arrived_us: Ints
    true_us: Ints

    def model(self, chunk: int = 1 << 30) -> tuple[StampModel, Frames]:
        model, parts = StampModel(), []
        for first in range(0, len(self.frames), chunk):
            piece = slice(first, first + chunk)
            parts.append(model.push(self.frames[piece], self.arrived_us[piece]))
        return model, fr.concatenate(parts)

    def error_us(self, got: Frames) -> Ints:
        """How far the time of each frame is from the truth; frames are known by identifier."""
        return got.t_us - self.true_us[got.can_id]


def stream(
    ppm: float, hz: float = 1000.0, seconds: float = 60.0, seed: int = 0, late: str = "uniform"
) -> Stream:
    """An adapter whose clock loses `ppm`, arrivals late by about 1 ms."""
    rng, n = np.random.default_rng(seed), int(seconds * hz)
    since_us = np.rint(np.arange(n) * 1e6 / hz).astype(np.int64)
    late_us = rng.uniform(0, 1000, n) if late == "uniform" else rng.exponential(1000, n)
    frames = fr.empty(n)
    frames.t_us[:] = np.rint(since_us * (1 - ppm * 1e-6)).astype(np.int64) + 12_345
    frames.can_id[:] = np.arange(n)
    true_us = START_US + since_us
    return Stream(frames, np.maximum.accumulate(true_us + late_us.astype(np.int64)), true_us)


@given(
    ppm=st.floats(-200, 200),
    hz=st.sampled_from([20.0, 137.0, 1000.0, 3000.0]),
    late=st.sampled_from(["uniform", "exponential"]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_drift_is_found_and_times_grow(ppm: float, hz: float, late: str, seed: int) -> None:
    """Drift to 2 ppm after 60 s with 1 ms of jitter."""
    made = stream(ppm, hz, 61.0, seed, late)
    model, got = made.model()
    assert len(got) == len(made.frames)
    assert (np.diff(got.t_us) > 0).all()
    assert abs(model.drift_ppm - 1e6 * (1 / (1 - ppm * 1e-6) - 1)) <= 2.0
    assert np.abs(made.error_us(got)[len(got) // 2 :]).max() < (300 if hz < 100 else 100)


@given(
    steps=st.lists(
        st.tuples(
            st.integers(3, 55),
            st.one_of(st.integers(60_000, 3 * HOUR_US), st.integers(-3 * HOUR_US, -60_000)),
        ),
        min_size=1, max_size=4, unique_by=lambda step: step[0],
    ),
    ppm=st.floats(-200, 200),
    seed=st.integers(0, 1000),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_every_step_is_one_gap(steps: list[tuple[int, int]], ppm: float, seed: int) -> None:
    made = stream(ppm, 1000.0, 60.0, seed)
    for at_s, by_us in steps:
        made.frames.t_us[made.true_us - START_US >= 1e6 * at_s] += by_us
    _, got = made.model()
    gaps = np.diff(got.t_us) > 50_000
    assert (np.diff(got.t_us) > 0).all()
    assert gaps.sum() == got.refused["clock_step"] == len(steps)
    assert np.diff(got.t_us).max() < 250_000
    assert np.abs(made.error_us(got)).max() < 1200  # the truth goes on through every step


@given(chunk=st.integers(1, 5000), seed=st.integers(0, 10))
@settings(max_examples=20, deadline=None)
def test_pieces_of_any_size_give_the_same_times(chunk: int, seed: int) -> None:
    made = stream(150.0, 1000.0, 5.0, seed)
    made.frames.t_us[3000:] -= HOUR_US
    assert equal(made.model(chunk)[1], made.model()[1])


def test_a_stalled_reader_does_not_move_the_line() -> None:
    made = stream(100.0)
    seconds = (made.true_us - START_US) * 1e-6
    stalled = (seconds > 30) & (seconds < 32)
    made.arrived_us[stalled] = made.true_us[stalled][-1]
    made.arrived_us[:] = np.maximum.accumulate(made.arrived_us)
    model, got = made.model()
    assert len(got) == len(made.frames)
    assert abs(model.drift_ppm - 100.0) < 0.5
    assert np.abs(made.error_us(got)[20_000:]).max() < 20


def test_a_longer_way_for_good_is_believed_after_ten_windows() -> None:
    made = stream(0.0, seconds=120.0)
    made.arrived_us[30_000:] += 30_000
    _, got = made.model()
    error_us = made.error_us(got)
    assert np.abs(error_us[39_000]) < 100
    assert np.abs(error_us[-1] - 30_000) < 100
    assert (np.diff(got.t_us) > 0).all()


@pytest.mark.parametrize("by_us", [HOUR_US, -HOUR_US, 70_000, -70_000])
def test_single_wrong_stamps_are_left_out(by_us: int) -> None:
    made = stream(50.0, 1000.0, 10.0)
    made.frames.t_us[[2000, 5000, 5001]] += by_us
    _, got = made.model()
    assert got.refused == {"stamp_outlier": 3}
    assert np.abs(made.error_us(got)).max() < 1100


def test_stamps_that_roll_over_for_days() -> None:
    """150 ppm for 4 days are 52 s, nearly a whole roll-over of 60 s."""
    n, period_us = 4 * 86_400, 60_000_000
    true_us = START_US + 1_000_000 * np.arange(n)
    frames = fr.empty(n)
    frames.t_us[:] = np.rint((true_us - START_US) * (1 - 150e-6)).astype(np.int64) % period_us
    got = StampModel(period_us).push(frames, true_us + 500)
    assert not got.refused
    assert np.abs(got.t_us - true_us - 500)[60:].max() < 20  # the drift is known by then


def test_one_flagged_gap_per_clock_step_in_the_samples() -> None:
    """Fault 20: +-1 h steps, a step back of 0.2 s, 200 ppm; the time that passes is right."""
    frames = cycles(40_000)
    true_us = frames.t_us.copy()
    frames.t_us[:] = START_US + np.rint((true_us - START_US) * (1 - 200e-6)).astype(np.int64)
    for at_s, by_us in ((10, HOUR_US), (20, -HOUR_US), (30, -200_000)):
        frames.t_us[true_us - START_US >= 1e6 * at_s] += by_us
    late_us = np.random.default_rng(4).integers(0, 1000, len(frames))
    got = StampModel().push(frames, np.maximum.accumulate(true_us + late_us))
    assembler = Assembler(CATALOG, assembly())
    samples = assembler.push(got)
    assert got.refused["clock_step"] == assembler.counters["gap"] == 3
    assert (samples.flags & GAP > 0).sum() == 4  # the first sample continues nothing
    span_us = samples.t_us[-1] - samples.t_us[0]
    assert len(samples) + got.refused["clock_step_hold"] // 3 == pytest.approx(40_000, abs=8)
    assert span_us == pytest.approx(39_999_000, rel=1e-4)


@pytest.mark.parametrize("by_us", [HOUR_US, -HOUR_US, -2_000_000])
def test_a_log_whose_clock_was_set_is_one_gap(by_us: int) -> None:
    frames = cycles(2000)
    frames.t_us[3000:] += by_us
    shifted = Continuous().push(frames)
    assembler = Assembler(CATALOG, assembly())
    samples = assembler.push(shifted)
    assert assembler.counters["gap"] == 1
    assert assembler.counters.get("clock_step", 0) == (by_us < 0)
    assert len(samples) == 2000


def test_good_stamps_stay_as_they_are_to_the_bit() -> None:
    frames = cycles(500)
    frames.t_us[[300, 301]] = frames.t_us[[301, 300]]  # late, not stepped
    frames.t_us[900:] += HOUR_US
    before = frames.t_us.copy()
    clock = Continuous()
    got = fr.concatenate([clock.push(part) for part in frames.chunks(7)])
    np.testing.assert_array_equal(got.t_us, before)
    assert not got.refused
