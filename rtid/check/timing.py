"""Arrival times judged: rate, jitter and gaps of a message, and of every identifier on a bus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import EXTENDED, Frames

GAP_PERIODS = 1.5  # a step longer than this many median periods is a gap


@dataclass(frozen=True)
class Timing:
    """Steps between n arrivals, seconds: 1 %, median and 99 % quantile, the longest, the gaps.

    A single arrival has no step: all steps are NaN then.  `backward` counts stamps that go back.
    """

    count: int
    median_s: float
    p01_s: float
    p99_s: float
    worst_s: float
    gaps: int
    backward: int

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


def timing(t_us: NDArray[np.int64]) -> Timing:
    """Judge arrival times int64 (n,), microseconds, in order of arrival."""
    step_s = np.diff(t_us) * 1e-6
    if len(step_s) == 0:
        nan = float("nan")
        return Timing(len(t_us), nan, nan, nan, nan, 0, 0)
    p01, median, p99 = (float(q) for q in np.percentile(step_s, [1, 50, 99]))
    gaps = int((step_s > GAP_PERIODS * median).sum()) if median > 0 else 0
    backward = int((step_s < 0).sum())
    return Timing(len(t_us), median, p01, p99, float(step_s.max()), gaps, backward)


def bus(frames: Frames) -> tuple[IdTiming, ...]:
    """Timing of every identifier of a capture, by channel and identifier."""
    key = (frames.channel.astype(np.int64) << 32) | frames.can_id
    order = np.argsort(key, kind="stable")
    found, first = np.unique(key[order], return_index=True)
    times = np.split(frames.t_us[order], first[1:])
    return tuple(_id_timing(int(k), t) for k, t in zip(found, times, strict=True))


def _id_timing(key: int, t_us: NDArray[np.int64]) -> IdTiming:
    can_id = key & 0xFFFF_FFFF
    return IdTiming(key >> 32, can_id & 0x1FFF_FFFF, bool(can_id & EXTENDED), timing(t_us))
