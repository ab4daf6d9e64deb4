"""Stamps of adapters that deliver in bursts or out of order, put right by the bus's own timing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.mended import mend
from firmware_bridge.sources import blf, open_log
from tests.command import said

PERIODS_MS = {0x100: 10.0, 0x101: 10.0, 0x102: 20.0, 0x103: 7.0}
JITTER_MS = 0.1


def bus(seconds: float = 20.0, seed: int = 0) -> Frames:
    """Messages of four senders with clocks of their own, numbered in their order."""
    rng = np.random.default_rng(seed)
    rows = []
    for can_id, period_ms in PERIODS_MS.items():
        period_us = 1e3 * period_ms * (1 + rng.uniform(-50e-6, 50e-6))
        t_us = rng.uniform(0, period_us) + period_us * np.arange(int(1e6 * seconds / period_us))
        t_us += rng.normal(0, 1e3 * JITTER_MS, len(t_us))
        rows += [(t, can_id) for t in t_us]
    rows.sort()
    frames = fr.empty(len(rows))
    frames.t_us[:] = [round(t) + 10**9 for t, _ in rows]
    frames.can_id[:], frames.length[:] = [can_id for _, can_id in rows], 8
    frames.data[:, :4] = np.arange(len(rows)).astype("<u4").view(np.uint8).reshape(-1, 4)
    return frames


def number(frames: Frames) -> np.ndarray:
    return np.ascontiguousarray(frames.data[:, :4]).view("<u4")[:, 0]


def in_bursts(frames: Frames, every_ms: float) -> Frames:
    late = frames[:]
    t_us = np.ceil(frames.t_us / (1e3 * every_ms)) * 1e3 * every_ms
    return Frames(np.rint(t_us).astype(np.int64), late.channel, late.can_id, late.length, late.data)


@pytest.mark.parametrize("every_ms", [20.3, 30.0])
def test_bursts_are_put_back_to_the_periods_of_their_messages(every_ms: float) -> None:
    true = bus()
    mended = mend(in_bursts(true, every_ms))
    assert mended.frames.refused == {"burst_mended": len(true)}
    error_ms = 1e-3 * (mended.frames.t_us - true.t_us[number(mended.frames)])
    assert 1e3 * mended.late_s[0] == pytest.approx(0.5 * every_ms, rel=0.1)
    assert np.abs(error_ms).max() < 1e3 * max(mended.known_s.values()) + 6 * JITTER_MS
    if every_ms == 20.3:  # no multiple of a period: every phase is seen
        assert error_ms.std() < 0.3
    for can_id in PERIODS_MS:
        mine = mended.frames.can_id == can_id
        assert (np.diff(number(mended.frames)[mine].astype(int)) > 0).all()


def test_a_lost_frame_costs_a_piece_and_what_is_sent_on_events_keeps_its_stamps() -> None:
    true = bus()
    rng = np.random.default_rng(1)
    keep = np.ones(len(true), np.bool_)
    keep[rng.choice(np.flatnonzero(true.can_id == 0x100), 3, replace=False)] = False
    events = true.can_id == 0x103
    true.t_us[events] = np.sort(rng.integers(true.t_us[0], true.t_us[-1], events.sum()))
    true = fr.by_time(true[keep])
    late = in_bursts(true, 20.3)
    mended = mend(late)
    place = np.argsort(number(mended.frames))
    error_ms = 1e-3 * np.abs(mended.frames.t_us[place] - true.t_us[np.argsort(number(true))])
    can_id = mended.frames.can_id[place]
    assert np.quantile(error_ms[can_id == 0x100], 0.85) < 1.0
    assert mended.frames.refused["burst_left"] > 0.9 * (can_id == 0x103).sum()


def test_what_comes_one_by_one_stays_as_it_is_and_stamps_of_1_ms_are_no_bursts() -> None:
    true = bus(5.0)
    coarse = in_bursts(true, 1.0)
    for frames in (true, coarse, true[:0], true[:1]):
        mended = mend(frames)
        assert mended.frames.refused == {} and not mended.known_s
        assert np.array_equal(mended.frames.t_us, frames.t_us)


def test_a_log_of_an_adapter_that_reorders_is_sorted_and_a_lone_stamp_is_not() -> None:
    true = bus(5.0)
    order = np.argsort(np.arange(len(true)) + np.random.default_rng(0).uniform(0, 4, len(true)))
    mended = mend(true[order])
    assert np.array_equal(mended.frames.t_us, true.t_us)
    assert mended.frames.refused["reordered"] > 0.1 * len(true)
    order = np.arange(len(true))
    order[[100, 101]] = 101, 100
    assert np.array_equal(mend(true[order]).frames.t_us, true.t_us[order])


def test_check_says_how_late_the_stamps_were_and_how_well_they_are_known(tmp_path: Path) -> None:
    blf.write(tmp_path / "late.blf", in_bursts(bus(), 20.3))
    code, out, _ = said("check", "--bus-only", tmp_path / "late.blf")
    out = " ".join(out.split())
    assert not code
    assert "frames came in bursts with one stamp" in out
    assert "are put back to the steady periods of their messages, by 10." in out, out
    assert 'offset_ms = "estimate"' in out
    assert open_log(tmp_path / "late.blf").refused["burst_mended"] > 5000
