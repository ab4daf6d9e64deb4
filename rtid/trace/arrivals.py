"""Arrival times judged: rate, jitter and gaps of a message, and of every identifier on a bus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_bridge.frames import EXTENDED, Frames
from rtid.plain import FloatArray, IntArray

BURST = 4  # frames of one channel with one stamp
GAP_PERIODS = 1.5  # a step longer than this many median periods is a gap


@dataclass(frozen=True)
class Timing:
    """Steps between n arrivals, seconds: 1 %, median and 99 % quantile, the longest, the gaps.

    A single arrival has no step: all steps are NaN then.  `backward` counts stamps that go back;
    `missing` is the share of the time in which arrivals are missing.
    """

    count: int
    median_s: float
    p01_s: float
    p99_s: float
    worst_s: float
    gaps: int
    backward: int
    missing: float = 0.0

    @property
    def rate_hz(self) -> float:
        """Arrivals per second, from the median step."""
        return 1 / self.median_s if self.median_s > 0 else float("nan")


@dataclass(frozen=True)
class IdTiming:
    """Timing of one identifier on one channel."""

    channel: int
    can_id: int
    extended: bool
    timing: Timing

    @property
    def label(self) -> str:
        """Identifier as people write it, 29 bit ones with eight digits."""
        return f"{self.can_id:08X}" if self.extended else f"{self.can_id:03X}"


def timing(t_us: IntArray) -> Timing:
    """Judge arrival times int64 (n,), microseconds, in order of arrival."""
    step_s = np.diff(t_us) * 1e-6
    if len(step_s) == 0:
        nan = float("nan")
        return Timing(len(t_us), nan, nan, nan, nan, 0, 0)
    p01, median, p99 = (float(q) for q in np.percentile(step_s, [1, 50, 99]))
    gaps = int((step_s > GAP_PERIODS * median).sum()) if median > 0 else 0
    backward, missing = int((step_s < 0).sum()), _missing(step_s, median)
    return Timing(len(t_us), median, p01, p99, float(step_s.max()), gaps, backward, missing)


def _missing(step_s: FloatArray, median_s: float) -> float:
    """Share of the time that is beyond the usual step in gaps, and not made up for by others.

    step_s (n,).  An arrival that is late is no loss: the next one comes sooner.
    """
    whole_s = float(step_s.sum())
    lost_s = float((step_s - median_s)[step_s > GAP_PERIODS * median_s].sum())
    return min(lost_s, max(0.0, whole_s - len(step_s) * median_s)) / whole_s if whole_s > 0 else 0.0


def bus(frames: Frames) -> tuple[IdTiming, ...]:
    """Timing of every identifier of a capture, by channel and identifier; () without frames."""
    if not len(frames):
        return ()
    key = (frames.channel.astype(np.int64) << 32) | frames.can_id
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))  # no second sort: a log may have 10^7 frames
    times = np.split(frames.t_us[order], first[1:])
    return tuple(_id_timing(int(k), t) for k, t in zip(key[first], times, strict=True))


@dataclass(frozen=True)
class Stamps:
    """What is odd about a capture's time stamps, over all of its channels.

    backward: stamps before the one before; repeated: frames that are the one before once more, with
    its stamp; in_bursts: frames that share one stamp with at least BURST - 1 others, which no bus
    sends at once; late_s: the longest silence before such a burst, so late may its stamps be.
    """

    backward: int
    repeated: int
    in_bursts: int
    late_s: float


def stamps(frames: Frames) -> Stamps:
    """Judge the stamps of a capture, channel by channel in the order of the file."""
    parts = [_stamps(frames[frames.channel == channel]) for channel in np.unique(frames.channel)]
    return Stamps(
        sum(part.backward for part in parts),
        sum(part.repeated for part in parts),
        sum(part.in_bursts for part in parts),
        max((part.late_s for part in parts), default=0.0),
    )


def _stamps(frames: Frames) -> Stamps:
    step_us = np.diff(frames.t_us)
    same = (step_us == 0) & (np.diff(frames.can_id.astype(np.int64)) == 0)
    same &= (frames.data[1:] == frames.data[:-1]).all(axis=1)
    first = np.flatnonzero(np.concatenate([[True], step_us != 0]))
    size = np.diff(np.append(first, len(frames)))
    silence_us = np.concatenate([[0], step_us])[first]
    burst = size >= BURST
    late_s = 1e-6 * float(silence_us[burst].max(initial=0))
    return Stamps(int((step_us < 0).sum()), int(same.sum()), int(size[burst].sum()), late_s)


def _id_timing(key: int, t_us: IntArray) -> IdTiming:
    can_id = key & 0xFFFF_FFFF
    return IdTiming(key >> 32, can_id & 0x1FFF_FFFF, bool(can_id & EXTENDED), timing(t_us))
