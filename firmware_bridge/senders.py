"""A second sender with the same identifier: its message comes faster than it is declared.

Frames are counted in windows of 100 ms of stamps (of ten periods for slow messages).  More than 1.5
times what the period gives, and two for jitter, and the message is refused, from there until 0.5 s
after the last such window: nobody can tell which sender is right.  All frames count, also those
that a CRC or counter would refuse.  No clock is asked: pieces of any size give the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.checks import find_message
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Records, kernel

WINDOW_US, LEAST_PERIODS = 100_000, 10
FACTOR, JITTER = 1.5, 2
HOLD_US = 500_000
REASON = "too_fast"

SENDER = np.dtype(
    [
        ("can_id", np.uint32),
        ("channel", np.int16),  # -1: any
        ("window_us", np.int64),
        ("most", np.int64),  # frames in one window
        ("start_us", np.int64),  # of the present window
        ("count", np.int64),  # frames in it
        ("until_us", np.int64),  # refused before this time
    ]
)


@kernel
def mark(
    senders: Records,
    t_us: NDArray[np.int64],
    channel: NDArray[np.uint8],
    can_id: NDArray[np.uint32],
    keep: NDArray[np.bool_],
) -> int:
    """Set keep (n,) to False where a frame is refused; how many.  senders changed in place."""
    refused = 0
    for i in range(len(t_us)):
        m = find_message(senders, can_id[i], channel[i])
        if m < 0:
            continue
        one, t = senders[m], t_us[i]
        if t - one.start_us >= one.window_us or t < one.start_us - one.window_us:
            one.start_us, one.count = t, 0
            if one.until_us > t + HOLD_US:  # the clock was set back
                one.until_us = t
        one.count += 1
        if one.count > one.most:
            one.until_us = t + HOLD_US
        if t < one.until_us:
            keep[i] = False
            refused += 1
    return refused


class Senders:
    """Refuses the frames of messages that more than one sender seems to send.

    messages: MESSAGE (m,) of the assembler's plan, or anything with its can_id, channel, period_us.
    """

    def __init__(self, messages: Records) -> None:
        self._senders = np.zeros(len(messages), SENDER)
        for name in ("can_id", "channel"):
            self._senders[name] = messages[name]
        window = np.maximum(WINDOW_US, LEAST_PERIODS * messages["period_us"])
        self._senders["window_us"] = window
        self._senders["most"] = np.ceil(FACTOR * window / messages["period_us"]) + JITTER
        self._last_us = 0

    def push(self, frames: Frames) -> Frames:
        """The frames that may be believed; what was refused is counted as "too_fast"."""
        keep = np.ones(len(frames), np.bool_)
        refused = mark(self._senders, frames.t_us, frames.channel, frames.can_id, keep)
        if len(frames):
            self._last_us = int(frames.t_us[-1])
        if not refused:
            return frames
        kept = frames[keep]
        fr.add_counts(kept.refused, frames.refused)
        fr.add_counts(kept.refused, {REASON: int(refused)})
        return kept

    @property
    def doubted(self) -> NDArray[np.bool_]:
        """Which messages are being refused, bool (m,), at the last frame seen."""
        return np.asarray(self._senders["until_us"] > self._last_us)
