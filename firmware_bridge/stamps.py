"""Time of a frame from the stamp that its adapter gave it and from when it arrived.

An arrival is late, never early:  arrival = stamp + c + d (stamp - mean) + delay,  delay >= 0.
So per window of 1 s of stamps the earliest arrival (the lower envelope) is one point, and a
recursive regression with forgetting over these points gives the offset c and the drift d:

    mean += w (point - mean),  var = (1 - w)(var + w dx^2),  cov = (1 - w)(cov + w dx dz),
    d = (cov + w r d_prior) / (var + w r),  w = max(1/n, 1/40)

A window that as a whole came late (a stalled reader) is left out, ten of them in a row are a new
truth.  The published line follows the estimated one by at most 200 ppm (0.1 % in the first 10 s),
so that times grow strictly.  A stamp that goes back, or that arrives before it was sent, is an
outlier; the third in a row is a step of the clock: the line is opened anew, and frames are held off
for 0.2 s until the new offset is known, so that every step is exactly one gap.  No clock is asked
here: the same stamps and arrivals give the same times in pieces of any size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, Record, Records, inlined, kernel

WINDOW_US = 1_000_000
MEMORY = 1 / 40  # least weight of a new window
PRIOR_US2 = 0.25e12  # (0.1 ms of noise / 200 ppm of drift)^2: how much the prior drift weighs
DRIFT_LIMIT = 1e-3
SLEW, FIRST_SLEW = 200e-6, 1e-3  # published line towards estimated line, per microsecond
FIRST_WINDOWS = 10  # so long the offset of a new line is still being found
JUMP_US = 10_000.0  # a difference that is not worth slewing
LATE_US = 1_000.0  # a window this much later than foreseen is left out, at least
LATE_WINDOWS = 10
STEP_US = 50_000  # back by more, or early by more: not jitter
CONFIRM = 3
HOLD_US = 200_000

REASONS = ("stamp_outlier", "clock_step_hold", "clock_step")
OUTLIER, HELD, STEPS = 0, 1, 2

LINE = np.dtype(
    [
        ("open", np.bool_),
        ("origin_us", np.int64),  # stamp where the line was opened; x counts from here
        ("start_us", np.int64),  # its arrival; z = arrival - start - x
        ("last_us", np.int64),  # latest stamp
        ("last_out_us", np.int64),
        ("hold_us", np.int64),  # arrivals before this are held off
        ("strange", np.int64),  # outliers in a row
        ("n", np.int64),  # windows in the regression
        ("mean_x", np.float64),
        ("mean_z", np.float64),
        ("var", np.float64),
        ("cov", np.float64),
        ("drift", np.float64),
        ("prior", np.float64),
        ("spread", np.float64),  # mean square of windows about the line
        ("late", np.int64),  # late windows in a row
        ("window_x", np.float64),  # where the present window began
        ("least_x", np.float64),  # its earliest arrival
        ("least_z", np.float64),
        ("shown_x", np.float64),  # the published line passes through here
        ("shown_z", np.float64),
    ]
)


@inlined
def _estimate(line: Record, x: float) -> float:
    """Z of the estimated line at x."""
    if line.n == 0:
        return line.least_z + line.drift * (x - line.least_x)
    return line.mean_z + line.drift * (x - line.mean_x)


@inlined
def _reopen(line: Record, stamp: Integer, arrival: Integer) -> None:
    """Start a line through this frame; only the drift is kept."""
    line.origin_us, line.start_us, line.last_us = stamp, arrival, stamp
    line.n, line.strange, line.late = 0, 0, 0
    line.prior = line.drift
    line.window_x = line.least_x = line.least_z = line.shown_x = line.shown_z = 0.0
    line.open = True


@inlined
def _learn(line: Record, x: float, z: float) -> None:
    """One step of the recursive regression."""
    line.n += 1
    weight = max(1.0 / line.n, MEMORY)
    if line.n == 1:
        line.mean_x, line.mean_z, line.var, line.cov, line.spread = x, z, 0.0, 0.0, 0.0
        return
    error = z - _estimate(line, x)
    line.spread = (1 - weight) * (line.spread + weight * error * error)
    dx, dz = x - line.mean_x, z - line.mean_z
    line.mean_x += weight * dx
    line.mean_z += weight * dz
    line.var = (1 - weight) * (line.var + weight * dx * dx)
    line.cov = (1 - weight) * (line.cov + weight * dx * dz)
    ridge = weight * PRIOR_US2
    drift = (line.cov + ridge * line.prior) / (line.var + ridge)
    line.drift = min(max(drift, -DRIFT_LIMIT), DRIFT_LIMIT)


@inlined
def _close_window(line: Record) -> None:
    """Take the window's earliest arrival, unless the whole window came late."""
    error = line.least_z - _estimate(line, line.least_x)
    if line.n > 0 and error > max(LATE_US, 3.0 * np.sqrt(line.spread)):
        line.late += 1
        if line.late < LATE_WINDOWS:
            return
        line.n = 0  # the way has become longer for good
    line.late = 0
    _learn(line, line.least_x, line.least_z)


@inlined
def _observe(line: Record, x: float, z: float) -> None:
    """Let this arrival count in its window."""
    if x - line.window_x >= WINDOW_US:
        _close_window(line)
        line.window_x = line.least_x = x
        line.least_z = z
    elif z - line.least_z < line.drift * (x - line.least_x):
        line.least_x, line.least_z = x, z


@inlined
def _show(line: Record, x: float) -> float:
    """Z of the published line at x, moved towards the estimate."""
    dx = x - line.shown_x
    ahead = line.shown_z + line.drift * dx
    error = _estimate(line, x) - ahead
    if abs(error) < JUMP_US:
        most = dx * (SLEW if line.n > FIRST_WINDOWS else FIRST_SLEW)
        error = min(max(error, -most), most)
    line.shown_x, line.shown_z = x, ahead + error
    return line.shown_z


@inlined
def _unwrapped(line: Record, stamp: Integer, arrival: Integer, period_us: Integer) -> Integer:
    """The stamp whose rolled-over periods bring it nearest to where the arrival expects it."""
    if not line.open or period_us == 0:
        return stamp
    x = arrival - line.start_us
    expected = line.origin_us + x - np.int64(_estimate(line, np.float64(x)))
    return stamp + period_us * ((expected - stamp + period_us // 2) // period_us)


@inlined
def _is_strange(line: Record, stamp: Integer, arrival: Integer) -> bool:
    """Whether the clock went back, or the frame arrived before it was sent."""
    x = stamp - line.origin_us
    early = arrival - line.start_us - x < _estimate(line, x) - STEP_US
    return early or stamp < line.last_us - STEP_US


@inlined
def _follow(line: Record, stamp: Integer, arrival: Integer, first: bool) -> Integer:
    """Time of one frame, or -1 - reason if it has none."""
    if first:
        _reopen(line, stamp, arrival)
    elif _is_strange(line, stamp, arrival):
        line.strange += 1
        if line.strange < CONFIRM:
            return -1 - OUTLIER
        _reopen(line, stamp, arrival)
        line.hold_us = arrival + HOLD_US
        return -1 - STEPS
    line.strange = 0
    line.last_us = max(line.last_us, stamp)
    x = np.float64(stamp - line.origin_us)
    _observe(line, x, np.float64(arrival - line.start_us) - x)
    if arrival < line.hold_us:
        line.shown_z, line.shown_x = _estimate(line, x), x
        return -1 - HELD
    out = line.start_us + (stamp - line.origin_us) + np.int64(np.rint(_show(line, x)))
    if not first and out <= line.last_out_us:
        if out < line.last_out_us - JUMP_US:
            return -1 - HELD
        out = line.last_out_us + 1
    line.last_out_us = out
    return out


@kernel
def follow(
    lines: Records, stamp_us: NDArray[np.int64], arrived_us: NDArray[np.int64],
    period_us: Integer, out_us: NDArray[np.int64], counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Times of n frames into out_us, -1 where refused; lines, out_us, counts changed in place.

    stamp_us, arrived_us, out_us (n,); lines (1,); counts (reasons,).
    """
    line = lines[0]
    for k in range(len(stamp_us)):
        stamp = _unwrapped(line, stamp_us[k], arrived_us[k], period_us)
        out_us[k] = _follow(line, stamp, arrived_us[k], not line.open)
        if out_us[k] < 0:
            counts[-1 - out_us[k]] += 1
            out_us[k] = -1


class StampModel:
    """Maps the stamps of one adapter to the clock of arrivals, strictly growing.

    period_us: after how long its stamps roll over, 0 for never.  `refused` of what `push` returns
    counts "stamp_outlier" (a single wrong stamp), "clock_step" (one per step) and
    "clock_step_hold" (frames between a step and the known offset).
    """

    def __init__(self, period_us: int = 0) -> None:
        self._line = np.zeros(1, LINE)
        self._period_us = period_us

    @property
    def drift_ppm(self) -> float:
        """By how much the clock of arrivals runs faster than the adapter's."""
        return float(self._line["drift"][0] * 1e6)

    def push(self, frames: Frames, arrived_us: NDArray[np.int64]) -> Frames:
        """The frames with their times; arrived_us: int64 (n,), not falling, greater than 0."""
        out_us, counts = np.empty(len(frames), np.int64), np.zeros(len(REASONS), np.int64)
        follow(self._line, frames.t_us, arrived_us, self._period_us, out_us, counts)
        kept = frames[out_us >= 0]
        kept.t_us[:] = out_us[out_us >= 0]
        fr.add_counts(kept.refused, frames.refused)
        fr.add_counts(kept.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
        return kept
