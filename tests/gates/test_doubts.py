"""Second senders and frozen sensors, counted out by hand: a message of 10 ms, a limit of 3."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.frozen import Frozen, run_limit
from firmware_bridge.samples import GAP, ROW, Samples
from firmware_bridge.senders import Senders

MESSAGE = np.dtype([("can_id", np.uint32), ("channel", np.int16), ("period_us", np.int64)])
T, START = 10_000, 1_000_000_000  # us; the bucket of this message holds 7.5 frames


def senders(period_us: int = T, channel: int = -1) -> Senders:
    return Senders(np.array([(0x10, channel, period_us)], MESSAGE))


def at(t_us: list[float] | NDArray[np.floating], can_id: int = 0x10) -> Frames:
    found = fr.empty(len(t_us))
    found.t_us[:] = START + np.asarray(t_us, np.int64)
    found.can_id[:], found.length[:] = can_id, 8
    return found


def kept(gate: Senders, *parts: list[float] | NDArray[np.floating]) -> list[int]:
    """How many of each part are believed."""
    return [len(gate.push(at(part))) for part in parts]


def test_two_senders_fill_the_bucket_by_three_eighths_per_frame() -> None:
    """20 frames at 5 ms fill it to 7.5, the next one is too much."""
    gate = senders()
    assert kept(gate, T / 2 * np.arange(21)) == [21] and not gate.doubted.any()
    found = gate.push(at([T / 2 * 21]))
    assert not len(found) and found.refused == {"too_fast": 1} and gate.doubted.all()


def test_of_two_channels_the_first_is_taken_until_one_is_declared() -> None:
    """A gateway repeats every fifth frame on another channel: too seldom to be too fast."""
    both = at(T * np.repeat(np.arange(20.0), 2))
    both.channel[1::2] = 1
    rare = both[(both.channel == 0) | (np.arange(40) % 10 == 1)]
    for channel, kept_channel, others in ((-1, 0, 4), (0, 0, 0), (1, 1, 0)):
        gate = senders(channel=channel)
        believed = gate.push(rare)
        assert believed.refused == ({"other_channel": others} if others else {})
        taken = believed.channel == kept_channel
        assert taken.sum() == (20 if kept_channel == 0 else 4)
        assert gate.channels.tolist() == [0 if others else -1]
    gate = senders()
    gate.push(rare)
    gate.push(at(T * np.arange(20.0, 90.0)))  # the other one has ended
    assert gate.channels.tolist() == [-1]


def test_refused_until_half_a_second_after_the_last_overflow() -> None:
    """A flood fills it to 8.5 and no further; at the usual pace that is 7.5 after 4 frames."""
    gate, end = senders(), 100.0
    kept(gate, np.zeros(1), np.full(99, end))
    pace = end + T * np.arange(1, 60)
    assert kept(gate, pace[:52], pace[52:]) == [0, 7]  # refused from 3 + 50 frames on, exclusive
    assert not gate.doubted.any()


def test_a_silence_gives_credit_for_what_it_owes() -> None:
    """10 periods owe 9 frames; 7 more find room in the bucket, the next does not."""
    late = 100 * T
    for n, expected in ((17, 17), (18, 17)):
        assert kept(senders(), [0.0], np.full(n, late / 10)) == [1, expected]


def test_credit_is_forgotten_and_limited() -> None:
    gate = senders()
    pace = 10 * T + T * np.arange(101.0)  # 9 frames owed, 0.995^100 of them are left
    assert kept(gate, [0.0], pace, np.full(14, pace[-1])) == [1, 101, 12]
    assert kept(senders(), [0.0], np.full(300, 1000.0 * T)) == [1, 208]  # 2 s owe 200 frames


@pytest.mark.parametrize(("dt", "n"), [(1.5, 8), (1.6, 9), (1.0, 8)])
def test_a_silence_is_longer_than_one_and_a_half_periods(dt: float, n: int) -> None:
    assert kept(senders(), [0.0], np.full(20, dt * T)) == [1, n]


@pytest.mark.parametrize(("back", "believed"), [(500_000, 0), (500_001, 1)])
def test_a_clock_that_is_set_back_begins_anew(back: int, believed: int) -> None:
    gate = senders()
    kept(gate, np.full(50, 1e6))
    assert kept(gate, [1e6 - back]) == [believed]


def test_the_level_begins_anew_with_the_clock() -> None:
    gate = senders()
    kept(gate, np.full(8, 2e6))
    assert kept(gate, [1e6], np.full(8, 1e6)) == [1, 7]


def test_a_stamp_that_is_a_little_older_counts_as_at_once() -> None:
    gate = senders()
    assert kept(gate, [0.0], [-1.0] * 8) == [1, 7]
    assert kept(senders(), [0.0], [-4e5]) == [1, 1]


@pytest.mark.parametrize(("period_us", "room"), [(100, 75), (1000, 75), (10_000, 7), (90_000, 3)])
def test_room_for_75_ms_between_3_and_75_frames(period_us: int, room: int) -> None:
    assert kept(senders(period_us), [0.0], np.zeros(100)) == [1, room]


def test_other_identifiers_and_channels_do_not_count() -> None:
    gate = senders()
    assert len(gate.push(at([0.0] * 50, can_id=0x11))) == 50
    assert len(senders(channel=1).push(at([0.0] * 50))) == 50
    assert len(senders(channel=0).push(at([0.0] * 50))) == 8


def test_what_was_refused_before_is_still_told() -> None:
    frames = at([0.0] * 20)
    fr.add_counts(frames.refused, {"overrun": 3})
    assert senders().push(frames).refused == {"overrun": 3, "too_fast": 12}
    assert not senders().doubted.any()


def test_equal_readings_that_are_no_chance() -> None:
    assert run_limit(5.0, 1.0) == 29 and run_limit(5.0, 1.0, 3) == 87
    assert run_limit(0.5, 1.0) == 145 and run_limit(0.499, 1.0) == 0
    assert run_limit(1e9, 1.0) == run_limit(1.0, 0.0) == 20
    assert run_limit(0.0, 0.0) == run_limit(-1.0, 0.0) == 0
    assert run_limit(1e-3, 2e-3) == 145 and run_limit(0.2, 0.1) == 43


def of(*rows: tuple[float, float]) -> Samples:
    values = np.array(rows, float)
    return Samples(("a", "b"), np.arange(len(rows)), values, np.full(len(rows), ROW, np.uint8))


def test_the_limit_is_counted_in_repeats_over_any_pieces() -> None:
    gate = Frozen([3, 0])
    first = gate.push(of((1, 5), (1, 5), (1, 5)))
    assert len(first) == 3 and not gate.doubted.any() and gate.refused == 0
    assert not len(gate.push(of((1, 6)))) and gate.doubted.tolist() == [True, False]
    assert not len(gate.push(of((1, 6), (1, 6)))) and gate.refused == 3
    after = gate.push(of((2, 6), (2, 7), (3, 7)))
    assert after.flags.tolist() == [ROW | GAP, ROW, ROW] and not gate.doubted.any()
    assert gate.signals["minimum"].tolist() == [1, 5] and gate.signals["maximum"].tolist() == [3, 7]
    gate.reset_extremes()
    gate.push(of((4, 4)))
    assert gate.signals["minimum"].tolist() == gate.signals["maximum"].tolist() == [4, 4]


def test_either_signal_holds_the_sample() -> None:
    gate = Frozen([2, 2])
    taken = gate.push(of((1, 1), (2, 1), (3, 1), (4, 2), (4, 3), (4, 4), (5, 5)))
    assert taken.values[:, 0].tolist() == [1, 2, 4, 4, 5]
    assert taken.flags.tolist() == [ROW, ROW, ROW | GAP, ROW, ROW | GAP]
    assert taken.t_us.tolist() == [0, 1, 3, 4, 6] and gate.refused == 2


def test_one_repeat_is_enough_where_that_is_the_limit() -> None:
    gate = Frozen([1, 0])
    assert len(gate.push(of((1, 1), (1, 2)))) == 1 and gate.doubted.tolist() == [True, False]
